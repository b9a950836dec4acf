"""KITTI odometry sequences.

- `image_0` (left) and, for stereo, `image_1` (right), or the colour pair `image_2` and `image_3`: `000000.png`, ...;
- `calib.txt`: the projections `P0:` to `P3:`, 3 x 4 by rows [px, px m], Pi = K [I | t] with x_i = x_0 + t;
- `times.txt`: one time per image [s];
- the truth, if it is known: `poses.txt` beside it, or as distributed `../../poses/<sequence>.txt`, one line of a
  3 x 4 matrix by rows per image, world_from_camera of `image_0` [m].

A camera file given replaces the intrinsics in `calib.txt`, and the baseline, if it has one. A missing image
between others gives a frame without an image.
A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012.
"""

from functools import partial
from pathlib import Path
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.images.calibration import Calibration, read_calibration
from rbpf.sensors.readers.images.decoding import SUFFIXES, FileImages, first_shape
from rbpf.sensors.readers.images.poses import pose_of_matrix
from rbpf.sensors.readers.images.sequence import ImageFormat, ImageSequence, ReadOptions
from rbpf.sensors.readers.text import line_error, parse_number, read_columns, read_stamped, read_text, require_seconds

ALIGNED_PX = 1e-2  #: Tolerance of equal intrinsics of a pair's two cameras.
_PAIRS = ((0, 1), (2, 3))
_POSE = tuple(f"m{row}{column}" for row in range(3) for column in range(4))


@final
class Kitti(ImageFormat):
    """KITTI odometry sequences."""

    kind = "a KITTI odometry sequence (image_0 or image_2, calib.txt, times.txt)"
    stereo_kind = "a KITTI odometry sequence of two cameras (image_0 and image_1, calib.txt, times.txt)"

    def recognises(self, path: Path) -> bool:
        return any((path / f"image_{left}").is_dir() for left, _ in _PAIRS)

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        stereo = options.stereo
        left, right = next(pair for pair in _PAIRS if (path / f"image_{pair[0]}").is_dir())
        folders = path / f"image_{left}", path / f"image_{right}"
        if stereo and not folders[1].is_dir():
            raise InputError(f"{folders[1]}: no such folder, expected the images of the right camera.")
        calib = path / "calib.txt"
        _, intrinsics, first_from_camera = _projection(calib, self.kind, left)
        rows = read_stamped(path / "times.txt", self.kind)
        count = len(rows.stamps_ns)
        # Files of the left camera, and of the right one.
        files = [_files(folder, count) for folder in (folders if stereo else folders[:1])]
        shape = first_shape(files[0], folders[0])
        if options.calibration is not None:
            used = read_calibration(options.calibration)
        else:
            fx, fy, cx, cy = intrinsics.tolist()
            height, width = shape
            if not (0.0 < cx < width and 0.0 < cy < height):
                problem = f"({cx:.6g}, {cy:.6g}) px lies outside the images of {width}x{height} px"
                raise InputError(f"{calib}: the centre of projection {problem}; give the calibration of these images.")
            used = Calibration(str(calib), Pinhole(width, height, fx, fy, cx, cy))
        used.require_shape(shape, str(path))
        require_seconds(rows.path, rows.stamps_ns, "images", used.rate_hz)
        if stereo and (other := first_shape(files[1], folders[1])) != shape:
            sizes = f"{shape[1]}x{shape[0]} and {other[1]}x{other[0]} px"
            raise InputError(f"{path}: the left and right images have {sizes}, expected one size.")
        baseline_m = used.baseline_m if stereo else None
        if stereo and baseline_m is None:
            where, theirs, first_from_right = _projection(calib, self.kind, right)
            baseline_m = float((first_from_right - first_from_camera)[4])
            if baseline_m == 0.0:
                problem = "it is at the position of the left camera, a baseline of zero"
                raise InputError(f"{where}: {problem}; give the projections of two cameras.")
            if np.abs(intrinsics - theirs).max() > ALIGNED_PX or baseline_m < 0.0:
                problem = "expected the left camera's projection shifted to the right, as of a rectified pair"
                raise InputError(f"{where}: {problem}.")
        # A note for each folder that does not have an image for every time.
        held = [sum(file.exists() for file in of_camera) for of_camera in files]
        notes = tuple(
            f"{folder}: {number} images for {count} times; the other pairs lack that image."
            for folder, number in zip(folders, held, strict=False)
            if stereo and number < count
        )
        folder, truth = path.resolve(), None
        for file in (path / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"):
            if not file.exists():
                continue
            table = read_columns(file, _POSE)
            if len(table.lines) != count:
                problem = f"expected {count} poses, one per time in times.txt, found {len(table.lines)}"
                raise InputError(f"{file}: {problem}; copy both from one sequence.")
            matrices = enumerate(table.values.reshape(-1, 3, 4))
            poses = np.array([pose_of_matrix(matrix, partial(table.error, row)) for row, matrix in matrices])
            truth = Truth(rows.stamps_ns, SE3.compose(poses, first_from_camera))
            break
        source = FileImages(rows.stamps_ns, shape, *files)
        return ImageSequence(folder.name, used.camera, rows.stamps_ns, truth, baseline_m, source, notes)


def _projection(path: Path, hint: str, camera: int) -> tuple[str, Array, Array]:
    """A camera of `calib.txt` by its number; other lines are ignored. `hint` describes the expected file.

    Returns its line for messages; fx, fy, cx, cy (4,) [px]; and its pose (7,) relative to camera 0, the poses' frame.
    """
    for number, line in enumerate(read_text(path, hint).splitlines(), 1):
        name, _, rest = line.partition(":")
        if name != f"P{camera}":
            continue
        fields = rest.split()
        if len(fields) != 12:
            raise line_error(path, number, f"expected {name}: and 12 numbers, found {len(fields)}")
        matrix = np.reshape([parse_number(path, number, name, field) for field in fields], (3, 4))
        fx, fy, cx, cy = intrinsics = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        pinhole = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        if not (fx > 0.0 and fy > 0.0 and np.array_equal(matrix[:, :3], pinhole)):
            problem = f"expected {name} to be fx 0 cx . 0 fy cy . 0 0 1 . with positive fx and fy"
            raise line_error(path, number, problem)
        shift = -np.linalg.solve(pinhole, matrix[:, 3])
        return f"{path}, line {number}", intrinsics, np.concatenate([SE3.identity()[:4], shift])
    raise InputError(f"{path}: expected a line `P{camera}:` and 12 numbers, found none.")


def _files(folder: Path, count: int) -> list[Path]:
    images = (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
    found = {int(file.stem): file for file in images if file.stem.isascii() and file.stem.isdigit()}
    if found and max(found) >= count:
        problem = f"found image {max(found)} but {count} times in times.txt"
        raise InputError(f"{folder}: {problem}, expected one time per image; copy both from one sequence.")
    return [found.get(i, folder / f"{i:06d}.png") for i in range(count)]
