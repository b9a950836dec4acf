"""Video files that OpenCV's FFmpeg can decode, with a `camera.yaml` beside the video or given.

Each image has the video's own time stamp, unless `camera.yaml` has `rate_hz`: a phone's images are not evenly spaced. To
know the times the video is read once when it is opened. Times that agree with the header's rate to a millisecond are
replaced by exact ones; then a video that ends before the number of images in its header ends with a frame with a `problem`.

A video is rotated by its own rotation flag, as viewers do, and `camera.yaml` is for the images as displayed. One for the
images as stored, recognised by width and height, is rotated with them.

Also a camera attached to this computer, as a source that ends when it is unplugged or on Ctrl-C.
"""

import os
import signal
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images.calibration import NAME, read_calibration
from rbpf.sensors.readers.images.decoding import Grey, decode_ahead, frame_of, read_grey, require_shape, to_grey
from rbpf.sensors.readers.images.folders import DEFAULT_RATE_HZ, evenly, list_images
from rbpf.sensors.readers.images.sequence import ImageFormat, ImageFrame, ImageSequence, ReadOptions, Source

SUFFIXES = frozenset({".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".webm", ".wmv", ".y4m"})

_ROUNDING_NS = 1_000_000  #: Containers round times to milliseconds.
_ACTION = "convert it, or copy it again if its end is missing"


@final
class Video(ImageFormat):
    """Video files."""

    kind = "a video file (.mp4, .avi, .mkv, .mov, .webm, ...) with a camera.yaml beside it"

    def recognises(self, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in SUFFIXES

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        calibration = read_calibration(options.calibration or path.parent / NAME)
        camera, (stamps_ns, shape, quarters) = calibration.camera, read_header(path)
        if calibration.rate_hz is not None:
            stamps_ns = evenly(len(stamps_ns), calibration.rate_hz)
        if quarters % 2 and shape == (camera.width, camera.height) != shape[::-1]:
            calibration = replace(calibration, camera=camera.turned(quarters))
        calibration.require_shape(shape, str(path))
        source = VideoImages(path, stamps_ns, shape)
        return ImageSequence(path.stem, calibration.camera, stamps_ns, None, None, source)


@dataclass(frozen=True)
class VideoImages(Source):
    """The images of a video at times (T,), of the height and width of its first image."""

    path: Path
    stamps_ns: np.ndarray
    shape: tuple[int, int]

    def frames(self, start: int) -> Generator[ImageFrame]:
        with opened(self.path) as capture:
            # Seeking is inexact in most codecs; reading all images before is exact.
            if not all(capture.grab() for _ in range(start)):
                return
            indices = range(start, len(self.stamps_ns))
            with closing(decode_ahead(lambda index: self._next(capture, index), indices)) as frames:
                for frame in frames:
                    yield frame
                    if frame.image is None:
                        return

    def _next(self, capture: Any, index: int) -> ImageFrame:
        def read() -> Grey:
            there, image = capture.read()
            if not there:
                kept = f"the video ends after {index} of {len(self.stamps_ns)} images; those are kept"
                raise InputError(f"{self.path}: {kept}.")
            return require_shape(self.path, to_grey(self.path, image), self.shape)

        return frame_of(self.stamps_ns[index], read)


def read_header(path: Path) -> tuple[np.ndarray, tuple[int, int], int]:
    """Reads times (T,) int64 ns of a video's images, from 0; height and width of the first; and its rotation.

    The rotation is in clockwise quarter turns of the stored images. Raises InputError: the video cannot be opened, or none
    of its images can be decoded.
    """
    import cv2

    with opened(path) as capture:
        announced, rate_hz = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        turned = capture.get(cv2.CAP_PROP_ORIENTATION_META)
        there, image = capture.read()
        if not there:
            raise InputError(f"{path}: not one image of the video can be decoded; {_ACTION}.")
        times_ms = [capture.get(cv2.CAP_PROP_POS_MSEC)]
        while capture.grab():
            times_ms.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    shape, quarters = image.shape[:2], round(turned / 90.0) if np.isfinite(turned) else 0
    rate_hz = rate_hz if 0.0 < rate_hz < np.inf else DEFAULT_RATE_HZ
    own_ns = np.rint(np.nan_to_num(np.array(times_ms) - times_ms[0]) * 1e6).astype(np.int64)
    if (np.diff(own_ns) > 0).all() and np.abs(own_ns - evenly(own_ns.size, rate_hz)).max() > _ROUNDING_NS:
        return own_ns, shape, quarters
    # The image count in a header may be wrong; an image takes at least one byte of the file.
    count = int(announced) if 0 < announced <= path.stat().st_size else own_ns.size
    return evenly(count, rate_hz), shape, quarters


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """OpenCV's decoder of a video, closed at the end."""
    import cv2

    # Other backends take a number in a name such as 000001 as a pattern of image files.
    # An absolute path is never taken for a URL, and no file can make the decoder open network resources.
    name = str(path.absolute())
    try:
        name.encode()
    except UnicodeEncodeError:
        raise InputError(f"{name!a}: a video's name must be text in UTF-8; rename the file.") from None
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file")
    capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise InputError(f"{path}: OpenCV cannot open the video; {_ACTION}.")
        yield capture
    finally:
        capture.release()


def read_uncalibrated(path: Path, most: int) -> tuple[int, Iterator[tuple[str, Grey]]]:
    """The number of images of a video or a folder (or its `images`), and up to `most` of them, evenly spaced.

    Each image comes with its name for messages; unreadable ones are left out. Raises InputError: the path does not exist,
    or has no image.
    """
    video = path.is_file() and path.suffix.lower() in SUFFIXES
    if not (video or path.is_dir()):
        found = "is neither a folder nor a video" if path.exists() else "no such file or folder"
        raise InputError(f"{path}: {found}; expected a folder of images, or a video ({', '.join(sorted(SUFFIXES))})")
    files = [] if video else list_images(path)
    if not (video or files):
        raise InputError(f"{path}: expected images in it or in its images/, found none")
    count = len(read_header(path)[0]) if video else len(files)
    chosen = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))

    def images() -> Iterator[tuple[str, Grey]]:
        for file in [] if video else [files[k] for k in chosen]:
            with suppress(InputError):
                yield file.name, read_grey(file)
        if video:
            with opened(path) as capture:
                for index in range(int(chosen[-1]) + 1):
                    if not capture.grab():
                        return
                    if index in chosen:
                        there, image = capture.retrieve()
                        if there:
                            yield f"image {index}", to_grey(path, image)

    return len(chosen), images()


@final
class LiveCamera:
    """Images of an attached camera; each is the newest at the time of the call.

    Args:
        number: OpenCV's index of the camera, from 0.
        calibration: its camera.yaml.

    Raises InputError: there is no calibration, no such camera, or it gives images of another size.
    """

    stamps_ns = None
    truth = None

    def __init__(self, number: int, calibration: Path | None) -> None:
        import cv2

        if calibration is None:
            raise InputError(f"camera {number} needs --calibration camera.yaml; `rbpf calibrate` makes one")
        self.name, calibrated = f"camera {number}", read_calibration(calibration)
        self.camera = calibrated.camera
        self._capture: Any = cv2.VideoCapture(number)
        if not self._capture.isOpened():
            raise InputError(f"there is no camera {number}, or another program uses it")
        # A driver queue of one image: queued images would be outdated when filtered.
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.camera.width)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.camera.height)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._first = self._next()
        if self._first is None or self._first.image is None:
            raise InputError(f"{self.name} gives no image")
        calibrated.require_shape(self._first.image.shape, self.name)

    def frames(self, start: int = 0) -> Iterator[ImageFrame]:
        """Images until the camera is gone or Ctrl-C is pressed; the first one is that used for initialisation."""
        stopped = threading.Event()
        in_main = threading.current_thread() is threading.main_thread()
        before = signal.signal(signal.SIGINT, lambda *_: stopped.set()) if in_main else None
        try:
            frame = self._first
            while frame is not None and not stopped.is_set():
                yield frame
                frame = self._next()
        finally:
            if in_main:
                signal.signal(signal.SIGINT, before)

    def _next(self) -> ImageFrame | None:
        has_image, image = self._capture.read()
        return ImageFrame(time.monotonic_ns(), to_grey(self.name, image)) if has_image else None
