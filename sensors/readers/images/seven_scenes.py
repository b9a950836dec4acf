"""7-Scenes sequences.

- `frame-000000.color.png`, ...: colour images, 30 per second, whose number is their time;
- `frame-000000.pose.txt`, ...: 4 x 4 matrix by rows, world_from_camera [m], of the depth camera, which is taken as the
  colour camera's. Where tracking was lost, numbers that are not finite, the truth has a gap;
- `camera.yaml`, if the camera was calibrated (see `calibration`). Else the nominal intrinsics of the colour camera,
  f = 525 px at 640 x 480; the 585 px that some tools give are the depth camera's.

J. Shotton, B. Glocker, C. Zach, S. Izadi, A. Criminisi, A. Fitzgibbon, "Scene coordinate regression forests for camera
relocalization in RGB-D images", CVPR 2013.
"""

import re
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import CameraTruth
from rbpf.sensors.readers.images.calibration import NAME, Calibration, find_calibration
from rbpf.sensors.readers.images.decoding import SUFFIXES
from rbpf.sensors.readers.images.files import FileImages, first_shape
from rbpf.sensors.readers.images.matrices import pose_of_matrix, rigid_motion_error
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.text import quoted, read_text

KIND = "a 7-Scenes sequence (frame-000000.color.png, frame-000000.pose.txt, ...)"
RATE_HZ = 30.0
NOMINAL = Calibration("the nominal camera of 7-Scenes", Pinhole(640, 480, 525.0, 525.0, 320.0, 240.0))

_IMAGE = re.compile(r"frame-(\d+)\.color\.\w+", re.ASCII)


def recognises(path: Path) -> bool:
    """Whether the path is a folder with numbered colour images or poses."""
    return path.is_dir() and any(_IMAGE.fullmatch(file.name) for file in path.glob("frame-*.color.*"))


def read(path: Path, calibration: Path | None) -> ImageSequence:
    """Open the sequence.

    Args:
        path: the folder.
        calibration: a camera file in place of the folder's or the nominal one.

    Raises:
        InputError: a file is missing or not as described above.
    """
    files = _files(path)
    known = calibration is not None or (path / NAME).is_file()
    camera = find_calibration(path, calibration) if known else NOMINAL
    shape = first_shape(list(files.values()), path)
    camera.require_shape(shape, str(path))
    stamps_ns = np.rint(np.array(list(files), dtype=np.int64) * (1e9 / RATE_HZ)).astype(np.int64)
    return ImageSequence(
        name=path.resolve().name,
        camera=camera.camera,
        stamps_ns=stamps_ns,
        truth=_read_truth(list(files.values()), stamps_ns),
        baseline_m=None,
        source=FileImages(stamps_ns, shape, list(files.values())),
    )


def _files(path: Path) -> dict[int, Path]:
    found: dict[int, Path] = {}
    for file in sorted(path.glob("frame-*.color.*")):
        match = _IMAGE.fullmatch(file.name)
        if match and file.suffix.lower() in SUFFIXES:
            number = int(match[1])
            if number in found:
                problem = f"found {found[number].name} and {file.name}, expected one image of each number"
                raise InputError(f"{path}: {problem}.")
            found[number] = file
    return dict(sorted(found.items()))


def _read_truth(files: list[Path], stamps_ns: np.ndarray) -> CameraTruth | None:
    poses, kept = [], []
    for stamp, file in zip(stamps_ns, files, strict=True):
        pose_file = file.with_name(file.name.split(".")[0] + ".pose.txt")
        pose = _read_pose(pose_file) if pose_file.exists() else None
        if pose is not None:
            poses.append(pose)
            kept.append(stamp)
    return CameraTruth(np.array(kept), np.array(poses)) if poses else None


def _read_pose(path: Path) -> Array | None:
    fields = read_text(path, "a 4 x 4 matrix").split()
    try:
        matrix = np.array([float(field) for field in fields])
    except ValueError:
        raise InputError(f"{path}: expected 16 numbers, found {quoted(' '.join(fields))}.") from None
    if len(matrix) != 16:
        raise InputError(f"{path}: expected 16 numbers, found {len(matrix)}.")
    if not np.isfinite(matrix).all():
        return None
    if (problem := rigid_motion_error(matrix.reshape(4, 4))) is not None:
        raise InputError(f"{path}: {problem}.")
    return pose_of_matrix(matrix.reshape(4, 4))
