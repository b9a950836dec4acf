"""Photos of one camera with measured poses.

`cameras.txt`, `#` starting a comment:

    K fx fy cx cy width height              # px, no distortion
    0000.jpg tx ty tz qx qy qz qw           # world_from_camera [m], one line per photo

and the photos in `images`. Photos have no time: they are `1 / RATE_HZ` apart, in the order of their lines.
"""

from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import CameraTruth
from rbpf.sensors.readers.images.calibration import Calibration, read_calibration
from rbpf.sensors.readers.images.files import FileImages, first_shape
from rbpf.sensors.readers.images.folder import evenly
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.images.truth import normalised
from rbpf.sensors.readers.table import parse_table
from rbpf.sensors.readers.text import line_error, read_lines

KIND = "photos with measured poses (cameras.txt, images/)"
RATE_HZ = 1.0

_CAMERA = ("fx", "fy", "cx", "cy", "width", "height")
_POSE = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def recognises(path: Path) -> bool:
    """Whether the path is a folder with a list of cameras."""
    return (path / "cameras.txt").is_file()


def read(path: Path, calibration: Path | None) -> ImageSequence:
    """Open the photos.

    Args:
        path: the folder.
        calibration: a camera file in place of the line `K`.

    Raises:
        InputError: a file is missing or not as described above.
    """
    file = path / "cameras.txt"
    camera_line, photos = _lines(file)
    camera = _camera(file, *camera_line) if calibration is None else read_calibration(calibration)
    table = parse_table(file, _POSE, [(line, pose) for line, _, pose in photos])
    files = [path / "images" / name for _, name, _ in photos]
    shape = first_shape(files, file)
    camera.require_shape(shape, str(path / "images"))
    stamps_ns = evenly(len(files), RATE_HZ)
    return ImageSequence(
        name=path.resolve().name,
        camera=camera.camera,
        stamps_ns=stamps_ns,
        truth=CameraTruth(stamps_ns, normalised(table, np.roll(table.values, 4, axis=1))),
        baseline_m=None,
        source=FileImages(stamps_ns, shape, files),
    )


def _lines(file: Path) -> tuple[tuple[int, str], list[tuple[int, str, str]]]:
    numbered = [(i, line.strip()) for i, line in enumerate(read_lines(file, KIND), 1)]
    rows = [(i, *line.partition(" ")[::2]) for i, line in numbered if line and not line.startswith("#")]
    cameras = [(line, rest) for line, name, rest in rows if name == "K"]
    if len(cameras) != 1:
        raise InputError(f"{file}: expected one line `K fx fy cx cy width height`, found {len(cameras)}.")
    return cameras[0], [row for row in rows if row[1] != "K"]


def _camera(file: Path, line: int, rest: str) -> Calibration:
    fx, fy, cx, cy, width, height = parse_table(file, _CAMERA, [(line, rest)]).values[0].tolist()
    if not (fx > 0.0 and fy > 0.0 and width > 0 and height > 0 and width % 1 == 0 and height % 1 == 0):
        raise line_error(file, line, "expected positive fx and fy, and a whole positive width and height")
    return Calibration(f"{file}, line {line}", Pinhole(int(width), int(height), fx, fy, cx, cy))
