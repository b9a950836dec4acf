"""Video files that OpenCV's FFmpeg can decode, with a `camera.yaml` beside the video or given.

The number of images and their rate are those of the file's header, unless `camera.yaml` has `rate_hz`. A header without
a number, or with one that the file is too small for, is counted by going through the video once. A video that ends
before its last announced image ends with a frame that has none and says so.
"""

from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images.calibration import find_calibration
from rbpf.sensors.readers.images.decoding import UnreadableImageError, require_shape, to_grey
from rbpf.sensors.readers.images.files import decode_ahead
from rbpf.sensors.readers.images.folder import DEFAULT_RATE_HZ, evenly
from rbpf.sensors.readers.images.sequence import ImageFrame, ImageSequence, Source

SUFFIXES = frozenset(
    {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".webm", ".wmv", ".y4m"}
)
KIND = "a video file (.mp4, .avi, .mkv, .mov, .webm, ...) with a camera.yaml beside it"

_ACTION = "convert it, or copy it again if its end is missing"


@dataclass(frozen=True)
class VideoImages(Source):
    """The images of a video.

    Attributes:
        path: the file.
        stamps_ns: (T,) int64 times.
        shape: height and width of its first image.
    """

    path: Path
    stamps_ns: np.ndarray
    shape: tuple[int, int]

    def frames(self, start: int) -> Generator[ImageFrame]:
        with opened(self.path) as capture:
            # Jumping to an image is inexact in most codecs, going through those before it is not.
            if not all(capture.grab() for _ in range(start)):
                return
            indices = range(start, len(self.stamps_ns))
            with closing(decode_ahead(lambda index: self._next(capture, index), indices)) as frames:
                for frame in frames:
                    yield frame
                    if frame.image is None:
                        return

    def _next(self, capture: Any, index: int) -> ImageFrame:
        stamp = int(self.stamps_ns[index])
        there, image = capture.read()
        if not there:
            problem = (
                f"{self.path}: the video ends after {index} of {len(self.stamps_ns)} images; those are kept."
            )
            return ImageFrame(stamp, None, problem=problem)
        try:
            return ImageFrame(stamp, require_shape(self.path, to_grey(self.path, image), self.shape))
        except UnreadableImageError as error:
            return ImageFrame(stamp, None, problem=str(error))


def recognises(path: Path) -> bool:
    """Whether the path is a file with the ending of a video."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def read(path: Path, calibration: Path | None) -> ImageSequence:
    """Open the video.

    Args:
        path: the file.
        calibration: a camera file in place of the one beside it.

    Raises:
        InputError: the video cannot be decoded, or the camera file is missing or does not fit.
    """
    camera = find_calibration(path.parent, calibration)
    count, rate_hz, shape = video_header(path)
    camera.require_shape(shape, str(path))
    stamps_ns = evenly(count, camera.rate_hz or rate_hz or DEFAULT_RATE_HZ)
    return ImageSequence(
        name=path.stem,
        camera=camera.camera,
        stamps_ns=stamps_ns,
        truth=None,
        baseline_m=None,
        source=VideoImages(path, stamps_ns, shape),
    )


def video_header(path: Path) -> tuple[int, float, tuple[int, int]]:
    """Number of images, their rate [Hz] or 0 where it is not told, height and width.

    Raises:
        InputError: no image can be decoded.
    """
    import cv2

    with opened(path) as capture:
        count, rate_hz = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        there, image = capture.read()
        if not there:
            raise InputError(f"{path}: not one image of the video can be decoded; {_ACTION}.")
        # A header may claim what it likes; no image takes less than a byte.
        if not 0 < count <= path.stat().st_size:
            count = 1
            while capture.grab():
                count += 1
    return int(count), rate_hz if 0.0 < rate_hz < np.inf else 0.0, image.shape[:2]


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """OpenCV's decoder of a video, closed at the end.

    Raises:
        InputError: it cannot be opened.
    """
    import cv2

    # Other backends take the number in a name such as 000001 for a pattern of images.
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise InputError(f"{path}: OpenCV cannot open the video; {_ACTION}.")
        yield capture
    finally:
        capture.release()
