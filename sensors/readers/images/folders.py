"""Images of one camera that lie in folders, with files of their times and camera poses.

TUM RGB-D sequences (J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, "A benchmark for the evaluation of RGB-D
SLAM systems", IROS 2012):

- `rgb.txt`: time [s] and file of each image, `#` starting a comment; images more than five seconds apart are refused, as
  their times are probably not in seconds, unless `rate_hz` of `camera.yaml` confirms them;
- `camera.yaml`: the calibration, which the distributed sequences do not bring along (`calibration` describes it);
- `groundtruth.txt`, if the truth is known: `timestamp tx ty tz qx qy qz qw`, world_from_camera.

7-Scenes sequences (J. Shotton, B. Glocker, C. Zach, S. Izadi, A. Criminisi, A. Fitzgibbon, "Scene coordinate regression
forests for camera relocalization in RGB-D images", CVPR 2013):

- `frame-000000.color.png`, ...: colour images, 30 per second, whose number is their time;
- `frame-000000.pose.txt`, ...: 4 x 4 matrix by rows, world_from_camera [m], of the depth camera, which is taken as the
  colour camera's. The truth has gaps where tracking was lost (numbers that are not finite);
- `camera.yaml`, if the camera was calibrated; else the nominal intrinsics of the colour camera, f = 525 px at 640 x 480;
  the 585 px that some tools give are the depth camera's.

Photos of one camera with measured poses, in `images`, and `cameras.txt`, `#` starting a comment:

    K fx fy cx cy width height              # px, no distortion
    0000.jpg tx ty tz qx qy qz qw           # world_from_camera [m], one line per photo

Photos have no time: they are `1 / PHOTO_RATE_HZ` apart, in the order of their lines.

Any other folder of images with a `camera.yaml`:

- the images, in the folder itself or in its `images`, in natural order of their names
  (`2.png` before `10.png`);
- `times.txt`, if the times are known: one per image [s]. Else the images are `rate_hz` of `camera.yaml` apart,
  and without that a video's `DEFAULT_RATE_HZ`, which a logged message says;
- `groundtruth.txt`, if the truth is known: as in a TUM RGB-D sequence.

A camera file given replaces the recording's own.
"""

import logging
import re
from itertools import pairwise
from pathlib import Path
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.images.calibration import NAME, Calibration, read_calibration
from rbpf.sensors.readers.images.decoding import SUFFIXES, FileImages, first_shape
from rbpf.sensors.readers.images.poses import TUM_POSE, normalised, pose_of_matrix, read_tum_truth
from rbpf.sensors.readers.images.sequence import ImageFormat, ImageSequence, ReadOptions
from rbpf.sensors.readers.text import numbered_lines, parse_table, quoted, read_stamped, read_text, require_seconds

DEFAULT_RATE_HZ = 30.0
SCENES_RATE_HZ = 30.0
PHOTO_RATE_HZ = 1.0
SCENES_CAMERA = Calibration("the nominal camera of 7-Scenes", Pinhole(640, 480, 525.0, 525.0, 320.0, 240.0))

_SCENES_IMAGE = re.compile(r"frame-(\d+)\.color\.\w+", re.ASCII)
_PHOTO_CAMERA = ("fx", "fy", "cx", "cy", "width", "height")
_log = logging.getLogger(__name__)


@final
class Tum(ImageFormat):
    """TUM RGB-D sequences."""

    kind = "a TUM RGB-D sequence (rgb.txt, camera.yaml)"

    def recognises(self, path: Path) -> bool:
        return (path / "rgb.txt").is_file()

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        rows = read_stamped(path / "rgb.txt", self.kind)
        files = rows.files(path)
        camera = read_calibration(options.calibration or path / NAME)
        truth = read_tum_truth(path / "groundtruth.txt", rows.stamps_ns)
        return _sequence(path, camera, rows.stamps_ns, files, truth, rows.path)


@final
class SevenScenes(ImageFormat):
    """7-Scenes sequences."""

    kind = "a 7-Scenes sequence (frame-000000.color.png, frame-000000.pose.txt, ...)"

    def recognises(self, path: Path) -> bool:
        found = path.glob("frame-*.color.*") if path.is_dir() else ()
        return any(_SCENES_IMAGE.fullmatch(file.name) for file in found)

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        found = ((_SCENES_IMAGE.fullmatch(file.name), file) for file in path.glob("frame-*.color.*"))
        images = sorted((int(match[1]), file) for match, file in found if match and file.suffix.lower() in SUFFIXES)
        for (number, file), (later, other) in pairwise(images):
            if number == later:
                raise InputError(f"{path}: found {file.name} and {other.name}, expected one image of each number.")
        known = options.calibration is not None or (path / NAME).is_file()
        camera = read_calibration(options.calibration or path / NAME) if known else SCENES_CAMERA
        numbers, files = np.array([number for number, _ in images], dtype=np.int64), [file for _, file in images]
        stamps_ns = np.rint(numbers * (1e9 / SCENES_RATE_HZ)).astype(np.int64)
        poses = [_scenes_pose(file.with_name(file.name.split(".")[0] + ".pose.txt")) for file in files]
        kept = [row for row, pose in enumerate(poses) if pose is not None]
        truth = Truth(stamps_ns[kept], np.array([poses[row] for row in kept])) if kept else None
        return _sequence(path, camera, stamps_ns, files, truth, path)


