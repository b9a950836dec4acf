"""Numba only: casts the ray of every pixel at textured rectangles, tile by tile.

With M = [across, down, corner] of a rectangle in the camera's frame, a ray (u, v, 1) hits it at depth z and at the
shares (s, t) of its sides where M (s, t, 1) = z (u, v, 1). So H = M⁻¹ takes the ray to (s, t, 1)/z; its last row gives
1/z.
"""

import math

import numpy as np
from numba import float32, float64, int64, njit, types, uint8, void

TILE = 16
"""Side of a tile, px: its rays and depths stay in the innermost cache."""

ELONGATED = 2.0
"""A footprint longer than this times its width is read as if it were shorter: less blur at grazing angles."""

_MATRIX = types.Array(float64, 2, "C")
_HYPER = types.Array(float64, 4, "C")
_CUBE = types.Array(float64, 3, "C")
_GREY = types.Array(float32, 2, "C")
_ROWS = types.Array(int64, 1, "C")
_ROW_IMAGE = types.Array(int64, 2, "C")
_LEVELS = types.Array(int64, 3, "C")
_TEXELS = types.Array(uint8, 1, "C")
_GAINS = types.Array(float64, 1, "C")


@njit(cache=True, error_model="numpy", nogil=True)
def _candidates(bounds: np.ndarray, tile: np.ndarray, chosen: np.ndarray) -> int:
    """Rectangles whose bounds (umin, umax, vmin, vmax) meet a tile's; how many."""
    count = 0
    for r in range(bounds.shape[0]):
        box = bounds[r]
        if box[0] <= tile[1] and tile[0] <= box[1] and box[2] <= tile[3] and tile[2] <= box[3]:
            chosen[count] = r
            count += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _nearest(
    h: np.ndarray,
    chosen: np.ndarray,
    count: int,
    u: np.ndarray,
    v: np.ndarray,
    n: int,
    near: np.ndarray,
    row: np.ndarray,
) -> None:
    """For each of n rays the greatest 1/z of a hit and its rectangle; 0 and -1 where there is none.

    The loop over the rays has no branch and no division, so that it compiles to vector instructions.
    """
    for i in range(n):
        near[i] = 0.0
        row[i] = -1
    for k in range(count):
        r = chosen[k]
        h00, h01, h02 = h[r, 0, 0], h[r, 0, 1], h[r, 0, 2]
        h10, h11, h12 = h[r, 1, 0], h[r, 1, 1], h[r, 1, 2]
        h20, h21, h22 = h[r, 2, 0], h[r, 2, 1], h[r, 2, 2]
        for i in range(n):
            s, t = h00 * u[i] + h01 * v[i] + h02, h10 * u[i] + h11 * v[i] + h12
            w = h20 * u[i] + h21 * v[i] + h22
            hit = (w > near[i]) & (s >= 0.0) & (s <= w) & (t >= 0.0) & (t <= w)
            near[i] = w if hit else near[i]
            row[i] = r if hit else row[i]


@njit(cache=True, error_model="numpy", nogil=True)
def _bilinear(texels: np.ndarray, level: np.ndarray, s: float, t: float) -> float:
    """A level of a texture at the shares (s, t); beyond its outermost texels' centres they go on."""
    start, height, width = level[0], level[1], level[2]
    x = min(max(s * width - 0.5, 0.0), width - 1.0)
    y = min(max(t * height - 0.5, 0.0), height - 1.0)
    i, j = int(x), int(y)
    a, b = x - i, y - j
    right = 1 if i < width - 1 else 0
    below = width if j < height - 1 else 0
    k = start + j * width + i
    top = texels[k] + a * (float(texels[k + right]) - texels[k])
    k += below
    bottom = texels[k] + a * (float(texels[k + right]) - texels[k])
    return top + b * (bottom - top)


@njit(cache=True, error_model="numpy", nogil=True)
def _footprint(
    h: np.ndarray, s: float, t: float, w: float, slope: np.ndarray, width: int, height: int
) -> float:
    """How many texels a pixel covers, along the longer side unless it is very elongated."""
    su, sv = (h[0, 0] - s * h[2, 0]) / w * width, (h[0, 1] - s * h[2, 1]) / w * width
    tu, tv = (h[1, 0] - t * h[2, 0]) / w * height, (h[1, 1] - t * h[2, 1]) / w * height
    a, b = su * slope[0] + sv * slope[2], su * slope[1] + sv * slope[3]
    c, d = tu * slope[0] + tv * slope[2], tu * slope[1] + tv * slope[3]
    square, area = 0.5 * (a * a + b * b + c * c + d * d), abs(a * d - b * c)
    longer = math.sqrt(square + math.sqrt(max(square * square - area * area, 0.0)))
    return max(area / longer, longer / ELONGATED)


