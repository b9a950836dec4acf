"""What every reader of images returns: the camera, the times, the truth where known, and images one after the other."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import CameraTruth


@dataclass(frozen=True)
class ImageFrame:
    """One image, or the place of one that could not be read.

    Attributes:
        stamp_ns: time of the image, integer nanoseconds.
        image: (H, W) uint8 grey; None where it could not be read.
        right: (H, W) uint8 grey, the second camera of a stereo sequence; None where there is none.
        problem: one sentence that says why an image is missing; None where none is.
    """

    stamp_ns: int
    image: np.ndarray | None
    right: np.ndarray | None = None
    problem: str | None = None


class Source(ABC):
    """Where the images of a sequence come from."""

    @abstractmethod
    def frames(self, start: int) -> Iterator[ImageFrame]:
        """Images from number `start` on, each decoded when it is needed or shortly before."""


@dataclass(frozen=True)
class ImageSequence:
    """A recording of a camera; nothing of it but its first image is decoded before `frames` is called.

    Attributes:
        name: short name of the recording.
        camera: of the (left) images as they come out of `frames`.
        stamps_ns: (T,) int64 times of the images, not decreasing; equal ones, between which no time passes, occur.
        truth: world_from_camera of the (left) camera at its own stamps, without landmarks; None where unknown.
        baseline_m: of a rectified stereo pair, None where there is one camera.
        source: where the images come from.

    Raises:
        InputError: the stamps are no whole numbers, or one is before the one it follows.
    """

    name: str
    camera: Pinhole
    stamps_ns: np.ndarray
    truth: CameraTruth | None
    baseline_m: float | None
    source: Source

    def __post_init__(self) -> None:
        """Checks the stamps: a sequence may be made by hand."""
        stamps = np.asarray(self.stamps_ns)
        if stamps.ndim != 1 or stamps.dtype.kind not in "iu":
            raise InputError(
                f"{self.name}: stamps_ns must be (T,) whole numbers, got {stamps.shape} {stamps.dtype}"
            )
        if (late := np.flatnonzero(np.diff(stamps) < 0)).size:
            raise InputError(f"{self.name}: the stamp of image {late[0] + 1} is before the one it follows")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def frames(self, start: int = 0) -> Iterator[ImageFrame]:
        """Images in order of time.

        A frame that cannot be read comes without an image and with the problem. A video that ends before its last
        announced image ends with such a frame.

        Args:
            start: number of the first image, from 0.

        Raises:
            InputError: there is no image of that number.
        """
        if not 0 <= start < len(self):
            raise InputError(f"{self.name}: expected a start from 0 to {len(self) - 1}, got {start}.")
        return self.source.frames(start)