@final
class Photos(ImageFormat):
    """Photos of one camera with measured poses."""

    kind = "photos with measured poses (cameras.txt, images/)"

    def recognises(self, path: Path) -> bool:
        return (path / "cameras.txt").is_file()

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        file = path / "cameras.txt"
        rows = [(number, *line.partition(" ")[::2]) for number, line in numbered_lines(file, self.kind)]
        cameras = [(line, rest) for line, name, rest in rows if name == "K"]
        if len(cameras) != 1:
            raise InputError(f"{file}: expected one line `K fx fy cx cy width height`, found {len(cameras)}.")
        if options.calibration is None:
            table = parse_table(file, _PHOTO_CAMERA, cameras)
            fx, fy, cx, cy, width, height = table.values[0].tolist()
            if not (min(fx, fy, width, height) > 0.0 and width % 1 == 0 and height % 1 == 0):
                raise table.error(0, "expected positive fx and fy, and a whole positive width and height")
            camera = Calibration(f"{file}, line {table.lines[0]}", Pinhole(int(width), int(height), fx, fy, cx, cy))
        else:
            camera = read_calibration(options.calibration)
        photos = [row for row in rows if row[1] != "K"]
        table = parse_table(file, TUM_POSE, [(line, pose) for line, _, pose in photos])
        stamps_ns = evenly(len(photos), PHOTO_RATE_HZ)
        truth = Truth(stamps_ns, normalised(np.roll(table.values, 4, axis=1), table.error))
        return _sequence(path, camera, stamps_ns, [path / "images" / name for _, name, _ in photos], truth, file)


@final
class Folder(ImageFormat):
    """A folder of images."""

    kind = "a folder of images (in itself or in its images/) with a camera.yaml"

    def recognises(self, path: Path) -> bool:
        return path.is_dir() and ((path / NAME).is_file() or bool(list_images(path)))

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        files = list_images(path)
        if not files:
            raise InputError(f"{path}: expected images in it or in its images/, found none.")
        camera, times = read_calibration(options.calibration or path / NAME), path / "times.txt"
        if times.exists():
            stamps_ns = read_stamped(times, self.kind).stamps_ns
            if len(stamps_ns) != len(files):
                raise InputError(f"{times}: expected {len(files)} times, one per image, found {len(stamps_ns)}.")
        else:
            stamps_ns = evenly(len(files), camera.rate_hz or DEFAULT_RATE_HZ)
            if camera.rate_hz is None:
                said = "%s: no times.txt and no rate_hz in %s, taken as %g Hz"
                _log.info(said, path, camera.where, DEFAULT_RATE_HZ)
        return _sequence(path, camera, stamps_ns, files, read_tum_truth(path / "groundtruth.txt", stamps_ns), path)


def list_images(path: Path) -> list[Path]:
    """Images in the folder, or else in its `images`, in natural order of their names."""
    for folder in (path, path / "images"):
        if folder.is_dir():
            found = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES]
            if found:
                # Numbers in a name are compared by value.
                parts = {file: re.split(r"(\d+)", file.name) for file in found}
                return sorted(found, key=lambda f: ([int(p) if p.isdecimal() else p for p in parts[f]], f.name))
    return []


def evenly(count: int, rate_hz: float) -> np.ndarray:
    """(count,) int64 equidistant stamps from 0 at a rate."""
    return np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def _sequence(
    path: Path, camera: Calibration, stamps_ns: np.ndarray, files: list[Path], truth: Truth | None, listed: Path
) -> ImageSequence:
    """A sequence of image files of one size, `listed` in a file or found in the folder."""
    require_seconds(listed, stamps_ns, "images", camera.rate_hz)
    shape = first_shape(files, listed)
    camera.require_shape(shape, str(path))
    source = FileImages(stamps_ns, shape, files)
    return ImageSequence(path.resolve().name, camera.camera, stamps_ns, truth, None, source)


def _scenes_pose(path: Path) -> Array | None:
    """Pose (7,) of a file; None if it is missing, or its numbers are not finite."""
    if not path.exists():
        return None
    fields = read_text(path, "a 4 x 4 matrix").split()
    try:
        matrix = np.array([float(field) for field in fields])
    except ValueError:
        raise InputError(f"{path}: expected 16 numbers, found {quoted(' '.join(fields))}.") from None
    if len(matrix) != 16:
        raise InputError(f"{path}: expected 16 numbers, found {len(matrix)}.")
    if not np.isfinite(matrix).all():
        return None
    return pose_of_matrix(matrix.reshape(4, 4), lambda problem: InputError(f"{path}: {problem}."))
