"""Compiled correlation of a template with the whole pixels of an ellipse, see `rbpf.sensors.patches`."""

import math

import numpy as np
from numba import njit

_LANES = 4
"""Columns of a template taken together, so that a sum is loaded and stored once for all of them."""
_HALF_DIAGONAL_SQUARED = 0.51
"""A little over ½ px²: the nearest whole pixel is never further."""


@njit(cache=True, error_model="numpy")
def normalised(template, least_std):
    """The template without mean and with unit norm, its rows padded by zeros to whole lanes; (0, 0) if flat."""
    size = template.shape[0]
    mean, square = 0.0, 0.0
    for j in range(size):
        for i in range(size):
            mean += template[j, i]
    mean /= size * size
    for j in range(size):
        for i in range(size):
            square += (template[j, i] - mean) ** 2
    if not (square > 0.0 and square >= least_std * least_std * size * size):
        return np.zeros((0, 0), np.float32)
    unit = np.zeros((size, (size + _LANES - 1) // _LANES * _LANES), np.float32)
    scale = 1.0 / math.sqrt(square)
    for j in range(size):
        for i in range(size):
            unit[j, i] = (template[j, i] - mean) * scale
    return unit


@njit(cache=True, error_model="numpy")
def ellipse(cov, sigmas):
    """Variances and covariance of the searched ellipse; NaN where they are those of no Gaussian.

    Half a pixel's diagonal is added to each half axis in quadrature, so that some whole pixel is always inside.
    """
    room = _HALF_DIAGONAL_SQUARED / (sigmas * sigmas)
    uu, uv, vv = cov[0, 0] + room, 0.5 * (cov[0, 1] + cov[1, 0]), cov[1, 1] + room
    if not (cov[0, 0] >= 0.0 and cov[1, 1] >= 0.0 and abs(uv) < math.sqrt(uu) * math.sqrt(vv)):
        uu = np.nan
    return uu, uv, vv


@njit(cache=True, error_model="numpy")
def score_ellipse(image, unit, size, centre, cov, sigmas, columns, rows, scores):
    """Correlation of the unit template at the whole pixels of the ellipse; −1 where the image is flat."""
    uu, uv, vv = ellipse(cov, sigmas)
    slope = uv / vv
    narrow = max(uu - uv * slope, 0.0)
    half, (height, width) = size // 2, scores.shape
    left, top = columns[0] - half, rows[0] - half
    grey = levels(image[top : top + height + size - 1, left : left + width + size - 1], unit.shape[1] - size)
    sums, squares = np.zeros(width + size - 1, np.int32), np.zeros(width + size - 1, np.int32)
    window, window_squares = np.empty(width, np.int32), np.empty(width, np.int32)
    cross = np.empty(width, np.float32)
    for y in range(size - 1):
        _slide(image[top + y, left:], 1, sums, squares)
    for y in range(height):
        _slide(image[top + y + size - 1, left:], 1, sums, squares)
        dy = rows[0] + y - centre[1]
        reach = math.sqrt(max(narrow * (sigmas * sigmas - dy * dy / vv), 0.0))
        low = max(np.ceil(centre[0] + slope * dy - reach), float(columns[0]))
        high = min(np.floor(centre[0] + slope * dy + reach), float(columns[1]))
        if high >= low and dy * dy <= sigmas * sigmas * vv:
            start, count = int(low) - columns[0], int(high) - int(low) + 1
            _correlate(grey[y : y + size], unit, start, count, cross)
            _window_sums(sums[start:], size, count, window)
            _window_sums(squares[start:], size, count, window_squares)
            _divide(cross, window, window_squares, size * size, scores[y, start : start + count])
        _slide(image[top + y, left:], -1, sums, squares)


@njit(cache=True, error_model="numpy")
def levels(part, padding):
    """Grey levels with columns of zeros behind them.

    Their mean is taken off: a template without mean does not feel it, and rounding comes down.
    """
    total = np.int64(0)
    for y in range(part.shape[0]):
        for x in range(part.shape[1]):
            total += np.int64(part[y, x])
    middle = np.float32(total // part.size)
    grey = np.zeros((part.shape[0], part.shape[1] + padding), np.float32)
    for y in range(part.shape[0]):
        for x in range(part.shape[1]):
            grey[y, x] = np.float32(part[y, x]) - middle
    return grey


@njit(cache=True, error_model="numpy")
def _slide(row, sign, sums, squares):
    """Adds a row of the image to the sums of each column, or takes it off."""
    for x in range(sums.shape[0]):
        grey = np.int32(row[x])
        sums[x] += np.int32(sign) * grey
        squares[x] += np.int32(sign) * grey * grey


@njit(cache=True, error_model="numpy")
def _window_sums(columns, size, count, out):
    """Sums over `size` columns from each of the first `count` on."""
    total = np.int32(0)
    for x in range(size - 1):
        total += columns[x]
    for x in range(count):
        total += columns[x + size - 1]
        out[x] = total
        total -= columns[x]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _correlate(grey, unit, start, count, cross):
    """Σ unit · grey at `count` columns from `start` on."""
    for x in range(count):
        cross[x] = 0.0
    for j in range(unit.shape[0]):
        for i in range(0, unit.shape[1], _LANES):
            a, b, c, d = unit[j, i], unit[j, i + 1], unit[j, i + 2], unit[j, i + 3]
            row = grey[j, start + i : start + i + count + _LANES]
            for x in range(count):
                cross[x] += a * row[x] + b * row[x + 1] + c * row[x + 2] + d * row[x + 3]


@njit(cache=True, error_model="numpy")
def _divide(cross, sums, squares, n, out):
    """Scores from Σ unit · grey and the windows' sums, whose variance is exact."""
    for x in range(out.shape[0]):
        spread = float(n) * squares[x] - float(sums[x]) * float(sums[x])
        score = cross[x] * math.sqrt(n / max(spread, 1.0))
        out[x] = np.float32(min(score, 1.0)) if spread > 0.0 else np.float32(-1.0)
