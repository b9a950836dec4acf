"""What every reader of images returns: the camera, the times, the truth if known, and a stream of images."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self, final

import numpy as np

from rbpf.core.checkpoint import require, stamps
from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.format import Format

TOLERANCE_S = 0.005  #: Largest time difference of two images that form a pair.


@dataclass(frozen=True)
class ImageFrame:
    """One image or a pair, or a placeholder for one that could not be read."""

    stamp_ns: int  #: time of the image, integer nanoseconds.
    image: np.ndarray | None  #: (H, W) uint8 grey; None if it could not be read.
    #: (H, W) uint8 grey, the second camera of a stereo sequence; None if there is none.
    right: np.ndarray | None = None
    problem: str | None = None  #: one sentence that says why an image is missing; else None.


class Source(ABC):
    """The source of a sequence's images."""

    @abstractmethod
    def frames(self, start: int) -> Iterator[ImageFrame]:
        """Images from number `start` on, each decoded when it is needed or shortly before."""


@final
@dataclass(frozen=True)
class ImageSequence:
    """A recording of a camera or of a rectified stereo pair.

    Only the first image is decoded before `frames` is called. Raises InputError: the stamps are not whole
    numbers in order; the camera of a pair is distorted, or its baseline is not positive.
    """

    name: str  #: short name of the recording.
    camera: Pinhole  #: of the (left) images that `frames` yields.
    #: (T,) int64 times of the images, not decreasing; equal ones are allowed.
    stamps_ns: np.ndarray
    #: world_from_camera of the (left) camera at its own stamps, without landmarks; None where unknown.
    truth: Truth | None
    baseline_m: float | None  #: of a rectified stereo pair, None for one camera.
    source: Source  #: where the images come from.
    notes: tuple[str, ...] = ()  #: one sentence for each omission or change.

    def __post_init__(self) -> None:
        """Validates the fields, as a sequence may be made by hand."""
        if self.baseline_m is not None:
            RectifiedStereo(self.camera, self.baseline_m)
        require(self.name, vars(self), {"stamps_ns": stamps("T")})

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def rig(self) -> RectifiedStereo:
        """The two cameras of a stereo sequence. Raises InputError: there is one camera."""
        if self.baseline_m is None:
            raise InputError(f"{self.name}: a sequence of one camera has no stereo rig; open it by open_stereo")
        return RectifiedStereo(self.camera, self.baseline_m)

    def frames(self, start: int = 0) -> Iterator[ImageFrame]:
        """Images, or pairs of one size, in order of time, from number `start` on.

        A frame with an unreadable image comes without it, with a `problem`. A video that ends before its last announced
        image ends with such a frame. Raises InputError: there is no image of that number.
        """
        if not 0 <= start < len(self):
            raise InputError(f"{self.name}: expected a start from 0 to {len(self) - 1}, got {start}.")
        return self.source.frames(start)


@final
@dataclass(frozen=True)
class Topics:
    """Names of streams in a recording that holds several, as a ROS bag does."""

    images: tuple[str, ...] = ()  #: one, or a left and a right one; empty to use the recording's own.
    truth: str | None = None  #: the stream of the camera's true poses; or None.

    @classmethod
    def parse(cls, images: str | None = None, truth: str | None = None) -> Self:
        """The topics of a command line or a run's config.yaml: one name or two with a comma between them, and the truth's.

        Raises InputError: there are more than two, or a name is empty.
        """
        names = () if images is None else tuple(name.strip() for name in images.split(","))
        if len(names) > 2 or not all(names) or truth == "":
            raise InputError(f"expected an image topic, or two as LEFT,RIGHT, got {images!r} and truth {truth!r}")
        return cls(names, truth)

    def entries(self) -> dict[str, str]:
        """The entries for a run's config.yaml, which `parse` reads."""
        named = {"image_topic": ",".join(self.images), "truth_topic": self.truth}
        return {name: value for name, value in named.items() if value}


UNNAMED = Topics()


@final
@dataclass(frozen=True)
class ReadOptions:
    """A caller's options for reading a recording."""

    calibration: Path | None = None  #: a `camera.yaml` to use instead of the recording's own calibration.
    topics: Topics = UNNAMED  #: topics of a ROS bag, if they have to be named.
    tolerance_s: float = TOLERANCE_S  #: largest time difference of two images that form a pair.
    stereo: bool = False  #: whether both cameras are read; needs a format with a `stereo_kind`.


class ImageFormat(Format[ReadOptions, ImageSequence]):
    """A format of image sequences: of one camera, the left one of two, or of two cameras, rectified."""

    stereo_kind: str = ""  #: As `kind`, of a recording of two cameras; empty if the format has one camera only.
    has_topics: bool = False  #: Whether its streams have names.
