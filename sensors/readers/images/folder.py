"""A folder of images with a `camera.yaml`.

- the images, in the folder itself or in its `images`, in the order of their names, numbers in them counted as such
  (`2.png` before `10.png`);
- `camera.yaml` (see `calibration`);
- `times.txt`, if the times are known: one per image [s]. Else the images are `rate_hz` of `camera.yaml` apart,
  and without that a video's `DEFAULT_RATE_HZ`, which a logged message says;
- `groundtruth.txt`, if the truth is known: as in a TUM RGB-D sequence.
"""

import logging
import re
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images import calibration as camera_file
from rbpf.sensors.readers.images.decoding import SUFFIXES
from rbpf.sensors.readers.images.files import FileImages, first_shape
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.images.stamped import read_stamped
from rbpf.sensors.readers.images.truth import read_tum_truth

KIND = "a folder of images (in itself or in its images/) with a camera.yaml"
DEFAULT_RATE_HZ = 30.0

_log = logging.getLogger(__name__)


def recognises(path: Path) -> bool:
    """Whether the path is a folder that holds images or a camera."""
    return path.is_dir() and ((path / camera_file.NAME).is_file() or bool(list_images(path)))


def read(path: Path, calibration: Path | None) -> ImageSequence:
    """Open the folder.

    Args:
        path: the folder.
        calibration: a camera file in place of the folder's.

    Raises:
        InputError: there is no image or no camera, or a file is not as described above.
    """
    files = list_images(path)
    if not files:
        raise InputError(f"{path}: expected images in it or in its images/, found none.")
    camera = camera_file.find_calibration(path, calibration)
    shape = first_shape(files, path)
    camera.require_shape(shape, str(path))
    stamps_ns = _stamps(path / "times.txt", len(files), camera)
    return ImageSequence(
        name=path.resolve().name,
        camera=camera.camera,
        stamps_ns=stamps_ns,
        truth=read_tum_truth(path / "groundtruth.txt", stamps_ns),
        baseline_m=None,
        source=FileImages(stamps_ns, shape, files),
    )


def list_images(path: Path) -> list[Path]:
    """Images in the folder, or if there is none in its `images`, in the order of their names."""
    for folder in (path, path / "images"):
        if folder.is_dir():
            found = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES]
            if found:
                return sorted(found, key=_natural)
    return []


def evenly(count: int, rate_hz: float) -> np.ndarray:
    """(count,) int64 stamps from 0 at a rate."""
    return np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def read_times(path: Path, count: int, hint: str) -> np.ndarray:
    """(count,) int64 stamps of a file with one time [s] per image.

    Raises:
        InputError: there is another number of times, one is none, or one runs backwards.
    """
    rows = read_stamped(path, hint)
    if len(rows.lines) != count:
        raise InputError(f"{path}: expected {count} times, one per image, found {len(rows.lines)}.")
    return rows.stamps_ns


def _stamps(path: Path, count: int, camera: camera_file.Calibration) -> np.ndarray:
    if path.exists():
        return read_times(path, count, KIND)
    if camera.rate_hz is None:
        _log.info(
            "%s: no times.txt and no rate_hz in %s, taken as %g Hz",
            path.parent,
            camera.where,
            DEFAULT_RATE_HZ,
        )
    return evenly(count, camera.rate_hz or DEFAULT_RATE_HZ)


def _natural(path: Path) -> tuple[list[str | int], str]:
    parts = re.split(r"(\d+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name