@njit(cache=True, error_model="numpy", nogil=True)
def _filtered(texels: np.ndarray, levels: np.ndarray, s: float, t: float, footprint: float) -> float:
    """Between the two levels whose texels are nearest in size to the footprint."""
    k, last = 0, levels.shape[0] - 1
    while footprint >= 2.0 and k < last:
        footprint *= 0.5
        k += 1
    fine = _bilinear(texels, levels[k], s, t)
    if footprint <= 1.0 or k == last:
        return fine
    return fine + (footprint - 1.0) * (_bilinear(texels, levels[k + 1], s, t) - fine)


@njit(cache=True, error_model="numpy", nogil=True)
def _rays(
    uv: np.ndarray, slope: np.ndarray, y0: int, x0: int, shift: np.ndarray, u: np.ndarray, v: np.ndarray
) -> int:
    """Rays of a tile's pixels, shifted by a part of a pixel; how many."""
    n = 0
    for y in range(y0, min(y0 + TILE, uv.shape[0])):
        for x in range(x0, min(x0 + TILE, uv.shape[1])):
            d = slope[y, x]
            u[n] = uv[y, x, 0] + d[0] * shift[0] + d[1] * shift[1]
            v[n] = uv[y, x, 1] + d[2] * shift[0] + d[3] * shift[1]
            n += 1
    return n


@njit(
    void(_HYPER, _CUBE, _ROWS, _ROWS, _GAINS, _CUBE, _CUBE, _CUBE, _MATRIX, float64, _LEVELS, _TEXELS, _GREY),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def expose(
    h: np.ndarray,
    bounds: np.ndarray,
    moment: np.ndarray,
    sheet: np.ndarray,
    gain: np.ndarray,
    uv: np.ndarray,
    slope: np.ndarray,
    tiles: np.ndarray,
    shifts: np.ndarray,
    spacing: float,
    levels: np.ndarray,
    texels: np.ndarray,
    light: np.ndarray,
) -> None:
    """Fills `light` (H, W) with the mean of what a pixel's rays see: one per shift (px), each at its moment's pose.

    A ray that leaves the world sees 0. The size of a pixel on a rectangle is worked out once for all its rays.
    """
    side = TILE * TILE
    chosen, row, sized = (
        np.empty(bounds.shape[1], np.int64),
        np.empty(side, np.int64),
        np.empty(side, np.int64),
    )
    u, v, near, size, total = np.empty(side), np.empty(side), np.empty(side), np.empty(side), np.empty(side)
    for j in range(tiles.shape[0]):
        for i in range(tiles.shape[1]):
            columns = min(TILE, uv.shape[1] - i * TILE)
            total[:] = 0.0
            sized[:] = -1
            n = 0
            for k in range(shifts.shape[0]):
                pose = h[moment[k]]
                count = _candidates(bounds[moment[k]], tiles[j, i], chosen)
                n = _rays(uv, slope, j * TILE, i * TILE, shifts[k], u, v)
                _nearest(pose, chosen, count, u, v, n, near, row)
                for p in range(n):
                    r = row[p]
                    if r < 0:
                        continue
                    m, level, w = pose[r], levels[sheet[r]], near[p]
                    s = (m[0, 0] * u[p] + m[0, 1] * v[p] + m[0, 2]) / w
                    t = (m[1, 0] * u[p] + m[1, 1] * v[p] + m[1, 2]) / w
                    if sized[p] != r:
                        d = slope[j * TILE + p // columns, i * TILE + p % columns]
                        size[p] = spacing * _footprint(m, s, t, w, d, level[0, 2], level[0, 1])
                        sized[p] = r
                    total[p] += gain[r] * _filtered(texels, level, s, t, size[p])
            for p in range(n):
                light[j * TILE + p // columns, i * TILE + p % columns] = total[p] / shifts.shape[0]


@njit(
    void(_CUBE, _MATRIX, _CUBE, _CUBE, _CUBE, _MATRIX, _ROW_IMAGE),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def trace(
    h: np.ndarray,
    bounds: np.ndarray,
    uv: np.ndarray,
    slope: np.ndarray,
    tiles: np.ndarray,
    inverse_depth: np.ndarray,
    rows: np.ndarray,
) -> None:
    """Inverse depth and rectangle (H, W) at the pixels' centres; 0 and -1 where the ray leaves the world."""
    side, centre = TILE * TILE, np.zeros(2)
    chosen, row = np.empty(bounds.shape[0], np.int64), np.empty(side, np.int64)
    u, v, near = np.empty(side), np.empty(side), np.empty(side)
    for j in range(tiles.shape[0]):
        for i in range(tiles.shape[1]):
            count = _candidates(bounds, tiles[j, i], chosen)
            n = _rays(uv, slope, j * TILE, i * TILE, centre, u, v)
            _nearest(h, chosen, count, u, v, n, near, row)
            columns = min(TILE, uv.shape[1] - i * TILE)
            for p in range(n):
                y, x = j * TILE + p // columns, i * TILE + p % columns
                inverse_depth[y, x], rows[y, x] = near[p], row[p]
