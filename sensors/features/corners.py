"""Corners of an image that are worth a landmark: FAST (E06 §5.1), scored as Shi and Tomasi do, spread over the image.

Pixels are (column, row), with the centre of the top-left one at (0, 0).
"""

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.patches.search import checked_image

WINDOW_PX = 9
"""The score looks at 9 × 9 px: a template of 11 × 11 px without its border."""
MARGIN_PX = WINDOW_PX // 2 + 1
"""What the score needs around a corner."""
_FAST_RADIUS_PX = 3


def corners(
    image: np.ndarray,
    occupied: np.ndarray,
    count: int,
    spacing_px: float = 20.0,
    border_px: float = 16.0,
    fast_threshold: int = 10,
    min_score: float = 4.0,
    mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The best corners, best first, at least `spacing_px` from each other and from places already taken.

    The score is the root of the least eigenvalue of the mean of ∇I ∇Iᵀ over a window (Shi and Tomasi), in grey levels
    per pixel: the slope that a match can rely on in every direction. Noise σ places a template of 11 × 11 px to about
    σ √2 / (11 score) px. Among neighbouring pixels that FAST finds, the one of the highest score is a corner.

    Args:
        image: (H, W) uint8.
        occupied: (M, 2) places of features already in the image [px]; those that are not finite take no room.
        count: at most so many.
        spacing_px: the least distance.
        border_px: the least distance of a corner from the outermost pixels' centres.
        fast_threshold: grey levels by which FAST's arc must differ from the corner's pixel.
        min_score: the lowest score.
        mask: (H, W) bool, where a corner may be; None for everywhere.

    Returns:
        Places (k, 2) at whole pixels and their scores (k,), k ≤ count. Equal scores go by row, then column.

    Raises:
        InputError: the image is not (H, W) uint8, or the occupied places are not (M, 2).
    """
    from rbpf.sensors.features.kernels import peaks, spread

    image, occupied = checked_image(image), np.asarray(occupied, float)
    if occupied.ndim != 2 or occupied.shape[1] != 2:
        raise InputError(f"occupied places must be (M, 2), got {occupied.shape}")
    margin = int(np.ceil(max(border_px, MARGIN_PX)))
    if min(image.shape) <= 2 * margin:
        return np.zeros((0, 2)), np.zeros(0)
    squares, places = _least_eigenvalues(image), _candidates(image, margin, fast_threshold)
    if mask is not None:
        places = places[mask[places[:, 1], places[:, 0]]]
    kept = np.empty(places.shape[0], np.bool_)
    peaks(squares, places, float(min_score) ** 2, kept)
    places = places[kept]
    found = np.sqrt(squares[places[:, 1], places[:, 0]].astype(float))
    order, chosen = np.argsort(-found, kind="stable"), np.empty(max(count, 0), np.int64)
    taken = np.ascontiguousarray(occupied[np.isfinite(occupied).all(axis=1)])
    chosen = chosen[: spread(places, order, taken, float(spacing_px), chosen)]
    return places[chosen].astype(float), found[chosen]


def corner_score(image: np.ndarray, px: np.ndarray) -> np.ndarray:
    """The score of `corners` at places (K, 2) inside the image, rounded to whole pixels: (K,) grey levels per pixel."""
    column, row = np.rint(px).astype(int).T
    return np.sqrt(np.maximum(_least_eigenvalues(checked_image(image))[row, column], 0.0)).astype(float)


def _least_eigenvalues(image: np.ndarray) -> np.ndarray:
    """Of the mean of ∇I ∇Iᵀ over the window around each pixel, with Sobel's slopes: (H, W) float32."""
    import cv2

    # OpenCV sums squares of Sobel's sums / (4 · window · 255), which are twice the slope.
    squares = cv2.cornerMinEigenVal(image, WINDOW_PX)
    squares *= np.float32(127.5**2)
    return np.asarray(squares)


def _candidates(image: np.ndarray, margin: int, fast_threshold: int) -> np.ndarray:
    """FAST's corners (M, 2) inside the margin, row by row.

    All of them: of equal neighbours, which ideal and saturated images have, FAST's own suppression keeps none.
    """
    import cv2

    first = margin - _FAST_RADIUS_PX
    inner = image[first : image.shape[0] - first, first : image.shape[1] - first]
    found = cv2.FastFeatureDetector.create(fast_threshold, False).detect(inner)
    return np.rint(cv2.KeyPoint.convert(found)).astype(np.int64).reshape(-1, 2) + first
