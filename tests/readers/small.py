"""Small recordings in tables, as files by name, and writers of them."""

from pathlib import Path
from typing import Any

import numpy as np

QUARTER = np.pi / 2

MRCLAM = {
    "Barcodes.dat": "# subject barcode\n1 5\n2 14\n6 63\n7 81\n",
    "Robot3_Odometry.dat": "# time v w\n100.0 0.5 0.0\n100.3 0.2 1.0\n100.9 0.0 -2.0\n101.4 0.4 0.5\n103.0 0.1 0.1\n",
    "Robot3_Measurement.dat": "# time barcode r b\n100.1 63 3 0.1\n100.1 81 4 -0.2\n100.5 14 2 0\n101.9 81 5 0.3\n"
    "102.0 99 5 0\n",
    "Robot3_Groundtruth.dat": "# time x y heading\n100.0 1 2 0.5\n100.5 3 4 -0.5\n",
    "Landmark_Groundtruth.dat": "# subject x y sx sy\n6 1 2 0.1 0.1\n7 3 4 0.1 0.1\n",
}

_TRIANGLE = ",".join(f"cov{i}{j}" for i in range(6) for j in range(i, 6))
_OBSERVED = "step,landmark_id,range_m,yaw_rad,pitch_rad,std_range_m,std_yaw_rad,std_pitch_rad\n"
_POSE = "step,x_m,y_m,z_m,yaw_rad,pitch_rad,roll_rad\n"
_POINT = "id,x_m,y_m,z_m\n"
MOUNT = "robot_from_sensor: {x_m: 0.5, y_m: -0.25, z_m: 2, yaw_deg: 90, pitch_deg: 0, roll_deg: 0}"
SENSOR = f"# where the sensor sits\n{MOUNT}\nstd: {{range_m: 0.1, yaw_deg: 1}}\npositive_pitch: down\n"
MRPT = {
    "odometry.csv": "step,dx_m,dy_m,dphi_rad,cxx,cxy,cxp,cyy,cyp,cpp\n"
    f"1,1,2,{QUARTER!r},1,0.5,0.25,4,-0.75,9\n2,1,0,0,1,0,0,1,0,1\n3,1,0,0,1,0,0,1,0,1\n",
    "observations.csv": f"{_OBSERVED}0,7,3,0.1,0,0.01,0.02,0\n0,8,4,-0.2,-0,0.03,0.04,0\n2,7,5,0.3,0,0.05,0.06,0\n",
    "sensor.yaml": SENSOR,
    "robot_path_groundtruth.csv": f"{_POSE}0,1,2,0,0.5,0,0\n1,3,4,0,-0.5,0,-0\n",
    "landmarks_groundtruth.csv": f"{_POINT}7,1,2,3\n8,4,5,6\n",
}

DELTA_6D = np.array([1.0, -2.0, 0.5, 0.7, -0.4, 2.1])
_FACTOR = np.random.default_rng(3).normal(size=(6, 6))
COV_6D = _FACTOR @ _FACTOR.T


def _numbers(values: np.ndarray) -> str:
    return ",".join(format(float(v), ".17g") for v in values)


MRPT_IN_SPACE = {
    "odometry.csv": f"step,dx_m,dy_m,dz_m,yaw_rad,pitch_rad,roll_rad,{_TRIANGLE}\n"
    f"1,{_numbers(DELTA_6D)},{_numbers(COV_6D[np.triu_indices(6)])}\n",
    "observations.csv": f"{_OBSERVED}0,7,3,0.1,0.2,0.01,0.02,0.03\n1,8,4,-0.2,-0.3,0.03,0.04,0.05\n",
    "sensor.yaml": SENSOR.replace("down", "up"),
    "robot_path_groundtruth.csv": f"{_POSE}0,0,0,0,0,0,0\n1,{_numbers(DELTA_6D)}\n",
    "landmarks_groundtruth.csv": f"{_POINT}7,1,2,3\n",
}

GRAPH = {
    "graph.txt": f"ODOMETRY 0 1 1 2 {QUARTER!r} 1 0.5 0.25 4 -0.75 9\n"
    "LANDMARK 1 2 3 -4 0.5 0.1 0.25\n"
    "ODOMETRY 1 3 1 0 0 1 0 0 0 0 1\n"
    "LANDMARK 3 4 5 6 0.5 0 0.5\n"
    "LANDMARK 1 4 7 8 0.5 0 0.5\n"
    "LANDMARK 3 2 9 1 0.5 0 0.5\n"
}

CARMEN = {
    "robot.clf": "# message, values\nPARAM robot_frontlaser_offset 0.5\nODOM 0 0 0 0.5 0 0 10.0 robot 0.0\n"
    "FLASER 5 1.0 0.0 81.83 2.5 nan 0.5 0 0 0 0 0 10.1 robot 0.1\n"
    f"FLASER 5 1.5 2.0 3.0 4.0 5.0 1 0.5 {QUARTER!r} 1 0 {QUARTER!r} 10.3 robot 0.3\n"
    "SYNC something else\nFLASER 5 1 2 3 4 5 1.5 0 0 1 0 0 10.4 robot 0.4\n"
}

KNOWN = {"known_points.csv": "id,u_px,v_px,x_m,y_m,z_m,sigma_m\n7,1.5,2.5,1,2,3,0.1\n3,4,5,-1,-2,-3,0\n"}


def write(folder: Path, files: dict[str, Any]) -> Path:
    """Files of text or bytes, by name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder
