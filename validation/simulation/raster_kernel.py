"""Numba only: casts the rays of all pixels at textured rectangles, tile by tile.

With M = [across, down, corner] of a rectangle in the camera's frame, a ray (u, v, 1) hits it at depth z and fractions
(s, t) of its sides where M (s, t, 1) = z (u, v, 1). H = M⁻¹ maps the ray to (s, t, 1)/z; its last row gives 1/z.
"""

import math

import numpy as np
from numba import float32, float64, int64, njit, types, uint8, void

TILE = 16  #: Side of a tile, px: its rays and depths fit in the L1 cache.
#: Largest aspect ratio of a texture footprint; longer ones are shortened, for less blur at grazing angles.
ELONGATED = 2.0
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
def _span(a, b, c, tile):
    """Minimum and maximum of a u + b v + c over a tile (umin, umax, vmin, vmax)."""
    p, q, r, s = a * tile[0], a * tile[1], b * tile[2], b * tile[3]
    return min(p, q) + min(r, s) + c, max(p, q) + max(r, s) + c


@njit(cache=True, error_model="numpy", nogil=True)
def _cover(m, tile):
    """Maximum 1/z of a rectangle within a tile, 0 without a hit; minimum 1/z if it fills the tile, else 0.

    A ray hits if s, t, w - s and w - t are not negative. All are linear in (u, v), so their extremes are at the tile's
    corners.
    """
    low, high = _span(m[2, 0], m[2, 1], m[2, 2], tile)
    if high <= 0.0:
        return 0.0, 0.0
    fills = low > 0.0
    for side in range(2):
        a, b, c = m[side, 0], m[side, 1], m[side, 2]
        least, greatest = _span(a, b, c, tile)
        under, over = _span(m[2, 0] - a, m[2, 1] - b, m[2, 2] - c, tile)
        if greatest < 0.0 or over < 0.0:
            return 0.0, 0.0
        fills = fills and least >= 0.0 and under >= 0.0
    return high, low if fills else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _candidates(h, bounds, tile, chosen, nearest):
    """Fills `chosen` with the rectangles possibly visible in a tile, without occluded ones; returns their number."""
    count, front = 0, 0.0
    u0, u1, v0, v1 = tile[0], tile[1], tile[2], tile[3]
    for r in range(bounds.shape[0]):
        if bounds[r, 0] <= u1 and u0 <= bounds[r, 1] and bounds[r, 2] <= v1 and v0 <= bounds[r, 3]:
            near, filled = _cover(h[r], tile)
            if near > 0.0:
                chosen[count], nearest[count] = r, near
                count += 1
                front = max(front, filled)
    kept = 0
    for k in range(count):
        if nearest[k] >= front:
            chosen[kept] = chosen[k]
            kept += 1
    return kept


@njit(cache=True, error_model="numpy", nogil=True)
def _nearest(h, chosen, count, u, v, n, near, row):
    """For each of n rays the nearest hit's 1/z and rectangle; 0 and -1 without a hit.

    The loop over the rays has no branch and no division, so it compiles to vector instructions.
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
def _bilinear(texels, start, height, width, s, t):
    """Bilinear interpolation in a texture level at fractions (s, t); the level has a border of repeated texels."""
    x, y = s * width + 0.5, t * height + 0.5
    i, j = int(x), int(y)
    a, b = x - i, y - j
    k = start + j * (width + 2) + i
    top = texels[k] + a * (float(texels[k + 1]) - texels[k])
    k += width + 2
    bottom = texels[k] + a * (float(texels[k + 1]) - texels[k])
    return top + b * (bottom - top)


@njit(cache=True, error_model="numpy", nogil=True)
def _footprint(h, s, t, w, slope, width, height):
    """Length in texels of a pixel's footprint, along its longer axis unless it is very elongated."""
    su, sv = (h[0, 0] - s * h[2, 0]) / w * width, (h[0, 1] - s * h[2, 1]) / w * width
    tu, tv = (h[1, 0] - t * h[2, 0]) / w * height, (h[1, 1] - t * h[2, 1]) / w * height
    a, b = su * slope[0] + sv * slope[2], su * slope[1] + sv * slope[3]
    c, d = tu * slope[0] + tv * slope[2], tu * slope[1] + tv * slope[3]
    square, area = 0.5 * (a * a + b * b + c * c + d * d), abs(a * d - b * c)
    longer = math.sqrt(square + math.sqrt(max(square * square - area * area, 0.0)))
    return max(area / longer, longer / ELONGATED)


@njit(cache=True, error_model="numpy", nogil=True)
def _detail(footprint, last):
    """Level of detail for a footprint; the fraction interpolates towards the next level.

    Texels double in size from level to level, and the fraction is linear in the footprint.
    """
    k = 0
    while footprint >= 2.0 and k < last:
        footprint *= 0.5
        k += 1
    return k + (footprint - 1.0 if footprint > 1.0 and k < last else 0.0)


