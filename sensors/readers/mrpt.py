"""Range-bearing logs in the tables that MRPT's simulated recordings are dumped to.

A folder with, comma-separated under a header line:

- `odometry.csv`, in the plane: step, dx_m, dy_m, dphi_rad, then the upper triangle of the covariance in this
  order (cxx, cxy, cxp, cyy, cyp, cpp); in space: step, dx_m, dy_m, dz_m, yaw_rad, pitch_rad, roll_rad, then
  the upper triangle cov00 to cov55. Row t moves the robot from step t - 1 to step t, in the frame of t - 1.
  The header tells the plane from space. Rotations are Rz(yaw) Ry(pitch) Rx(roll).
- `observations.csv`: step (from 0), landmark_id, range_m, yaw_rad, pitch_rad and their standard deviations.
  Yaw is positive to the left. z is (range, yaw) in the plane, where pitch must be 0, and (range, yaw, pitch)
  in space.
- `sensor.yaml`: where the sensor sits and the sign of pitch, see `mrpt_sensor`.
- `robot_path_groundtruth.csv` and `landmarks_groundtruth.csv`, if the truth is known: step, x_m, y_m, z_m,
  yaw_rad, pitch_rad, roll_rad (world_from_robot), and id, x_m, y_m, z_m.

A frame is a step, its stamp the step's number: steps 0 to the last one with an observation.
"""

from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbpf.lie import SE2, SE3, Array
from rbpf.sensors.readers.assembly import assemble, diagonal, require_distinct, require_observations
from rbpf.sensors.readers.covariance import planar_to_chart, read_covariances, spatial_to_chart
from rbpf.sensors.readers.log import RobotLog, Truth
from rbpf.sensors.readers.mrpt_sensor import read_sensor
from rbpf.sensors.readers.noise import LogNoise, standard_deviations
from rbpf.sensors.readers.table import Table, read_csv

KIND = "an MRPT log (a folder with observations.csv, odometry.csv and sensor.yaml)"

_POSE = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "roll_rad")
_PLANAR = ("step", "dx_m", "dy_m", "dphi_rad", "cxx", "cxy", "cxp", "cyy", "cyp", "cpp")
_TRIANGLE = tuple(f"cov{i}{j}" for i, j in combinations_with_replacement(range(6), 2))
_SPATIAL = ("step", "dx_m", "dy_m", "dz_m", *_POSE[3:], *_TRIANGLE)
_SIGHTING = ("range_m", "yaw_rad", "pitch_rad", "std_range_m", "std_yaw_rad", "std_pitch_rad")


def recognises(path: Path) -> bool:
    """Whether the folder holds one of the files that make an MRPT log."""
    return any((path / name).is_file() for name in ("observations.csv", "odometry.csv", "sensor.yaml"))


def read(path: Path, noise: LogNoise) -> RobotLog:
    """Read the log in a folder.

    Args:
        path: the folder.
        noise: ranges, bearings and pitches take the standard deviations given here, if any.

    Raises:
        InputError: a file is missing or a line is not as described above.
    """
    odometry = read_csv(path / "odometry.csv", [_PLANAR, _SPATIAL], KIND)
    sightings = read_csv(path / "observations.csv", [("step", "landmark_id", *_SIGHTING)], KIND)
    planar = odometry.columns == _PLANAR
    robot_from_sensor, pitch_sign = read_sensor(path / "sensor.yaml", planar, KIND)
    delta, cov_delta = _planar_motion(odometry) if planar else _spatial_motion(odometry)
    cov_delta *= noise.odometry_variance_factor()
    step, landmarks = _require_order(sightings, odometry)
    z, cov_z = _measurements(sightings, planar, noise, path)
    frames = step[-1] + 1
    stamps = np.arange(frames)
    return RobotLog(
        name=path.resolve().name,
        space=SE2 if planar else SE3,
        measurement="range_bearing",
        robot_from_sensor=robot_from_sensor,
        frames=assemble(stamps, delta[: frames - 1], cov_delta[: frames - 1], step, landmarks, z, cov_z),
        pitch_sign=pitch_sign,
        truth=_read_truth(path, planar),
    )


