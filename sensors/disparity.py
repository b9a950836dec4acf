"""Where a place of the left image is in the right one, to a fraction of a pixel, on the same row of a rectified pair.

A window around the place is moved along the row of the right image until the squared difference of the two is least,
brightness and contrast of the windows left free (Gauss-Newton; B. Lucas, T. Kanade 1981, in one dimension). Images are
interpolated linearly between pixels.
"""

from dataclasses import dataclass
from typing import final

import numpy as np

ITERATIONS = 5
"""Steps; a keypoint is within a pixel of its place, from where three are enough."""
LONGEST_PX = 1.0
"""Of a step."""
_TINY = 1e-9


@final
@dataclass(frozen=True)
class SubpixelMatches:
    """Places in the right image.

    Attributes:
        u: (K,) column there, px; NaN where a window reaches beyond its image.
        correlation: (K,) of the two windows, normalised, −1 to 1; 0 where there is no u or no texture.
    """

    u: np.ndarray
    correlation: np.ndarray


def refine(
    left: np.ndarray, right: np.ndarray, px: np.ndarray, u_right: np.ndarray, half_px: int = 5
) -> SubpixelMatches:
    """Refines columns u_right (K,), at which places px (K, 2) of the left image are in the right one.

    Args:
        left: (H, W) uint8.
        right: (H, W) uint8.
        px: (K, 2) places in the left image.
        u_right: (K,) columns, good to a pixel or two.
        half_px: the window has 2 half_px + 1 pixels along each side.
    """
    u, v = u_right.astype(float), px[:, 1]
    template = _centred(_windows(left, px[:, 0], v, half_px, half_px))
    energy = np.maximum(_dot(template, template), _TINY)
    for _ in range(ITERATIONS):
        wide = _windows(right, u, v, half_px, half_px + 1)
        slope = _centred(0.5 * (wide[:, :, 2:] - wide[:, :, :-2]))
        window = _centred(wide[:, :, 1:-1])
        gain = _dot(template, window) / energy
        miss = gain[:, None, None] * template - window
        step = _dot(slope, miss) / np.maximum(_dot(slope, slope), _TINY)
        u = u + np.clip(step, -LONGEST_PX, LONGEST_PX)
    window = _centred(_windows(right, u, v, half_px, half_px))
    correlation = _dot(template, window) / np.sqrt(energy * np.maximum(_dot(window, window), _TINY))
    whole = _inside(left, px[:, 0], v, half_px) & _inside(right, u, v, half_px)
    return SubpixelMatches(np.where(whole, u, np.nan), np.where(whole, correlation, 0.0))


def _windows(image: np.ndarray, u: np.ndarray, v: np.ndarray, high: int, wide: int) -> np.ndarray:
    """(K, 2 high + 1, 2 wide + 1) float32 around places between pixels; the border goes on beyond the image."""
    column, line = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    across = (u - column).astype(np.float32)[:, None, None]
    down = (v - line).astype(np.float32)[:, None, None]
    columns = np.clip(column[:, None] + np.arange(-wide, wide + 2), 0, image.shape[1] - 1)
    lines = np.clip(line[:, None] + np.arange(-high, high + 2), 0, image.shape[0] - 1)
    pixels = image[lines[:, :, None], columns[:, None, :]].astype(np.float32)
    pixels = pixels[:, :-1] + down * (pixels[:, 1:] - pixels[:, :-1])
    return pixels[:, :, :-1] + across * (pixels[:, :, 1:] - pixels[:, :, :-1])


def _centred(windows: np.ndarray) -> np.ndarray:
    return windows - windows.mean(axis=(1, 2), keepdims=True)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("kij,kij->k", a, b)


def _inside(image: np.ndarray, u: np.ndarray, v: np.ndarray, half_px: int) -> np.ndarray:
    height, width = image.shape
    across = (u >= half_px) & (u <= width - 1 - half_px)
    return across & (v >= half_px) & (v <= height - 1 - half_px)
