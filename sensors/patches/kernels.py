"""Compiled resampling, correlation and refinement of image patches, see `rbpf.sensors.patches.search`.

The refinement is Gauss-Newton on the position p that maximises ρ(p) = tᵀw(p), with the template t and the image's window
w(p), each without mean and with unit norm: δ = (JᵀJ)⁻¹Jᵀ(t/ρ − w), J = (I − wwᵀ) ∂w/∂p. The gradients are the window's,
not the template's: this reduces the effect of both images' noise, compared to fixed gradients of the template.
"""

import math
from pathlib import Path

import numpy as np
from numba import float32, float64, njit, types, uint8, void

from rbpf.kernels.signature import MATRIX, READ_ONLY, discard_stale, in_parts

discard_stale(Path(__file__).parent)

# Input arrays may be read-only.
IMAGE = types.Array(uint8, 2, "C", readonly=True)
_WINDOWS = types.Array(uint8, 3, "C", readonly=True)
_TEMPLATES = types.Array(float32, 3, "C", readonly=True)
_READ_ONLY_CUBE = types.Array(float64, 3, "C", readonly=True)


@njit(cache=True, error_model="numpy")
def footprint(a, b, c, d, most):
    """Offsets (m, 2) of the source samples whose mean gives one pixel of the template.

    A template pixel covers the square of a source pixel mapped by A. Source pixels already average over their own square,
    so the missing blur has the covariance (A Aᵀ − I)/12, clipped at 0 along each axis.
    """
    uu, uv, vv = a * a + b * b, a * c + b * d, c * c + d * d
    angle = 0.5 * math.atan2(2.0 * uv, uu - vv)
    middle, half = 0.5 * (uu + vv), math.hypot(0.5 * (uu - vv), uv)
    along, across = math.sqrt(max(middle + half - 1.0, 0.0)), math.sqrt(max(middle - half - 1.0, 0.0))
    m, n = 1 + min(math.ceil(along), most), 1 + min(math.ceil(across), most)
    cosine, sine = math.cos(angle), math.sin(angle)
    samples = np.empty((m * n, 2))
    for p in range(m):
        for q in range(n):
            e, f = _step(along, p, m), _step(across, q, n)
            samples[p * n + q, 0] = cosine * e - sine * f
            samples[p * n + q, 1] = sine * e + cosine * f
    return samples


@njit(cache=True, error_model="numpy")
def _step(width, index, count):
    """One of `count` equidistant samples around 0 that have the variance of a box of this width."""
    if count == 1:
        return 0.0
    return width * (index - 0.5 * (count - 1)) / math.sqrt(count * count - 1.0)


@njit(cache=True, error_model="numpy")
def surroundings(image, left, top, side):
    """Grey levels (side, side) with the top left corner (left, top); the image's border is repeated."""
    height, width = image.shape
    area = np.empty((side, side), np.float32)
    for j in range(side):
        row = image[min(max(top + j, 0), height - 1)]
        for i in range(side):
            area[j, i] = row[min(max(left + i, 0), width - 1)]
    return area


@njit(cache=True, error_model="numpy")
def cubic(area, x, y):
    """Catmull-Rom interpolation in `surroundings` that start at (−1, −1), at column x and row y."""
    u, v = int(x), int(y)
    across, down = weights(x - u), weights(y - v)
    total = 0.0
    for j in range(4):
        line = 0.0
        for i in range(4):
            line += across[i] * area[v + j, u + i]
        total += down[j] * line
    return total


@njit(cache=True, error_model="numpy", inline="always")
def weights(t):
    """Catmull-Rom weights of the samples at −1, 0, 1, 2 for a position t in 0..1."""
    s = 1.0 - t
    return (-0.5 * t * s * s, 1.0 + t * t * (1.5 * t - 2.5), 1.0 + s * s * (1.5 * s - 2.5), -0.5 * s * t * t)


