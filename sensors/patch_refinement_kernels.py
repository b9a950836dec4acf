"""Compiled refinement of a correlation's best whole pixel to a fraction of a pixel, see `rbpf.sensors.patches`.

Gauss-Newton on the place p that maximises ρ(p) = tᵀw(p), with the template t and the image's window w(p), each without
mean and with unit norm: δ = (JᵀJ)⁻¹Jᵀ(t/ρ − w), J = (I − wwᵀ) ∂w/∂p. The slopes are the window's, not the template's:
the noise of both then comes out smaller than with slopes computed once from the template.
"""

import math

import numpy as np
from numba import njit

from rbpf.sensors.patch_warp_kernels import weights

_EVALUATIONS = 12
_SINGULAR = 1e-9
"""Determinant of JᵀJ over the product of its diagonal, below which the window has slopes along one line only."""
_INTERPOLATION_PX = 0.02
"""Error of the place, per axis, that remains without noise: measured on random textures blurred by 0.5 px."""
_SETTLED_PX = 0.01
_REACH_PX = 1.0
"""A maximum further from the best whole pixel along rows or columns is none of this peak."""
_MARGIN = 4
"""What a window needs around it to be moved by `_REACH_PX`, interpolated and differentiated."""


@njit(cache=True, error_model="numpy")
def refine(image, unit, size, column, row, found):
    """Writes place, score and covariance, found[0:2], [2] and [4:7].

    A step after which ρ is lower is taken back by half. Where no maximum is near, the whole pixel and the score
    that the caller wrote stay, and the covariance is NaN.
    """
    found[0], found[1], found[4:] = float(column), float(row), np.nan
    area = _area(image, size, column, row)
    window, w = np.empty((size + 2, size + 2), np.float32), np.empty((size, size), np.float32)
    x, y, du, dv, highest = 0.0, 0.0, 0.0, 0.0, -1.0
    uu, uv, vv = 0.0, 0.0, 0.0
    for _ in range(_EVALUATIONS):
        interpolate(area, x + du, y + dv, window)
        a, b, c, gu, gv, rho = _slopes(window, w, unit, _centre(window, w))
        if rho < highest:
            du, dv = 0.5 * du, 0.5 * dv
        else:
            determinant = a * c - b * b
            if not (rho > 0.0 and determinant > _SINGULAR * a * c):
                return
            x, y, highest, uu, uv, vv = x + du, y + dv, rho, a, b, c
            du, dv = (c * gu - b * gv) / (determinant * rho), (a * gv - b * gu) / (determinant * rho)
        if not (abs(x + du) <= _REACH_PX and abs(y + dv) <= _REACH_PX):
            return
        if max(abs(du), abs(dv)) < _SETTLED_PX:
            break
    found[0], found[1], found[2] = column + x + du, row + y + dv, highest
    _store_cov(uu, uv, vv, highest, size * size, found)


@njit(cache=True, error_model="numpy")
def _store_cov(uu, uv, vv, rho, n, found):
    """The residual's variance times (JᵀJ)⁻¹, and the interpolation's own error; NaN where noise explains the slopes.

    Half of the residual is taken as the window's noise. A central difference halves its variance: a quarter of the
    residual's square sum is what noise adds to each diagonal element of JᵀJ.
    """
    unexplained = max(1.0 - rho * rho, 0.0)
    variance, uu, vv = unexplained / (n - 4), uu - 0.25 * unexplained, vv - 0.25 * unexplained
    determinant, least = uu * vv - uv * uv, _INTERPOLATION_PX * _INTERPOLATION_PX
    if uu > 0.0 and determinant > 0.0:
        found[4], found[5] = variance * vv / determinant + least, -variance * uv / determinant
        found[6] = variance * uu / determinant + least


@njit(cache=True, error_model="numpy")
def _area(image, size, column, row):
    """Grey levels around a window, the image's border repeated."""
    side = size + 2 * _MARGIN
    area = np.empty((side, side), np.float32)
    top, left = row - size // 2 - _MARGIN, column - size // 2 - _MARGIN
    for j in range(side):
        v = min(max(top + j, 0), image.shape[0] - 1)
        for i in range(side):
            area[j, i] = image[v, min(max(left + i, 0), image.shape[1] - 1)]
    return area


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def interpolate(area, x, y, window):
    """The window moved by (x, y), one pixel larger on each side, by cubics along rows and then along columns."""
    u, v = math.floor(x), math.floor(y)
    across, down = weights(np.float32(x - u)), weights(np.float32(y - v))
    a, b, c, d = np.float32(across[0]), np.float32(across[1]), np.float32(across[2]), np.float32(across[3])
    e, f, g, h = np.float32(down[0]), np.float32(down[1]), np.float32(down[2]), np.float32(down[3])
    side, left, top = window.shape[0], _MARGIN - 2 + int(u), _MARGIN - 2 + int(v)
    lines = np.empty((side + 3, side), np.float32)
    for j in range(side + 3):
        row = area[top + j, left : left + side + 3]
        for i in range(side):
            lines[j, i] = a * row[i] + b * row[i + 1] + c * row[i + 2] + d * row[i + 3]
    for j in range(side):
        for i in range(side):
            window[j, i] = e * lines[j, i] + f * lines[j + 1, i] + g * lines[j + 2, i] + h * lines[j + 3, i]


@njit(cache=True, error_model="numpy")
def _centre(window, w):
    """Fills w with the inside of the window without mean and with unit norm; the norm it had."""
    size = w.shape[0]
    mean, square = 0.0, 0.0
    for j in range(size):
        for i in range(size):
            mean += window[j + 1, i + 1]
    mean /= size * size
    for j in range(size):
        for i in range(size):
            w[j, i] = window[j + 1, i + 1] - mean
            square += w[j, i] * w[j, i]
    norm = math.sqrt(square)
    for j in range(size):
        for i in range(size):
            w[j, i] /= norm
    return norm


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _slopes(window, w, unit, norm):
    """JᵀJ (three numbers), Jᵀt (two) and ρ, where window slopes are central differences."""
    size, zero = w.shape[0], np.float32(0.0)
    su, sv, wu, wv, tu, tv, uu, uv, vv, rho = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    for j in range(size):
        for i in range(size):
            u, v = window[j + 1, i + 2] - window[j + 1, i], window[j + 2, i + 1] - window[j, i + 1]
            su, sv, rho = su + u, sv + v, rho + w[j, i] * unit[j, i]
            wu, wv = wu + w[j, i] * u, wv + w[j, i] * v
            tu, tv = tu + unit[j, i] * u, tv + unit[j, i] * v
            uu, uv, vv = uu + u * u, uv + u * v, vv + v * v
    n, scale = size * size, 0.5 / norm
    uu, uv, vv = uu - su * su / n - wu * wu, uv - su * sv / n - wu * wv, vv - sv * sv / n - wv * wv
    along_u, along_v = tu - rho * wu, tv - rho * wv
    squared = scale * scale
    return squared * uu, squared * uv, squared * vv, scale * along_u, scale * along_v, rho
