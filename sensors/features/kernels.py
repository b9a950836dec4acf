"""Compiled: scores of FAST corners, non-maximum suppression, and selection at a minimum distance."""

import math
from pathlib import Path

import numpy as np
from numba import boolean, float64, int64, njit, types, uint8, void

from rbpf.kernels.signature import INDICES, MATRIX, READ_ONLY, VECTOR, discard_stale

discard_stale(Path(__file__).parent)

_IMAGE = types.Array(uint8, 2, "C", readonly=True)
_PIXELS = types.Array(int64, 2, "C", readonly=True)
_SOBEL_TO_SLOPE = 1.0 / 8.0  #: Sobel's sums are so many times the slope, in grey levels per pixel.


# Few arrays per loop: with more the compiler cannot rule out that they overlap, and does not vectorise.
@njit(cache=True, error_model="numpy")
def _sobel(above, here, below, u, v):
    # 32-bit integers throughout, so that a vector instruction holds as many as possible.
    for x in range(1, here.shape[0] - 1):
        a, b, c = np.int32(above[x - 1]), np.int32(above[x]), np.int32(above[x + 1])
        d, e = np.int32(here[x - 1]), np.int32(here[x + 1])
        f, g, h = np.int32(below[x - 1]), np.int32(below[x]), np.int32(below[x + 1])
        u[x] = np.int32(c - a + 2 * (e - d) + h - f)
        v[x] = np.int32(f - a + 2 * (g - b) + h - c)


@njit(cache=True, error_model="numpy")
def _exchange(u, v, products, sums):
    # Replaces the products of the row that leaves the window, and updates the column sums.
    for x in range(u.shape[0]):
        new = np.int32(u[x] * v[x])
        sums[x] += np.int32(new - products[x])
        products[x] = new


@njit(void(_IMAGE, _PIXELS, int64, VECTOR), cache=True, error_model="numpy")
def least_eigenvalues(image, px, window, out):
    """Least eigenvalues out (K,) of the mean of ∇I ∇Iᵀ over odd windows around pixels (K, 2), sorted by row.

    The derivatives are Sobel's. Pixels must be at least half a window plus one from the image's border.
    """
    count, half, width = px.shape[0], window // 2, image.shape[1]
    if not count:
        return
    # ∂u², ∂u∂v and ∂v² of the last rows, and their column sums, in integers and thus exact.
    held, sums = np.zeros((window, 3, width), np.int32), np.zeros((3, width), np.int32)
    u, v = np.zeros(width, np.int32), np.zeros(width, np.int32)
    k, first = 0, px[0, 1] - half
    for row in range(first, px[count - 1, 1] + half + 1):
        _sobel(image[row - 1], image[row], image[row + 1], u, v)
        products = held[row % window]
        _exchange(u, u, products[0], sums[0])
        _exchange(u, v, products[1], sums[1])
        _exchange(v, v, products[2], sums[2])
        while k < count and px[k, 1] == row - half:
            uu, uv, vv, left = int64(0), int64(0), int64(0), px[k, 0] - half
            for x in range(left, left + window):
                uu, uv, vv = uu + sums[0, x], uv + sums[1, x], vv + sums[2, x]
            middle, apart = 0.5 * float(uu + vv), 0.5 * float(uu - vv)
            scale = _SOBEL_TO_SLOPE * _SOBEL_TO_SLOPE / (window * window)
            out[k] = scale * (middle - math.sqrt(apart * apart + float(uv) * float(uv)))
            k += 1


@njit(void(_PIXELS, VECTOR, MATRIX, types.Array(boolean, 1, "C")), cache=True)
def highest(px, score, rated, out):
    """Mask of the pixels (K, 2) of which no candidate among the 8 neighbours scores higher; `rated` (H, W) is −∞."""
    along, width = rated.reshape(rated.size), rated.shape[1]
    for k in range(px.shape[0]):
        along[px[k, 1] * width + px[k, 0]] = score[k]
    for k in range(px.shape[0]):
        first = (px[k, 1] - 1) * width + px[k, 0] - 1
        best = score[k]
        for row in range(3):
            part = along[first + row * width : first + row * width + 3]
            best = max(best, part[0], part[1], part[2])
        out[k] = score[k] == best


@njit(int64(READ_ONLY, READ_ONLY, float64, INDICES), cache=True)
def choose_apart(px, taken, spacing, chosen):
    """Greedily chooses rows of px (K, 2) at least `spacing` from `taken` (M, 2) and each other, into `chosen`.

    Returns their number.
    """
    count, least = 0, spacing * spacing
    for k in range(px.shape[0]):
        if count == chosen.shape[0]:
            break
        free = True
        for m in range(taken.shape[0]):
            free = free and (px[k, 0] - taken[m, 0]) ** 2 + (px[k, 1] - taken[m, 1]) ** 2 >= least
        for c in range(count):
            other = px[chosen[c]]
            free = free and (px[k, 0] - other[0]) ** 2 + (px[k, 1] - other[1]) ** 2 >= least
        if free:
            chosen[count] = k
            count += 1
    return count
