"""A camera at this computer, as a source of images that ends when it is unplugged or somebody presses Ctrl-C."""

import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

from rbpf.errors import InputError
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.sensors.readers.images.decoding import to_grey
from rbpf.sensors.readers.images.sequence import ImageFrame


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
