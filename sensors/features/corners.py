"""Corners of an image that are worth a landmark: FAST (E06 §5.1), scored as Shi and Tomasi do."""

from typing import final

import numpy as np

from rbpf.sensors.features.interface import Detector, checked_image

WINDOW_PX = 9  #: The score looks at 9 × 9 px: a template of 11 × 11 px without its border.
_FAST_RADIUS_PX = 3


@final
class CornerDetector(Detector):
    """FAST's corners, scored by the least eigenvalue of the structure tensor.

    The score is the root of the least eigenvalue of the mean of ∇I ∇Iᵀ over a window (Shi and Tomasi), in grey levels
    per pixel: the gradient that a match can rely on in every direction. Noise σ places a template of 11 × 11 px to about
    σ √2 / (11 score) px. Among neighbouring pixels that FAST finds, the one of the highest score is a corner.
    Corners are at whole pixels; equal scores go by row, then column.

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

        eigenvalues = _least_eigenvalues(image)
        # All of FAST's corners: of equal neighbours, which ideal and saturated images have, its own suppression keeps none.
        first = margin_px - _FAST_RADIUS_PX
        inner = image[first : image.shape[0] - first, first : image.shape[1] - first]
        found = cv2.FastFeatureDetector.create(self.fast_threshold, False).detect(inner)
        px = np.rint(cv2.KeyPoint.convert(found)).astype(np.int64).reshape(-1, 2) + first
        if mask is not None:
            px = px[mask[px[:, 1], px[:, 0]]]
        # A corner's score is good enough, and the highest among its neighbours that FAST found.
        rated, score = np.full(image.shape, -np.inf, np.float32), eigenvalues[px[:, 1], px[:, 0]]
        rated[px[:, 1], px[:, 0]] = np.where(score >= float(self.min_score) ** 2, score, -np.inf)
        highest = cv2.dilate(rated, np.ones((3, 3), np.uint8))[px[:, 1], px[:, 0]]
        px = px[(rated[px[:, 1], px[:, 0]] == highest) & np.isfinite(highest)]
        return px, np.sqrt(eigenvalues[px[:, 1], px[:, 0]].astype(float))


def corner_score(image: np.ndarray, px: np.ndarray) -> np.ndarray:
    """The score of `CornerDetector` at pixels (K, 2) inside the image, rounded to whole ones: (K,) grey levels per pixel."""
    column, row = np.rint(px).astype(int).T
    return np.sqrt(np.maximum(_least_eigenvalues(checked_image(image))[row, column], 0.0)).astype(float)


def _least_eigenvalues(image: np.ndarray) -> np.ndarray:
    """Of the mean of ∇I ∇Iᵀ over the window around each pixel, with Sobel's derivatives: (H, W) float32."""
    import cv2

    # OpenCV sums squares of Sobel's sums / (4 · window · 255), which are twice the derivative.
    squares = cv2.cornerMinEigenVal(image, WINDOW_PX)
    squares *= np.float32(127.5**2)
    return np.asarray(squares)