@njit(void(_WINDOWS, _READ_ONLY_CUBE, types.Array(float32, 3, "C")), cache=True, error_model="numpy")
def warp_all(sources, affines, templates):
    """Fills templates (K, size, size) from sources (K, S, S) and affines (K, 2, 2); NaN where one leaves its source."""
    size, middle = templates.shape[1], 0.5 * (sources.shape[1] - 1)
    templates[:] = np.nan
    for k in range(templates.shape[0]):
        a, b, c, d = affines[k, 0, 0], affines[k, 0, 1], affines[k, 1, 0], affines[k, 1, 1]
        if not math.isfinite(a * a + b * b + c * c + d * d):
            continue
        samples = footprint(a, b, c, d, sources.shape[1])
        reach = 0.0
        for s in range(samples.shape[0]):
            reach = max(reach, abs(samples[s, 0]), abs(samples[s, 1]))
        if max(abs(a) + abs(b), abs(c) + abs(d)) * (size // 2) + reach > middle:
            continue
        source = surroundings(sources[k], -1, -1, sources.shape[1] + 3)
        for j in range(size):
            for i in range(size):
                dx, dy, total = float(i - size // 2), float(j - size // 2), 0.0
                x, y = middle + a * dx + b * dy, middle + c * dx + d * dy
                for s in range(samples.shape[0]):
                    total += cubic(source, x + samples[s, 0], y + samples[s, 1])
                templates[k, j, i] = total / samples.shape[0]


@njit(void(IMAGE, float64, float64, types.Array(uint8, 2, "C")), cache=True, error_model="numpy")
def cut_window(image, x, y, window):
    """Fills window (S, S) uint8 around column x and row y."""
    half = window.shape[0] // 2
    left, top = int(x) - half, int(y) - half
    area = surroundings(image, left - 1, top - 1, window.shape[0] + 3)
    for j in range(window.shape[0]):
        for i in range(window.shape[0]):
            grey = cubic(area, x + (i - half) - left, y + (j - half) - top)
            window[j, i] = np.uint8(min(max(math.floor(grey + 0.5), 0.0), 255.0))


_LANES = 4  #: Columns of a template processed together, so that a sum is loaded and stored once for all of them.
_BETWEEN = 40  #: Cost of starting a line, in pixels.
_HALF_DIAGONAL_SQUARED = 0.51  #: A little over ½ px²: the nearest whole pixel is never farther away.


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
    """Variances and covariance of the searched ellipse; NaN if the covariance is not valid.

    Half a pixel's diagonal is added to each half axis in quadrature, so that some whole pixel is always inside.
    """
    room = _HALF_DIAGONAL_SQUARED / (sigmas * sigmas)
    uu, uv, vv = cov[0, 0] + room, 0.5 * (cov[0, 1] + cov[1, 0]), cov[1, 1] + room
    if not (cov[0, 0] >= 0.0 and cov[1, 1] >= 0.0 and abs(uv) < math.sqrt(uu) * math.sqrt(vv)):
        uu = np.nan
    return uu, uv, vv


@njit(cache=True, error_model="numpy")
def score_ellipse(image, unit, size, centre, cov, sigmas, columns, rows, scores):
    """Correlation of the unit template at the whole pixels of the ellipse; −1 where the image has no texture."""
    half, (height, width) = size // 2, scores.shape
    left, top = columns[0] - half, rows[0] - half
    grey = levels(image[top : top + height + size - 1, left : left + width + size - 1], unit.shape[1] - size)
    lines = lines_inside(centre, cov, sigmas, columns, rows, grey.shape[1])
    cross = np.empty(lines[-1, 1], np.float32)
    y = 0
    while y < height:
        # Consecutive lines are correlated in one run, gaps included, where that costs less than separate runs.
        start, end = lines[y]
        y += 1
        while y < height and lines[y, 0] - end <= _BETWEEN:
            end = max(end, lines[y, 1])
            y += 1
        _correlate(grey, unit, start, end - start, cross[start:])
    sums, squares = np.zeros(width + size - 1, np.int32), np.zeros(width + size - 1, np.int32)
    window, window_squares = np.empty(width, np.int32), np.empty(width, np.int32)
    for y in range(size - 1):
        _slide(image[top + y, left:], 1, sums, squares)
    for y in range(height):
        _slide(image[top + y + size - 1, left:], 1, sums, squares)
        first, count = lines[y, 0] - y * grey.shape[1], lines[y, 1] - lines[y, 0]
        if count > 0:
            _window_sums(sums[first:], size, count, window)
            _window_sums(squares[first:], size, count, window_squares)
            # Scores from Σ unit · grey and the windows' sums, which give exact variances.
            n, products = size * size, cross[lines[y, 0] :]
            for x in range(count):
                spread = float(n) * window_squares[x] - float(window[x]) * float(window[x])
                score = products[x] * math.sqrt(n / max(spread, 1.0))
                scores[y, first + x] = np.float32(min(score, 1.0)) if spread > 0.0 else np.float32(-1.0)
        _slide(image[top + y, left:], -1, sums, squares)


@njit(cache=True, error_model="numpy")
def lines_inside(centre, cov, sigmas, columns, rows, stride):
    """For each row the first pixel of the ellipse and one past the last (height, 2), as indices with this row stride."""
    uu, uv, vv = ellipse(cov, sigmas)
    slope = uv / vv
    narrow, height = max(uu - uv * slope, 0.0), rows[1] - rows[0] + 1
    lines = np.empty((height, 2), np.int64)
    for y in range(height):
        dy = rows[0] + y - centre[1]
        reach = math.sqrt(max(narrow * (sigmas * sigmas - dy * dy / vv), 0.0))
        low = max(np.ceil(centre[0] + slope * dy - reach), float(columns[0]))
        high = min(np.floor(centre[0] + slope * dy + reach), float(columns[1]))
        is_inside = high >= low and dy * dy <= sigmas * sigmas * vv
        lines[y, 0] = y * stride + (int(low) - columns[0] if is_inside else 0)
        lines[y, 1] = y * stride + (int(high) - columns[0] + 1 if is_inside else 0)
    return lines


@njit(cache=True, error_model="numpy")
def levels(part, padding):
    """Grey levels, padded on the right by columns of zeros.

    Their mean is subtracted: it does not affect a zero-mean template, and rounding errors become smaller.
    """
    grey = np.zeros((part.shape[0], part.shape[1] + padding), np.float32)
    total = 0
    for j in range(part.shape[0]):
        for i in range(part.shape[1]):
            total += part[j, i]
    mean = np.float32(total // part.size)
    for j in range(part.shape[0]):
        for i in range(part.shape[1]):
            grey[j, i] = np.float32(part[j, i]) - mean
    return grey


@njit(cache=True, error_model="numpy")
def _slide(row, sign, sums, squares):
    """Adds a row of the image to the sums of each column, or subtracts it."""
    for x in range(sums.shape[0]):
        grey = np.int32(row[x])
        sums[x] += np.int32(sign) * grey
        squares[x] += np.int32(sign) * grey * grey


@njit(cache=True, error_model="numpy")
def _window_sums(columns, size, count, out):
    """Sums over `size` columns, starting at each of the first `count` columns."""
    total = np.int32(0)
    for x in range(size - 1):
        total += columns[x]
    for x in range(count):
        total += columns[x + size - 1]
        out[x] = total
        total -= columns[x]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _correlate(grey, unit, start, count, cross):
    """Σ unit · grey at `count` consecutive pixels from index `start`, in row-major order."""
    along, stride = grey.reshape(grey.size), grey.shape[1]
    for x in range(count):
        cross[x] = 0.0
    for j in range(unit.shape[0]):
        for i in range(0, unit.shape[1], _LANES):
            a, b, c, d = unit[j, i], unit[j, i + 1], unit[j, i + 2], unit[j, i + 3]
            first = start + j * stride + i
            row = along[first : first + count + _LANES]
            for x in range(count):
                cross[x] += a * row[x] + b * row[x + 1] + c * row[x + 2] + d * row[x + 3]


_EVALUATIONS = 12
#: Determinant of JᵀJ over the product of its diagonal, below which the window has gradients along one direction only.
_SINGULAR = 1e-9
#: Position error per axis that remains without noise: measured on random textures blurred by 0.5 px.
_INTERPOLATION_PX = 0.02
_SETTLED_PX = 0.01
_REACH_PX = 1.0  #: A maximum farther from the best whole pixel along rows or columns belongs to another peak.
_MARGIN = 4  #: Margin that a window needs to be moved by `_REACH_PX`, interpolated and differentiated.


@njit(cache=True, error_model="numpy")
def refine(image, unit, size, column, row, found):
    """Subpixel refinement; writes position, score and covariance, found[0:2], [2] and [4:7].

    A step that lowers ρ is halved. If no maximum is near, the whole pixel and its score, which the caller wrote, stay, and
    the covariance is NaN.
    """
    found[0], found[1], found[4:] = float(column), float(row), np.nan
    reach = size // 2 + _MARGIN
    area = surroundings(image, column - reach, row - reach, size + 2 * _MARGIN)
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
    # The residual's variance times (JᵀJ)⁻¹, plus the interpolation error. Half of the residual is attributed to the window's
    # noise, whose variance a central difference halves: noise adds a quarter of the residual's square sum to each diagonal
    # element of JᵀJ, which is subtracted. If noise explains all gradients, the covariance stays NaN.
    unexplained = max(1.0 - highest * highest, 0.0)
    variance, uu, vv = unexplained / (size * size - 4), uu - 0.25 * unexplained, vv - 0.25 * unexplained
    determinant, least = uu * vv - uv * uv, _INTERPOLATION_PX * _INTERPOLATION_PX
    if uu > 0.0 and determinant > 0.0:
        found[4], found[5] = variance * vv / determinant + least, -variance * uv / determinant
        found[6] = variance * uu / determinant + least


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def interpolate(area, x, y, window):
    """The window moved by (x, y), one pixel larger on each side, by cubic interpolation along rows, then columns."""
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


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def _centre(window, w):
    """Fills w with the window's interior, zero mean and unit norm; returns the previous norm.

    All pixels form one contiguous run, for vector instructions.
    """
    size, inside = w.shape[0], w.reshape(w.size)
    for j in range(size):
        for i in range(size):
            w[j, i] = window[j + 1, i + 1]
    mean, square = 0.0, 0.0
    for k in range(inside.size):
        mean += inside[k]
    mean /= inside.size
    for k in range(inside.size):
        inside[k] = inside[k] - mean
        square += inside[k] * inside[k]
    norm = math.sqrt(square)
    for k in range(inside.size):
        inside[k] /= norm
    return norm


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _slopes(window, w, unit, norm):
    """JᵀJ (three numbers), Jᵀt (two) and ρ; the window's gradients are central differences."""
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


APART_PX = 3  #: Least distance of two separate peaks of the score, along rows or columns.
OUTSIDE = np.float32(-2.0)  #: In a map of scores: not searched.


@njit(cache=True, error_model="numpy")
def interval(centre, cov, sigmas, most, shape, size):
    """First and last column and row of the whole pixels to search; empty if the last is before the first."""
    half = size // 2
    uu, _, vv = ellipse(cov, sigmas)
    if not (math.isfinite(uu) and math.isfinite(vv) and math.isfinite(centre[0]) and math.isfinite(centre[1])):
        return (0, -1), (0, -1)
    across, down = min(sigmas * math.sqrt(uu), most), min(sigmas * math.sqrt(vv), most)
    columns = _clipped(centre[0], across, half, shape[1] - 1 - half)
    return columns, _clipped(centre[1], down, half, shape[0] - 1 - half)


@njit(cache=True, error_model="numpy")
def _clipped(centre, reach, first, last):
    """The integers within reach of the centre, clipped to first..last."""
    if centre + reach < first or centre - reach > last:
        return 0, -1
    return int(max(np.ceil(centre - reach), first)), int(min(np.floor(centre + reach), last))


@njit(cache=True, error_model="numpy")
def second(scores, row, column):
    """Row and column of the second-highest peak, −1 if there is none."""
    height, width = scores.shape
    v, u, highest = -1, -1, np.float32(-1.0)
    for y in range(height):
        for x in range(width):
            if not (scores[y, x] > highest and max(abs(y - row), abs(x - column)) >= APART_PX):
                continue
            # A peak has no higher score among its searched neighbours.
            peak = True
            for b in range(max(y - 1, 0), min(y + 2, height)):
                for a in range(max(x - 1, 0), min(x + 2, width)):
                    peak = peak and not scores[b, a] > scores[y, x]
            if peak:
                v, u, highest = y, x, scores[y, x]
    return v, u


@in_parts(IMAGE, _TEMPLATES, READ_ONLY, _READ_ONLY_CUBE, float64, float64, float64, MATRIX)
def search_all(k, arguments):
    """Fills places (K, 7) = u, v, score, second score, cov_uu, cov_uv, cov_vv; one template and ellipse per row.

    `arguments` are (image, templates, centres, covs, sigmas, most_px, least_std, places); parts are templates. Rows that
    are not matched keep the caller's values.
    """
    image, templates, centres, covs, sigmas, most, least_std, places = arguments
    template, centre, cov, found = templates[k], centres[k], covs[k], places[k]
    unit = normalised(template, least_std)
    if unit.shape[0] == 0:
        return
    columns, rows = interval(centre, cov, sigmas, most, image.shape, template.shape[0])
    width, height = columns[1] - columns[0] + 1, rows[1] - rows[0] + 1
    if width <= 0 or height <= 0:
        return
    scores = np.full((height, width), OUTSIDE, np.float32)
    score_ellipse(image, unit, template.shape[0], centre, cov, sigmas, columns, rows, scores)
    v, u = divmod(scores.argmax(), width)
    if scores[v, u] <= -1.0:
        return
    found[2] = scores[v, u]
    refine(image, unit, template.shape[0], columns[0] + u, rows[0] + v, found)
    p, q = second(scores, v, u)
    if p >= 0:
        other = np.full(found.shape[0], float(scores[p, q]))
        refine(image, unit, template.shape[0], columns[0] + q, rows[0] + p, other)
        # After refinement the better of the two peaks is kept, with the other's score as the second.
        found[3] = other[2]
        if other[2] > found[2]:
            other[3] = found[2]
            for i in range(found.shape[0]):
                found[i] = other[i]