@njit(cache=True, error_model="numpy", nogil=True)
def _filtered(texels, levels, sheet, s, t, detail):
    """A texture value, interpolated between two levels."""
    k = int(detail)
    between = detail - k
    fine = _bilinear(texels, levels[sheet, k, 0], levels[sheet, k, 1], levels[sheet, k, 2], s, t)
    if between == 0.0:
        return fine
    k += 1
    coarse = _bilinear(texels, levels[sheet, k, 0], levels[sheet, k, 1], levels[sheet, k, 2], s, t)
    return fine + between * (coarse - fine)


@njit(cache=True, error_model="numpy", nogil=True)
def _rays(uv, slope, y0, x0, shift, u, v):
    """Fills the rays of a tile's pixels with a subpixel shift; returns their number."""
    n, a, b = 0, shift[0], shift[1]
    for y in range(y0, min(y0 + TILE, uv.shape[0])):
        for x in range(x0, min(x0 + TILE, uv.shape[1])):
            u[n] = uv[y, x, 0] + slope[y, x, 0] * a + slope[y, x, 1] * b
            v[n] = uv[y, x, 1] + slope[y, x, 2] * a + slope[y, x, 3] * b
            n += 1
    return n


@njit(
    void(_HYPER, _CUBE, _ROWS, _ROWS, _GAINS, _CUBE, _CUBE, _CUBE, _MATRIX, float64, _LEVELS, _TEXELS, _GREY),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def expose(h, bounds, moment, sheet, gain, uv, slope, tiles, shifts, spacing, levels, texels, light):
    """Fills `light` (H, W) with the mean over a pixel's rays: one per shift (px), each at its moment's pose.

    A ray without a hit is 0. The footprint of a pixel on a rectangle is computed once for all its rays.
    """
    side = TILE * TILE
    chosen, row, sized = (np.empty(bounds.shape[1], np.int64), np.empty(side, np.int64), np.empty(side, np.int64))
    u, v, near, detail, total = np.empty(side), np.empty(side), np.empty(side), np.empty(side), np.empty(side)
    nearest = np.empty(bounds.shape[1])
    for j in range(tiles.shape[0]):
        for i in range(tiles.shape[1]):
            columns = min(TILE, uv.shape[1] - i * TILE)
            total[:] = 0.0
            sized[:] = -1
            n, count = 0, 0
            for k in range(shifts.shape[0]):
                now = moment[k]
                pose = h[now]
                if k == 0 or now != moment[k - 1]:
                    count = _candidates(pose, bounds[now], tiles[j, i], chosen, nearest)
                n = _rays(uv, slope, j * TILE, i * TILE, shifts[k], u, v)
                _nearest(pose, chosen, count, u, v, n, near, row)
                for p in range(n):
                    r = row[p]
                    if r < 0:
                        continue
                    z = 1.0 / near[p]
                    s = z * (h[now, r, 0, 0] * u[p] + h[now, r, 0, 1] * v[p] + h[now, r, 0, 2])
                    t = z * (h[now, r, 1, 0] * u[p] + h[now, r, 1, 1] * v[p] + h[now, r, 1, 2])
                    if sized[p] != r:
                        d, level = slope[j * TILE + p // columns, i * TILE + p % columns], levels[sheet[r], 0]
                        size = spacing * _footprint(pose[r], s, t, near[p], d, level[2], level[1])
                        detail[p], sized[p] = _detail(size, levels.shape[1] - 1), r
                    total[p] += gain[r] * _filtered(texels, levels, sheet[r], s, t, detail[p])
            for p in range(n):
                light[j * TILE + p // columns, i * TILE + p % columns] = total[p] / shifts.shape[0]


@njit(void(_CUBE, _MATRIX, _CUBE, _CUBE, _CUBE, _MATRIX, _ROW_IMAGE), cache=True, error_model="numpy", nogil=True)
def trace(h, bounds, uv, slope, tiles, inverse_depth, rows):
    """Fills inverse depth and rectangle (H, W) at the pixels' centres; 0 and -1 without a hit."""
    side, centre = TILE * TILE, np.zeros(2)
    chosen, row = np.empty(bounds.shape[0], np.int64), np.empty(side, np.int64)
    u, v, near, nearest = np.empty(side), np.empty(side), np.empty(side), np.empty(bounds.shape[0])
    for j in range(tiles.shape[0]):
        for i in range(tiles.shape[1]):
            count = _candidates(h, bounds, tiles[j, i], chosen, nearest)
            n = _rays(uv, slope, j * TILE, i * TILE, centre, u, v)
            _nearest(h, chosen, count, u, v, n, near, row)
            columns = min(TILE, uv.shape[1] - i * TILE)
            for p in range(n):
                y, x = j * TILE + p // columns, i * TILE + p % columns
                inverse_depth[y, x], rows[y, x] = near[p], row[p]
