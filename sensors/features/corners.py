"""Corner detector for landmarks: FAST (E06 §5.1) with the Shi-Tomasi score."""

from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.features.interface import Detector, checked_image

WINDOW_PX = 9  #: The score uses 9 × 9 px: a template of 11 × 11 px without its border.
_FAST_RADIUS_PX = 3


@final
class CornerDetector(Detector):
    """FAST corners, scored by the least eigenvalue of the structure tensor.

    The score is the root of the least eigenvalue of the mean of ∇I ∇Iᵀ over a window (Shi and Tomasi), in grey levels per
    pixel: the gradient available to a match in its weakest direction. Image noise σ localises a template of 11 × 11 px to
    about σ √2 / (11 score) px. Among adjacent FAST pixels the one of the highest score is the corner. Corners are at whole
    pixels; ties are ordered by row, then column.

    Args:
        fast_threshold: grey levels by which FAST's arc must differ from the corner's pixel.
        min_score: the lowest score.
    """

    margin_px = WINDOW_PX // 2 + 1

    def __init__(self, fast_threshold: int = 10, min_score: float = 4.0) -> None:
        self.fast_threshold = fast_threshold
        self.min_score = min_score

    def candidates(self, image: np.ndarray, margin_px: int, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        from rbpf.sensors.features.kernels import highest

        # FAST without its own suppression, which drops all of several equal neighbours (in ideal or saturated images).
        first = margin_px - _FAST_RADIUS_PX
        inner = image[first : image.shape[0] - first, first : image.shape[1] - first]
        found = cv2.FastFeatureDetector.create(self.fast_threshold, False).detect(inner)
        px = np.asarray(cv2.KeyPoint.convert(found), dtype=np.int64).reshape(-1, 2) + first
        px = px[np.argsort(px[:, 1], kind="stable")]  # by row; FAST's order within a row is kept
        if mask is not None:
            px = px[mask[px[:, 1], px[:, 0]]]
        # Corners exceed the minimum score and are not below any neighbouring FAST pixel.
        squared, is_best = _squared_scores(image, px), np.empty(len(px), dtype=bool)
        highest(px, squared, np.full(image.shape, -np.inf), is_best)
        is_best &= squared >= self.min_score**2
        return px[is_best], np.sqrt(squared[is_best])


def corner_score(image: np.ndarray, px: np.ndarray) -> np.ndarray:
    """The score of `CornerDetector` at pixels (K, 2), rounded to integers: (K,) grey levels per pixel.

    Raises InputError: a pixel lies outside the image.
    """
    reach, last = CornerDetector.margin_px, np.array(image.shape[1::-1]) - 1
    if not (np.abs(px - last / 2.0) <= last / 2.0 + 0.5).all():
        raise InputError("a corner score was requested outside the image")
    px = np.clip(np.rint(px), 0, last).astype(np.int64)
    order = np.argsort(px[:, 1], kind="stable")
    squared = np.empty(len(px))
    squared[order] = _squared_scores(np.pad(checked_image(image), reach, mode="reflect"), px[order] + reach)
    return np.sqrt(np.maximum(squared, 0.0))


def _squared_scores(image: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Squared scores (K,) of pixels (K, 2) sorted by row, none of them near the border."""
    from rbpf.sensors.features.kernels import least_eigenvalues

    squared = np.empty(len(px))
    least_eigenvalues(image, np.ascontiguousarray(px), WINDOW_PX, squared)
    return squared
