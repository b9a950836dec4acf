"""Keypoints of the difference of Gaussians with SIFT descriptors (D. Lowe, IJCV 60(2), 2004), the features of S05 §III-A.

OpenCV does both.

A descriptor has 128 entries: 4 × 4 spatial windows of 8 orientations each; or 36, as S05 has it: 3 × 3 windows of 4
orientations. S05 does not say how its descriptors were formed. Here adjacent windows are added two by two in both
directions, overlapping, so that 4 become 3; and with h_o the histogram entry at o · 45°, the entry at o · 90° becomes h_2o
+ (h_2o−1 + h_2o+1) / 2, so that each of the 8 has the same total weight and the result is mirror symmetric.

Entries are then scaled to length 1 ("sift"), or to sum 1 and their roots taken ("root"), which makes the product of
two descriptors the Bhattacharyya coefficient of two histograms (R. Arandjelović, A. Zisserman, CVPR 2012). Either way
|a − b|² = 2 − 2 aᵀb.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, final

import numpy as np

from rbpf.ranges import CountOrNone, NotNegative, Range, Ranged
from rbpf.sensors.features.interface import Descriptor, FeatureExtractor, Features, Keypoints, checked_image

_SIGMA = 1.6  #: Blur of the first image of an octave; OpenCV's default, which is Lowe's.


@dataclass(frozen=True)
class SiftConfig(Ranged):
    """Settings of the detector and of the descriptors."""

    features: CountOrNone = 1000  #: maximum number of keypoints per image, those of highest contrast; 0 for all.
    #: factor by which the image is resized before detection, 0.5 for half of each side; pixels and scales refer to the
    #: original image.
    working_scale: Annotated[float, Range(gt=0.0, le=1.0)] = 0.5
    #: least contrast of an extremum; OpenCV's unit, Lowe's 0.03 is 0.09 with three layers.
    contrast: NotNegative = 0.04
    edge: Annotated[float, Range(gt=1.0)] = 10.0  #: largest ratio of principal curvatures.
    layers: Annotated[int, Range(ge=1, le=20)] = 3  #: scales per octave.
    length: Literal[36, 128] = 36  #: of a descriptor, 36 or 128.
    norm: Literal["root", "sift"] = "root"  #: "root" or "sift", see the module.


@final
class Sift(FeatureExtractor, Descriptor):
    """Detects and describes keypoints."""

    def __init__(self, config: SiftConfig | None = None) -> None:
        self.config = config or SiftConfig()
        self.length = self.config.length

    def __getstate__(self) -> dict[str, Any]:
        return {"config": self.config, "length": self.length}  # OpenCV's detector cannot be copied

    def extract(self, image: np.ndarray) -> Features:
        """A position with two dominant orientations gives two keypoints."""
        config = self.config
        reduced = self._reduced(image)
        found, histograms = self._sift.detectAndCompute(reduced, None)
        if not found:
            none = np.zeros(0)
            return Features(np.zeros((0, 2)), none, none, none, np.zeros((0, config.length), dtype=np.float32))
        table = np.array([(*p.pt, p.size, p.angle, p.response) for p in found])
        features = Features(
            px=(table[:, :2] + 0.5) / config.working_scale - 0.5,
            scale=0.5 * table[:, 2] / config.working_scale,
            orientation=np.deg2rad(table[:, 3]) % (2.0 * np.pi),
            score=table[:, 4],
            descriptors=descriptors_from_histograms(histograms, config.length, config.norm),
        )
        # OpenCV returns the strongest in no particular order, and more in case of ties.
        order = np.lexsort((features.orientation, features.px[:, 0], features.px[:, 1], -features.score))
        return features.take(order[: config.features or None])

    def describe(self, image: np.ndarray, keypoints: Keypoints) -> np.ndarray:
        """On the unresized image, at the keypoints' scale and orientation."""
        import cv2

        config = self.config
        reduced = self._reduced(image)
        if not len(keypoints):
            return np.zeros((0, config.length), dtype=np.float32)
        px = (keypoints.px + 0.5) * config.working_scale - 0.5
        size = 2.0 * config.working_scale * keypoints.scale
        degrees = np.rad2deg(keypoints.orientation) % 360.0
        places = [cv2.KeyPoint(*place) for place in np.column_stack([px, size, degrees]).tolist()]
        _, histograms = self._sift.compute(reduced, places)
        return descriptors_from_histograms(histograms, config.length, config.norm)

    def _reduced(self, image: np.ndarray) -> np.ndarray:
        image, ratio = checked_image(image), self.config.working_scale
        if ratio == 1.0:
            return image
        import cv2

        return cv2.resize(image, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA)

    @cached_property
    def _sift(self) -> Any:
        import cv2

        config = self.config
        # Without precise upscaling all keypoints are off by a quarter of a pixel.
        return cv2.SIFT.create(config.features, config.layers, config.contrast, config.edge, _SIGMA, True)


def descriptors_from_histograms(histograms: np.ndarray, length: int, norm: str = "root") -> np.ndarray:
    """Descriptors (K, length) float32 of length 1, of SIFT histograms (K, 128) ordered by row, column and orientation."""
    descriptors = histograms.astype(np.float32)
    if length == 36:
        descriptors = pooled(descriptors)
    if norm == "root":
        descriptors = np.sqrt(descriptors)
    return descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), np.float32(1e-9))


def pooled(histograms: np.ndarray) -> np.ndarray:
    """Histograms (K, 36) of 3 × 3 × 4 from (K, 128) of 4 × 4 × 8, as the module describes."""
    cells = histograms.reshape(-1, 4, 4, 8)
    beside = 0.5 * (np.roll(cells, 1, axis=3) + np.roll(cells, -1, axis=3))
    turns = (cells + beside)[..., ::2]
    lines = turns[:, :-1] + turns[:, 1:]
    return (lines[:, :, :-1] + lines[:, :, 1:]).reshape(-1, 36)
