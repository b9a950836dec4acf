"""KITTI odometry sequences.

- `image_0` (left) and, for stereo, `image_1` (right), or the colour pair `image_2` and `image_3`: `000000.png`, ...;
- `calib.txt`: the projections `P0:` to `P3:`, 3 x 4 by rows [px, px m], Pi = K [I | t] with x_i = x_0 + t;
- `times.txt`: one time per image [s];
- the truth, if it is known: `poses.txt` beside it, or as distributed `../../poses/<sequence>.txt`, one line of a
  3 x 4 matrix by rows per image, world_from_camera of `image_0` [m].

An image that is missing between others is a frame without an image.
A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012.
"""

from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import CameraTruth
from rbpf.sensors.readers.images.calibration import Calibration, read_calibration
from rbpf.sensors.readers.images.decoding import SUFFIXES
from rbpf.sensors.readers.images.files import FileImages, first_shape
from rbpf.sensors.readers.images.kitti_calibration import Projections, read_projections
from rbpf.sensors.readers.images.matrices import pose_of_matrix, rigid_motion_error
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.images.stamped import read_stamped
from rbpf.sensors.readers.table import read_columns

KIND = "a KITTI odometry sequence (image_0 or image_2, calib.txt, times.txt)"

PAIR_KIND = "a KITTI odometry sequence of two cameras (image_0 and image_1, calib.txt, times.txt)"

_PAIRS = ((0, 1), (2, 3))
_POSE = tuple(f"m{row}{column}" for row in range(3) for column in range(4))


def recognises(path: Path) -> bool:
    """Whether the path is a folder with the images of a left camera."""
    return any((path / f"image_{left}").is_dir() for left, _ in _PAIRS)


def read(path: Path, calibration: Path | None) -> ImageSequence:
    """Open the sequence.

    Args:
        path: the folder.
        calibration: a camera file in place of the intrinsics in `calib.txt`, and of the baseline, if it has one.

    Raises:
        InputError: a file is missing or not as described above.
    """
    left, right = next(pair for pair in _PAIRS if (path / f"image_{pair[0]}").is_dir())
    projections = read_projections(path / "calib.txt", KIND)
    rows = read_stamped(path / "times.txt", KIND)
    files = _files(path / f"image_{left}", len(rows.lines))
    shape = first_shape(files, path / f"image_{left}")
    used = _calibration(projections, left, shape) if calibration is None else read_calibration(calibration)
    used.require_shape(shape, str(path))
    stereo = (path / f"image_{right}").is_dir()
    baseline_m = used.baseline_m or projections.baseline(left, right) if stereo else None
    return ImageSequence(
        name=path.resolve().name,
        camera=used.camera,
        stamps_ns=rows.stamps_ns,
        truth=_read_truth(path, projections.first_from_camera(left), rows.stamps_ns),
        baseline_m=baseline_m,
        source=FileImages(
            rows.stamps_ns, shape, files, _files(path / f"image_{right}", len(files)) if stereo else None
        ),
    )


def read_pair(path: Path, calibration: Path | None) -> tuple[ImageSequence, RectifiedStereo, tuple[str, ...]]:
    """The sequence, its two cameras, and what has to be said about them; as `open_stereo`."""
    left, right = next(pair for pair in _PAIRS if (path / f"image_{pair[0]}").is_dir())
    folders = path / f"image_{left}", path / f"image_{right}"
    if not folders[1].is_dir():
        raise InputError(f"{folders[1]}: no such folder, expected the images of the right camera.")
    sequence = read(path, calibration)
    shape = first_shape(_files(folders[1], len(sequence)), folders[1])
    if shape != (sequence.camera.height, sequence.camera.width):
        sizes = f"{sequence.camera.width}x{sequence.camera.height} and {shape[1]}x{shape[0]} px"
        raise InputError(f"{path}: the left and right images have {sizes}, expected one size.")
    assert sequence.baseline_m is not None
    return sequence, RectifiedStereo(sequence.camera, sequence.baseline_m), _missing(folders, len(sequence))


def _missing(folders: tuple[Path, Path], count: int) -> tuple[str, ...]:
    """A sentence about each folder that does not hold an image for every time."""
    held = [sum(file.exists() for file in _files(folder, count)) for folder in folders]
    return tuple(
        f"{folder}: {number} images for {count} times; the other pairs come without."
        for folder, number in zip(folders, held, strict=True)
        if number < count
    )


def _calibration(projections: Projections, left: int, shape: tuple[int, int]) -> Calibration:
    fx, fy, cx, cy = projections.intrinsics(left)
    height, width = shape
    if not (0.0 < cx < width and 0.0 < cy < height):
        problem = (
            f"the centre of projection ({cx:.6g}, {cy:.6g}) px lies outside the images of {width}x{height} px"
        )
        raise InputError(f"{projections.path}: {problem}; give the calibration of these images.")
    return Calibration(str(projections.path), Pinhole(width, height, fx, fy, cx, cy))


def _files(folder: Path, count: int) -> list[Path]:
    found = {int(file.stem): file for file in folder.iterdir() if _numbered(file)}
    if found and max(found) >= count:
        problem = f"found image {max(found)} but {count} times in times.txt"
        raise InputError(f"{folder}: {problem}, expected one time per image; copy both from one sequence.")
    return [found.get(i, folder / f"{i:06d}.png") for i in range(count)]


def _numbered(file: Path) -> bool:
    return file.suffix.lower() in SUFFIXES and file.stem.isascii() and file.stem.isdigit()


def _read_truth(path: Path, first_from_camera: Array, stamps_ns: np.ndarray) -> CameraTruth | None:
    folder = path.resolve()
    for file in (path / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"):
        if file.exists():
            return CameraTruth(stamps_ns, SE3.compose(_read_poses(file, len(stamps_ns)), first_from_camera))
    return None


def _read_poses(file: Path, count: int) -> Array:
    table = read_columns(file, _POSE)
    if len(table.lines) != count:
        problem = f"expected {count} poses, one per time in times.txt, found {len(table.lines)}"
        raise InputError(f"{file}: {problem}; copy both from one sequence.")
    matrices = table.values.reshape(-1, 3, 4)
    for row, matrix in enumerate(matrices):
        if (wrong := rigid_motion_error(matrix)) is not None:
            raise table.error(row, wrong)
    return pose_of_matrix(matrices)
