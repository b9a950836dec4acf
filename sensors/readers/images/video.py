"""Video files that OpenCV's FFmpeg can decode, with a `camera.yaml` beside the video or given.

The number of images and their rate are those of the file's header, unless `camera.yaml` has `rate_hz`. A header without
a number, or with one that the file is too small for, is counted by going through the video once. A video that ends
before its last announced image ends with a frame that has none and says so.

Beside them a camera at this computer, as a source of images that ends when it is unplugged or somebody presses Ctrl-C.
"""

import os
import signal
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images.calibration import find_calibration, read_calibration
from rbpf.sensors.readers.images.decoding import (
    Grey,
    UnreadableImageError,
    decode_ahead,
    read_grey,
    require_shape,
    to_grey,
)
from rbpf.sensors.readers.images.folders import DEFAULT_RATE_HZ, evenly, list_images
from rbpf.sensors.readers.images.sequence import ImageFormat, ImageFrame, ImageSequence, ReadOptions, Source

SUFFIXES = frozenset(
    {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".webm", ".wmv", ".y4m"}
)

_ACTION = "convert it, or copy it again if its end is missing"


@final
class Video(ImageFormat):
    """Video files."""

    kind = "a video file (.mp4, .avi, .mkv, .mov, .webm, ...) with a camera.yaml beside it"

    def recognises(self, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in SUFFIXES

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        camera = find_calibration(path.parent, options.calibration)
        count, rate_hz, shape = video_header(path)
        camera.require_shape(shape, str(path))
        stamps_ns = evenly(count, camera.rate_hz or rate_hz or DEFAULT_RATE_HZ)
        source = VideoImages(path, stamps_ns, shape)
        return ImageSequence(path.stem, camera.camera, stamps_ns, None, None, source)


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
            kept = f"the video ends after {index} of {len(self.stamps_ns)} images; those are kept"
            return ImageFrame(stamp, None, problem=f"{self.path}: {kept}.")
        try:
            return ImageFrame(stamp, require_shape(self.path, to_grey(self.path, image), self.shape))
        except UnreadableImageError as error:
            return ImageFrame(stamp, None, problem=str(error))


def video_header(path: Path) -> tuple[int, float, tuple[int, int]]:
    """Number of images, their rate [Hz] or 0 where it is not given, height and width."""
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
    """OpenCV's decoder of a video, closed at the end."""
    import cv2

    # Other backends take the number in a name such as 000001 for a pattern of images.
    # An absolute path is never taken for a URL, and no file may send the decoder to another one over the network.
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


class NamedImage(NamedTuple):
    """An image (H, W) of a camera that is not known yet, and what it is called in messages."""

    name: str
    image: Grey


def read_uncalibrated(path: Path, most: int) -> tuple[int, Iterator[NamedImage]]:
    """Up to `most` images, evenly spread, of a video or of a folder that has them in it or in its `images`.

    Returns:
        How many there will be at most, and those of them that can be read.

    Raises:
        InputError: there is nothing of that name, or no image in it.
    """
    video = path.is_file() and path.suffix.lower() in SUFFIXES
    if not (video or path.is_dir()):
        found = "is neither a folder nor a video" if path.exists() else "no such file or folder"
        raise InputError(
            f"{path}: {found}; expected a folder of images, or a video ({', '.join(sorted(SUFFIXES))})"
        )
    files = [] if video else list_images(path)
    if not (video or files):
        raise InputError(f"{path}: expected images in it or in its images/, found none")
    count = video_header(path)[0] if video else len(files)
    chosen = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
    if video:
        return len(chosen), _of_video(path, set(chosen.tolist()))
    return len(chosen), _of_files([files[k] for k in chosen])


def _of_files(files: list[Path]) -> Iterator[NamedImage]:
    for file in files:
        try:
            image = read_grey(file)
        except UnreadableImageError:
            continue
        yield NamedImage(file.name, image)


def _of_video(path: Path, chosen: set[int]) -> Iterator[NamedImage]:
    with opened(path) as capture:
        for index in range(max(chosen) + 1):
            if not capture.grab():
                return
            if index in chosen:
                there, image = capture.retrieve()
                if there:
                    yield NamedImage(f"image {index}", to_grey(path, image))


def camera_number(path: Path) -> int | None:
    """The number of a camera, where a recording is given as one and no file has that name."""
    return int(str(path)) if str(path).isdecimal() and not path.exists() else None


@final
class LiveCamera:
    """The images of an attached camera, each the newest one when it is asked for.

    Args:
        number: as OpenCV counts cameras, from 0.
        calibration: its camera.yaml.

    Raises:
        InputError: there is no calibration, no such camera, or it gives images of another size.
    """

    stamps_ns = None
    truth = None

    def __init__(self, number: int, calibration: Path | None) -> None:
        import cv2

        if calibration is None:
            raise InputError(
                f"camera {number} needs --calibration camera.yaml; rbpf calibrate makes it from pictures of a chessboard"
            )
        self.name, calibrated = f"camera {number}", read_calibration(calibration)
        self.camera = calibrated.camera
        self._capture: Any = cv2.VideoCapture(number)
        if not self._capture.isOpened():
            raise InputError(f"there is no camera {number}, or another program uses it")
        # One image in the driver's queue: what waits there would be old by the time it is filtered.
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.camera.width)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.camera.height)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._first = self._next()
        if self._first is None or self._first.image is None:
            raise InputError(f"{self.name} gives no image")
        calibrated.require_shape(self._first.image.shape, self.name)

    def frames(self, start: int = 0) -> Iterator[ImageFrame]:
        """Images until the camera is gone or Ctrl-C is pressed; the first one is that which the run was started from."""
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
