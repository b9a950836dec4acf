"""Interfaces of keypoint detectors and descriptors: the classes to subclass for another front end.

- `Detector`: proposes and scores keypoints. The base class chooses the best, spread over the image.
- `Descriptor`: vectors of length 1 whose distance tells whether two keypoints show the same point.
- `FeatureExtractor`: both at once, as used by the stereo system; `Extractor` combines any two.

Pixels are (column, row), with the centre of the top-left one at (0, 0). Images are grey, (H, W) uint8.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf.arrays import RowByRow
from rbpf.errors import InputError

#: Scale of a keypoint whose SIFT descriptor covers a window of 31 × 31 px; that of corners, which have none.
WINDOW_SCALE_PX = 2.0
#: Padding of windows that are described in one mosaic, by copies of their borders: descriptors may blur the image.
SHEET_PAD_PX = 6


@dataclass(frozen=True)
class Keypoints(RowByRow):
    """Keypoints of an image, best first."""

    px: np.ndarray  #: (K, 2) pixel.
    scale: np.ndarray  #: (K,) standard deviation of the Gaussian at which each was detected, px.
    orientation: np.ndarray  #: (K,) direction, [0, 2π), from the columns' axis towards the rows'.
    score: np.ndarray  #: (K,) of the detector, in its unit.

    @classmethod
    def at(
        cls,
        px: np.ndarray,
        scale: np.ndarray | float = WINDOW_SCALE_PX,
        orientation: np.ndarray | float = 0.0,
        score: np.ndarray | float = 0.0,
    ) -> "Keypoints":
        """Keypoints at pixels (K, 2); scalars apply to all."""
        count = px.shape[0]
        one_each = (np.broadcast_to(np.asarray(value, float), count) for value in (scale, orientation, score))
        return Keypoints(np.asarray(px, float), *one_each)


@final
@dataclass(frozen=True)
class Features(Keypoints):
    """Keypoints of an image with their descriptors, best first."""

    descriptors: np.ndarray  #: (K, d) float32 of length 1.


class Detector(ABC):
    """Finds keypoints.

    A subclass proposes candidates and scores them; the common `detect` chooses among them.
    """

    margin_px: int = 0  #: Pixels around a keypoint that `candidates` reads.

    @abstractmethod
    def candidates(self, image: np.ndarray, margin_px: int, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Local maxima of the detector's response.

        Args:
            image: (H, W) uint8.
            margin_px: least distance of candidates from the outermost pixels' centres; the image is larger than twice this.
            mask: (H, W) bool, where a candidate may be; None for everywhere.

        Returns:
            Pixels (M, 2) and scores (M,). Ties are broken by this order.
        """

    @final
    def detect(
        self,
        image: np.ndarray,
        count: int,
        occupied: np.ndarray | None = None,
        spacing_px: float = 20.0,
        border_px: float = 16.0,
        mask: np.ndarray | None = None,
    ) -> Keypoints:
        """The best keypoints, best first, at least `spacing_px` from each other and from occupied pixels.

        Args:
            image: (H, W) uint8.
            count: maximum number.
            occupied: (M, 2) pixels of features already in the image; those that are not finite are ignored.
            spacing_px: the least distance.
            border_px: the least distance from the outermost pixels' centres.
            mask: (H, W) bool, where a keypoint may be; None for everywhere.

        Raises InputError: the image is not (H, W) uint8, or the occupied pixels are not (M, 2).
        """
        from rbpf.sensors.features.kernels import choose_apart

        image = checked_image(image)
        taken = np.zeros((0, 2)) if occupied is None else np.asarray(occupied, float)
        if taken.ndim != 2 or taken.shape[1] != 2:
            raise InputError(f"occupied pixels must be (M, 2), got {taken.shape}")
        margin = int(np.ceil(max(border_px, self.margin_px)))
        if min(image.shape) <= 2 * margin:
            return Keypoints.at(np.zeros((0, 2)))
        px, score = self.candidates(image, margin, mask)
        # Greedy: take the best free one, which blocks all those too close to it.
        order, chosen = np.argsort(-score, kind="stable"), np.empty(count, dtype=np.int64)
        px, taken = px[order].astype(float), np.ascontiguousarray(taken[np.isfinite(taken).all(axis=1)])
        chosen = chosen[: choose_apart(px, taken, spacing_px, chosen)]
        return Keypoints.at(px[chosen], score=score[order[chosen]])


class Descriptor(ABC):
    """Describes keypoints, so that they are recognised without a predicted position."""

    length: int  #: Entries of a descriptor.

    @abstractmethod
    def describe(self, image: np.ndarray, keypoints: Keypoints) -> np.ndarray:
        """Descriptors (K, length) float32 of length 1: |a − b|² = 2 − 2 aᵀb.

        Args:
            image: (H, W) uint8.
            keypoints: K keypoints, with the scale and the orientation for their descriptors.

        Raises InputError: the image is not (H, W) uint8.
        """

    @final
    def describe_windows(self, windows: np.ndarray, scale: np.ndarray, orientation: np.ndarray) -> np.ndarray:
        """Descriptors (K, length) of the centres of windows (K, S, S) uint8, each at its own scale and orientation (K,)."""
        count, size = windows.shape[:2]
        columns = max(1, int(np.ceil(np.sqrt(count))))
        lines, side = -(-count // columns), size + 2 * SHEET_PAD_PX
        tiles = np.zeros((lines * columns, side, side), dtype=np.uint8)
        pad = (SHEET_PAD_PX, SHEET_PAD_PX)
        tiles[:count] = np.pad(windows, ((0, 0), pad, pad), mode="edge")
        sheet = tiles.reshape(lines, columns, side, side).swapaxes(1, 2).reshape(lines * side, columns * side)
        line, column = np.divmod(np.arange(count), columns)
        centres = np.stack([column, line], axis=-1) * side + 0.5 * (side - 1)
        return self.describe(sheet, Keypoints.at(centres, scale, orientation))


class FeatureExtractor(ABC):
    """Detects and describes keypoints."""

    length: int  #: Entries of a descriptor.

    @abstractmethod
    def extract(self, image: np.ndarray) -> Features:
        """Features of an image (H, W) uint8, best first; none without texture.

        Raises InputError: the image is not (H, W) uint8.
        """


@final
@dataclass(eq=False)
class Extractor(FeatureExtractor):
    """Combines any detector with any descriptor."""

    detector: Detector
    descriptor: Descriptor
    count: int = 1000  #: most keypoints per image.
    spacing_px: float = 5.0  #: least distance from each other.
    border_px: float = 16.0  #: least distance from the image's border.

    def __post_init__(self) -> None:
        self.length = self.descriptor.length

    def extract(self, image: np.ndarray) -> Features:
        found = self.detector.detect(image, self.count, None, self.spacing_px, self.border_px)
        descriptors = self.descriptor.describe(image, found)
        return Features(found.px, found.scale, found.orientation, found.score, descriptors)


def checked_image(image: np.ndarray) -> np.ndarray:
    """The image, contiguous in memory. Raises InputError: it is not (H, W) uint8."""
    if not isinstance(image, np.ndarray) or image.ndim != 2 or image.dtype != np.uint8:
        found = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        raise InputError(f"an image must be grey, (H, W) uint8, got {found}: convert it first")
    return np.ascontiguousarray(image)
