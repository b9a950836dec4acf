"""EuRoC MAV sequences in the ASL layout; the path is `mav0` or the folder that holds it.

- `cam0/sensor.yaml`: `resolution`, `intrinsics` (fx, fy, cx, cy), `camera_model: pinhole`, `distortion_model:
  radial-tangential` with `distortion_coefficients` (k1, k2, p1, p2[, k3]) or `equidistant` with k1, k2, k3, k4, and
  `T_BS`, body_from_camera;
- `cam0/data.csv`: time [ns] and file in `cam0/data` of each image;
- `cam1`, if there are two cameras: its images are read only where the pair is rectified, which a logged message
  says otherwise (`euroc_stereo`);
- `state_groundtruth_estimate0` or `vicon0`, if the truth is known: `data.csv` with time [ns], position of the
  sensor [m] and its quaternion qw, qx, qy, qz, world_from_sensor, and more columns; `sensor.yaml` with `T_BS`,
  body_from_sensor. The truth returned is world_from_camera = world_from_sensor body_from_sensor⁻¹ body_from_camera.

M. Burri, J. Nikolic, P. Gohl, T. Schneider, J. Rehder, S. Omari, M. W. Achtelik, R. Siegwart, "The EuRoC micro aerial
vehicle datasets", IJRR 35(10), 2016.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rbpf.lie import SE3, Array
from rbpf.sensors.feature_log import CameraTruth
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.sensors.readers.images.euroc_camera import AslCamera, read_camera, read_mount
from rbpf.sensors.readers.images.euroc_stereo import read_right
from rbpf.sensors.readers.images.files import FileImages, first_shape
from rbpf.sensors.readers.images.sequence import ImageSequence, Source
from rbpf.sensors.readers.images.stamped import read_stamped
from rbpf.sensors.readers.images.truth import normalised, truth_between

KIND = "an EuRoC sequence in the ASL layout (mav0/cam0 with sensor.yaml and data.csv)"

_TRUTHS = ("state_groundtruth_estimate0", "vicon0")
_COLUMNS = ("p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z")


def recognises(path: Path) -> bool:
    """Whether the path is a folder with `mav0` or with `cam0` in it."""
    return (path / "mav0").is_dir() or (path / "cam0").is_dir()


def read(path: Path, calibration: Path | None) -> ImageSequence:
    """Open the sequence.

    Args:
        path: the folder.
        calibration: a camera file in place of that of `cam0`, and a baseline in place of the pair's, if it has
            one; the truth stays that of the sequence's camera.

    Raises:
        InputError: a file is missing or not as described above.
    """
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    camera = read_camera(mav / "cam0" / "sensor.yaml", KIND)
    rows = read_stamped(mav / "cam0" / "data.csv", KIND, ",", nanoseconds=True)
    files = rows.files(mav / "cam0" / "data")
    used = camera.calibration if calibration is None else read_calibration(calibration)
    shape = first_shape(files, rows.path)
    used.require_shape(shape, str(mav / "cam0"))
    right, baseline_m = read_right(mav / "cam1", camera, used.camera, rows)
    opened = sequence(mav, camera, rows.stamps_ns, FileImages(rows.stamps_ns, shape, files, right))
    return replace(opened, camera=used.camera, baseline_m=baseline_m and (used.baseline_m or baseline_m))


def sequence(mav: Path, camera: AslCamera, stamps_ns: np.ndarray, source: Source) -> ImageSequence:
    """Images of one camera, with its truth where there is one.

    Args:
        mav: the folder with the cameras.
        camera: whose pose on the body says where the truth is.
        stamps_ns: (T,) times of the images.
        source: of the images.

    Raises:
        InputError: the truth's file is malformed, or of another time.
    """
    return ImageSequence(
        name=_name(mav),
        camera=camera.calibration.camera,
        stamps_ns=stamps_ns,
        truth=_read_truth(mav, camera, stamps_ns),
        baseline_m=None,
        source=source,
    )


def _name(mav: Path) -> str:
    folder = mav.resolve()
    return folder.parent.name if folder.name == "mav0" else folder.name


def _read_truth(mav: Path, camera: AslCamera, images_ns: np.ndarray) -> CameraTruth | None:
    for name in _TRUTHS:
        file = mav / name / "data.csv"
        if file.exists():
            rows = read_stamped(file, "poses", ",", nanoseconds=True)
            table = rows.table(_COLUMNS, ",")
            xyzw = np.roll(table.block("q_w", "q_z"), -1, axis=1)
            world_from_sensor = normalised(table, np.hstack([xyzw, table.block("p_x", "p_z")]))
            poses = SE3.compose(
                world_from_sensor, SE3.compose(_sensor_from_body(mav / name), camera.body_from_camera)
            )
            return truth_between(file, rows.stamps_ns, poses, images_ns)
    return None


def _sensor_from_body(folder: Path) -> Array:
    file = folder / "sensor.yaml"
    if folder.name == _TRUTHS[0] and not file.exists():
        # The estimated state is the body's by definition; where a marker sits on it is not.
        return SE3.identity()
    return SE3.inverse(read_mount(file))
