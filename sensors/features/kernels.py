"""Compiled: how good FAST's corners are, which of them is the best among its neighbours, and which are apart."""

import math
from pathlib import Path

import numpy as np
from numba import boolean, float64, int64, njit, types, uint8, void

from rbpf.kernels.signature import INDICES, MATRIX, READ_ONLY, VECTOR, discard_stale

discard_stale(Path(__file__).parent)

_IMAGE = types.Array(uint8, 2, "C", readonly=True)
_PIXELS = types.Array(int64, 2, "C", readonly=True)
_SOBEL_TO_SLOPE = 1.0 / 8.0  #: Sobel's sums are so many times the slope, in grey levels per pixel.


# Few arrays in a loop: with more of them the compiler cannot know that they do not overlap, and takes pixel by pixel.
@njit(cache=True, error_model="numpy")
def _sobel(above, here, below, u, v):
    # Whole numbers of 32 bits all through, as many at once as there is room for.
    for x in range(1, here.shape[0] - 1):
        a, b, c = np.int32(above[x - 1]), np.int32(above[x]), np.int32(above[x + 1])
        d, e = np.int32(here[x - 1]), np.int32(here[x + 1])
        f, g, h = np.int32(below[x - 1]), np.int32(below[x]), np.int32(below[x + 1])
        u[x] = np.int32(c - a + 2 * (e - d) + h - f)
        v[x] = np.int32(f - a + 2 * (g - b) + h - c)


@njit(cache=True, error_model="numpy")
def _exchange(u, v, products, sums):
    # A row's products take the place of those that leave the window.
    for x in range(u.shape[0]):
        new = np.int32(u[x] * v[x])
        sums[x] += np.int32(new - products[x])
        products[x] = new


@njit(void(_IMAGE, _PIXELS, int64, VECTOR), cache=True, error_model="numpy")
def least_eigenvalues(image, px, window, out):
    """Of the mean of ∇I ∇Iᵀ over the window (odd) around pixels (K, 2), which come row by row: out (K,).

    The derivatives are Sobel's. No pixel may be nearer to the image's border than half a window and one more.
    """
    count, half, width = px.shape[0], window // 2, image.shape[1]
    if not count:
        return
    # Of the last rows ∂u², ∂u∂v and ∂v², and their sums down the columns, in whole numbers and so without error.
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
    """Whether none of the eight neighbours of pixels (K, 2) is one of them and scores higher; `rated` (H, W) is −∞."""
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
    """Fills the front of chosen with which of px (K, 2), the first before the next, are so far from `taken` (M, 2) and others.

    Returns how many there are.
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