def _planar_motion(odometry: Table) -> tuple[Array, Array]:
    delta = SE2.normalise(np.roll(odometry.block("dx_m", "dphi_rad"), 1, axis=1))
    return delta, planar_to_chart(delta, read_covariances(odometry, "cxx", "cpp"))


def _spatial_motion(odometry: Table) -> tuple[Array, Array]:
    ypr = odometry.block("yaw_rad", "roll_rad")
    delta = SE3.from_ypr(odometry.block("dx_m", "dz_m"), *ypr.T)
    return delta, spatial_to_chart(delta, ypr, read_covariances(odometry, "cov00", "cov55"))


def _require_order(sightings: Table, odometry: Table) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    counted = np.arange(1, len(odometry.rows) + 1)
    odometry.require(odometry["step"] == counted, "step", "one more than in the row before, from 1")
    step, landmarks = sightings.integers("step"), sightings.integers("landmark_id")
    last = counted[-1]
    sightings.require((step >= 0) & (step <= last), "step", f"one with odometry, 0 to {last}")
    ordered = np.diff(step, prepend=0) >= 0
    if not ordered.all():
        row = int(np.argmin(ordered))
        problem = f"time runs backwards from step {step[row - 1]} to {step[row]}, expected rows in order"
        raise sightings.error(row, problem)
    require_distinct(sightings, step, landmarks, "step")
    return step, landmarks


def _measurements(table: Table, planar: bool, noise: LogNoise, path: Path) -> tuple[Array, Array]:
    applicable = ["std_range_m", "std_bearing_rad", "scale_odometry"] + ["std_pitch_rad"] * (not planar)
    noise.require_only(applicable, path, f"an MRPT log in {'the plane' if planar else 'space'}")
    require_observations(table, "range_m", "yaw_rad")
    pitch = table["pitch_rad"]
    std = [
        standard_deviations(table, "std_range_m", noise.std_range_m),
        standard_deviations(table, "std_yaw_rad", noise.std_bearing_rad),
    ]
    if planar:
        table.require(pitch == 0, "pitch_rad", "0, as the odometry is planar")
        table.require(table["std_pitch_rad"] >= 0, "std_pitch_rad", "zero or positive")
        return table.block("range_m", "yaw_rad"), diagonal(std)
    table.require(np.abs(pitch) <= np.pi / 2, "pitch_rad", "in radians, within a quarter turn")
    std.append(standard_deviations(table, "std_pitch_rad", noise.std_pitch_rad))
    return table.block("range_m", "pitch_rad"), diagonal(std)


def _read_truth(path: Path, planar: bool) -> Truth | None:
    path_file, landmark_file = path / "robot_path_groundtruth.csv", path / "landmarks_groundtruth.csv"
    if not path_file.exists() and not landmark_file.exists():
        return None
    stamps, poses = np.empty(0, dtype=np.int64), np.empty((0, 3 if planar else 7))
    landmarks: dict[int, np.ndarray] = {}
    if path_file.exists():
        stamps, poses = _read_path(read_csv(path_file, [("step", *_POSE)]), planar)
    if landmark_file.exists():
        table = read_csv(landmark_file, [("id", *_POSE[:3])])
        positions = table.block("x_m", "y_m" if planar else "z_m")
        landmarks = dict(zip(table.names("id").tolist(), positions, strict=True))
    return Truth(stamps, poses, landmarks)


def _read_path(table: Table, planar: bool) -> tuple[NDArray[np.int64], Array]:
    step = table.integers("step")
    table.require(np.diff(table["step"], prepend=-1) > 0, "step", "later than in the row before, from 0")
    if not planar:
        return step, SE3.from_ypr(table.block("x_m", "z_m"), *table.block("yaw_rad", "roll_rad").T)
    for angle in ("pitch_rad", "roll_rad"):
        table.require(table[angle] == 0, angle, "0, as the odometry is planar")
    return step, SE2.normalise(np.stack([table["yaw_rad"], table["x_m"], table["y_m"]], axis=1))
