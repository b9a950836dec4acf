"""Compiled: innovations of many matches at once, and the scores and proposals of the consensus search (RANSAC).

In the proposals from triples a vector is a tuple, and a pose is a quaternion (x, y, z, w) and a translation.
"""

import math

import numpy as np
from numba import njit

from rbpf.kernels.se3 import cross, exp_pair, multiply, quaternion, turned

#: Added to the information of a triple, as a fraction of its trace: three collinear points leave a rotation undetermined.
STIFFNESS = 1e-9
FLAT = 1e-12  #: Lower bound of a length used as divisor: coinciding points have no direction.


@njit(cache=True, error_model="numpy", inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy", inline="always")
def _minus(a, factor, b):
    return a[0] - factor * b[0], a[1] - factor * b[1], a[2] - factor * b[2]


@njit(cache=True, error_model="numpy", inline="always")
def _over(v, depth):
    return v[0] / depth, v[1] / depth, v[2] / depth


@njit(cache=True, error_model="numpy", inline="always")
def _plus(start, a, b):
    return start + a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy", inline="always")
def _by_rows(v, p, q, r):
    return _dot(v, p), _dot(v, q), _dot(v, r)


@njit(cache=True, error_model="numpy", inline="always")
def _factored(cov, p, q, r, gain):
    # L of R, by its lower triangle's rows, + A R⁻ Aᵀ, A by its rows.
    first = gain[0][0], gain[1][0], gain[2][0]
    second = gain[0][1], gain[1][1], gain[2][1]
    third = gain[0][2], gain[1][2], gain[2][2]
    a = math.sqrt(_plus(cov[0], p, first))
    b, d = _plus(cov[1], q, first) / a, _plus(cov[3], r, first) / a
    c = math.sqrt(_plus(cov[2], q, second) - b * b)
    e = (_plus(cov[4], r, second) - d * b) / c
    return a, b, c, d, e, math.sqrt(_plus(cov[5], r, third) - d * d - e * e)


# As in `rbpf.kernels.dense`, for three rows held in registers: L is (l₀₀, l₁₀, l₁₁, l₂₀, l₂₁, l₂₂).
@njit(cache=True, error_model="numpy", inline="always")
def _solved_lower(chol, v):
    x = v[0] / chol[0]
    y = (v[1] - chol[1] * x) / chol[2]
    return x, y, (v[2] - chol[3] * x - chol[4] * y) / chol[5]


@njit(cache=True, error_model="numpy", inline="always")
def _solved(chol, v):
    x, y, z = _solved_lower(chol, v)
    z = z / chol[5]
    y = (y - chol[4] * z) / chol[2]
    return (x - chol[1] * y - chol[3] * z) / chol[0], y, z


@njit(cache=True, error_model="numpy", inline="always")
def _raised(row, pixels):
    return row[0] * pixels[0] + row[1] * pixels[1] + row[2] * pixels[2] + row[3]


# Matches side by side, one lane per match and one row per number: z⁻, z, R⁻ by rows, R's lower triangle by rows, m̂, its
# last change, the depth relative to that before the motion, g, ν, and L with L Lᵀ = S.
_LANES = 64
_BEFORE, _NOW, _COV_BEFORE, _COV_NOW, _PIXELS = 0, 3 * _LANES, 6 * _LANES, 15 * _LANES, 21 * _LANES
_CHANGE, _DEPTH, _SEEN, _NU, _CHOL, _ALL = (n * _LANES for n in (24, 25, 26, 29, 32, 38))
_WHITE, _SQUARED = _COV_BEFORE, _DEPTH  #: For the search, which adjusts nothing: W by rows, and d².


@njit(cache=True, error_model="numpy", inline="always")
def _three(lanes, place, i):
    return lanes[place + i], lanes[place + _LANES + i], lanes[place + 2 * _LANES + i]


@njit(cache=True, error_model="numpy", inline="always")
def _six(lanes, place, i):
    return (*_three(lanes, place, i), *_three(lanes, place + 3 * _LANES, i))


@njit(cache=True, error_model="numpy", inline="always")
def _put(lanes, place, i, v):
    lanes[place + i], lanes[place + _LANES + i], lanes[place + 2 * _LANES + i] = v


@njit(cache=True, error_model="numpy")
def _sweep(matrix, n, swept, lanes):
    # One loop over one array, without a branch: vector instructions take eight matches at once.
    across, down, other, last = matrix
    for i in range(n):
        before, now, pixels = _three(lanes, _BEFORE, i), _three(lanes, _NOW, i), _three(lanes, _PIXELS, i)
        depth = _raised(last, pixels)
        seen = _raised(across, pixels) / depth, _raised(down, pixels) / depth, _raised(other, pixels) / depth
        # A = ∂g/∂m by its rows, and R⁻ Aᵀ by its rows.
        p = _over(_minus(across, seen[0], last), depth)
        q = _over(_minus(down, seen[1], last), depth)
        r = _over(_minus(other, seen[2], last), depth)
        gain = (
            _by_rows(_three(lanes, _COV_BEFORE, i), p, q, r),
            _by_rows(_three(lanes, _COV_BEFORE + 3 * _LANES, i), p, q, r),
            _by_rows(_three(lanes, _COV_BEFORE + 6 * _LANES, i), p, q, r),
        )
        off = pixels[0] - before[0], pixels[1] - before[1], pixels[2] - before[2]
        nu = _plus(now[0] - seen[0], p, off), _plus(now[1] - seen[1], q, off), _plus(now[2] - seen[2], r, off)
        chol = _factored(_six(lanes, _COV_NOW, i), p, q, r, gain)
        solved = _solved(chol, nu)
        moved = _plus(before[0], gain[0], solved), _plus(before[1], gain[1], solved), _plus(before[2], gain[2], solved)
        change = max(abs(moved[0] - pixels[0]), abs(moved[1] - pixels[1]), abs(moved[2] - pixels[2]))
        # Converged points, and those behind the camera, stay as they are.
        goes_on = (lanes[_CHANGE + i] > swept) & (depth > 0.0)
        lanes[_CHANGE + i] = change if goes_on else 0.0
        lanes[_PIXELS + i] = moved[0] if goes_on else pixels[0]
        lanes[_PIXELS + _LANES + i] = moved[1] if goes_on else pixels[1]
        lanes[_PIXELS + 2 * _LANES + i] = moved[2] if goes_on else pixels[2]
        lanes[_DEPTH + i] = depth
        _put(lanes, _SEEN, i, seen)
        _put(lanes, _NU, i, nu)
        _put(lanes, _CHOL, i, (chol[0], chol[1], chol[2]))
        _put(lanes, _CHOL + 3 * _LANES, i, (chol[3], chol[4], chol[5]))


@njit(cache=True, error_model="numpy")
def _rows(matrix):
    # Of H (4, 4), in registers.
    return (
        (matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]),
        (matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]),
        (matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]),
        (matrix[3, 0], matrix[3, 1], matrix[3, 2], matrix[3, 3]),
    )


@njit(cache=True, error_model="numpy")
def _adjust(matrix, first, n, z_prev, z_now, cov_prev, cov_now, noisy, sweeps, swept, lanes):
    # Fills the lanes with n matches from index `first` on and adjusts m̂.
    for i in range(n):
        k = first + i
        for a in range(3):
            lanes[_BEFORE + a * _LANES + i], lanes[_NOW + a * _LANES + i] = z_prev[k, a], z_now[k, a]
            lanes[_PIXELS + a * _LANES + i] = z_prev[k, a]
            for b in range(3):
                lanes[_COV_BEFORE + (3 * a + b) * _LANES + i] = cov_prev[k, a, b] if noisy else 0.0
            for b in range(a + 1):
                lanes[_COV_NOW + (a * (a + 1) // 2 + b) * _LANES + i] = cov_now[k, a, b]
        lanes[_CHANGE + i] = np.inf if sweeps > 0 else 0.0
    rows = _rows(matrix)
    for sweep in range(sweeps + 1):
        _sweep(rows, n, np.inf if sweep == sweeps else swept, lanes)
        if not lanes[_CHANGE : _CHANGE + n].any():
            break


@njit(cache=True, error_model="numpy", inline="always")
def _pixel_row(down, point, nearness, seen, camera):
    """A row of ∂g/∂ξ, for v or u: with a = ∂pixel/∂p at the point p it is a × p and −ρ a, signs as of T Exp(ξ)."""
    a, b = (0.0, camera[1] / point[2]) if down else (camera[0] / point[2], 0.0)
    c = ((camera[3] if down else camera[2]) - seen) / point[2]
    x, y, z = b * point[2] - c * point[1], c * point[0] - a * point[2], a * point[1] - b * point[0]
    return x, y, z, -nearness * a, -nearness * b, -nearness * c


@njit(cache=True, error_model="numpy")
def white_rows(matrix, camera, z_prev, z_now, cov_prev, cov_now, noisy, sweeps, swept, rows, front, best):
    """Fills rows (K, 3, 7) with L⁻¹ [ν, −∂g/∂ξ], front (K,) and best (K, 3) with m̂; zeros for a point behind.

    Inputs: pixels z (K, 3) with covariances (K, 3, 3), the matrix H (4, 4) and the `camera` (fx, fy, cx, cy, fx · baseline).
    `noisy`: S includes the earlier pixels' noise. m̂ is adjusted at most `sweeps` times, until it changes by < `swept`.
    """
    lanes, by_motion, count = np.empty(_ALL), np.empty((3, 6)), z_prev.shape[0]
    for first in range(0, count, _LANES):
        n = min(_LANES, count - first)
        _adjust(matrix, first, n, z_prev, z_now, cov_prev, cov_now, noisy, sweeps, swept, lanes)
        for i in range(n):
            k, depth, pixels, seen = first + i, lanes[_DEPTH + i], _three(lanes, _PIXELS, i), _three(lanes, _SEEN, i)
            front[k] = depth > 0.0
            best[k, 0], best[k, 1], best[k, 2] = pixels
            if front[k]:
                x, y = (seen[0] - camera[2]) * depth / camera[0], (seen[1] - camera[3]) * depth / camera[1]
                point, nearness = (x, y, depth), (pixels[0] - pixels[2]) / camera[4]
                for a in range(3):
                    row = _pixel_row(a == 1, point, nearness, seen[a], camera)
                    for m in range(6):
                        by_motion[a, m] = row[m]
                chol = _six(lanes, _CHOL, i)
                rows[k, 0, 0], rows[k, 1, 0], rows[k, 2, 0] = _solved_lower(chol, _three(lanes, _NU, i))
                for m in range(6):
                    column = -by_motion[0, m], -by_motion[1, m], -by_motion[2, m]
                    rows[k, 0, m + 1], rows[k, 1, m + 1], rows[k, 2, m + 1] = _solved_lower(chol, column)
            else:
                rows[k] = 0.0


@njit(cache=True, error_model="numpy")
def distances(matrix, z_prev, z_now, cov_prev, cov_now, noisy, sweeps, swept, squared):
    """Fills squared (K,) with νᵀS⁻¹ν, infinite for a point behind the camera; arguments as above."""
    lanes, count = np.empty(_ALL), z_prev.shape[0]
    for first in range(0, count, _LANES):
        n = min(_LANES, count - first)
        _adjust(matrix, first, n, z_prev, z_now, cov_prev, cov_now, noisy, sweeps, swept, lanes)
        for i in range(n):
            white = _solved_lower(_six(lanes, _CHOL, i), _three(lanes, _NU, i))
            squared[first + i] = _dot(white, white) if lanes[_DEPTH + i] > 0.0 else np.inf


@njit(cache=True, error_model="numpy", inline="always")
def _white(lanes, place, i, v):
    # W v of a point whose z⁻, z and W start at the row `place`.
    first = _dot(_three(lanes, place + 6 * _LANES, i), v)
    return first, _dot(_three(lanes, place + 9 * _LANES, i), v), _dot(_three(lanes, place + 12 * _LANES, i), v)


@njit(cache=True, error_model="numpy")
def _miss(matrix, n, lanes):
    # d² of the lanes, without a branch as in `_sweep`.
    across, down, other, last = matrix
    for i in range(n):
        before, now = _three(lanes, _BEFORE, i), _three(lanes, _NOW, i)
        depth = _raised(last, before)
        seen = _over((_raised(across, before), _raised(down, before), _raised(other, before)), depth)
        white = _white(lanes, _BEFORE, i, (now[0] - seen[0], now[1] - seen[1], now[2] - seen[2]))
        lanes[_SQUARED + i] = _dot(white, white) if depth > 0.0 else np.inf


@njit(cache=True, error_model="numpy")
def scores(matrices, z_prev, z_now, white, gate, score, agreeing):
    """Fills score (C,) with Σ min(d², gate) over the matches and agreeing (C,) with how many have d² ≤ gate.

    Inputs are matrices H (C, 4, 4), pixels z (K, 3) and `white` W (K, 3, 3), with d² = ‖W (z − g)‖².
    """
    lanes, count = np.empty(_ALL), z_prev.shape[0]
    score[:], agreeing[:] = 0.0, 0.0
    for first in range(0, count, _LANES):
        n = min(_LANES, count - first)
        for i in range(n):
            for a in range(3):
                lanes[_BEFORE + a * _LANES + i] = z_prev[first + i, a]
                lanes[_NOW + a * _LANES + i] = z_now[first + i, a]
                for b in range(3):
                    lanes[_WHITE + (3 * a + b) * _LANES + i] = white[first + i, a, b]
        for c in range(matrices.shape[0]):
            _miss(_rows(matrices[c]), n, lanes)
            total, inside = score[c], agreeing[c]
            for i in range(n):
                squared = lanes[_SQUARED + i]
                inside += 1.0 if squared <= gate else 0.0
                total += min(squared, gate)
            score[c], agreeing[c] = total, inside


@njit(cache=True, error_model="numpy")
def _difference(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, error_model="numpy")
def _unit(v):
    length = max(math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), FLAT)
    return v[0] / length, v[1] / length, v[2] / length


@njit(cache=True, error_model="numpy")
def _frame(points, triple):
    """A triangle's first edge, the direction across it in its plane, and the plane's normal; and its centre."""
    a, b, c = points[triple[0]], points[triple[1]], points[triple[2]]
    edge = _unit(_difference(b, a))
    normal = _unit(cross(edge, _difference(c, a)))
    centre = ((a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, (a[2] + b[2] + c[2]) / 3.0)
    return edge, cross(normal, edge), normal, centre


@njit(cache=True, error_model="numpy")
def _align(before, now, triple):
    """T with T now = before: the triangles' planes, centres and first edges are made to coincide."""
    a0, a1, a2, centre = _frame(before, triple)
    b0, b1, b2, middle = _frame(now, triple)
    turn = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            turn[i, j] = a0[i] * b0[j] + a1[i] * b1[j] + a2[i] * b2[j]
    quat = quaternion(turn)
    return quat, _difference(centre, turned(quat, middle))


@njit(cache=True, error_model="numpy")
def _transformed(quat, shift, pixels, camera):
    """A point (x, y, 1, ρ) ~ Q⁻¹ (m, 1) after the motion: its position as a multiple of the depth before it, and ρ."""
    nearness = (pixels[0] - pixels[2]) / camera[4]
    x, y = (pixels[0] - camera[2]) / camera[0], (pixels[1] - camera[3]) / camera[1]
    apart = (x - nearness * shift[0], y - nearness * shift[1], 1.0 - nearness * shift[2])
    return turned((-quat[0], -quat[1], -quat[2], quat[3]), apart), nearness


@njit(cache=True, error_model="numpy")
def _projected(point, nearness, camera):
    """Pixels g of a point in front of the camera."""
    left = camera[0] * point[0] / point[2] + camera[2]
    down = camera[1] * point[1] / point[2] + camera[3]
    return left, down, left - camera[4] * nearness / point[2]


# Triples side by side, one per lane: z⁻, z and W by rows of each of three points; the motion T; a copy of one of the points:
# whitened derivatives (6) of three pixels, and their error; then products of these seven columns, Σ aᵢ bᵢ for b ≤ a, by rows.
_POINT, _POSE, _ONE, _SLOPE, _PRODUCTS = 15 * _LANES, 45 * _LANES, 52 * _LANES, 67 * _LANES, 88 * _LANES
_GUESSED, _MISSED, _OF_TRIPLES = _SLOPE, _SLOPE + _LANES, 116 * _LANES


@njit(cache=True, error_model="numpy", inline="always")
def _at(a, b):
    return _PRODUCTS + (a * (a + 1) // 2 + b) * _LANES


@njit(cache=True, error_model="numpy", inline="always")
def _motion(lanes, i):
    quat = (*_three(lanes, _POSE, i), lanes[_POSE + 3 * _LANES + i])
    return quat, _three(lanes, _POSE + 4 * _LANES, i)


@njit(cache=True, error_model="numpy", inline="always")
def _put_motion(lanes, i, quat, shift):
    _put(lanes, _POSE, i, (quat[0], quat[1], quat[2]))
    lanes[_POSE + 3 * _LANES + i] = quat[3]
    _put(lanes, _POSE + 4 * _LANES, i, shift)


@njit(cache=True, error_model="numpy", inline="always")
def _take_point(lanes, j):
    # Copies point j to a fixed place: unrolling the code for each of three points would triple the compile time.
    for i in range(_POINT):
        lanes[_ONE + i] = lanes[j * _POINT + i]


@njit(cache=True, error_model="numpy")
def _squared_distances(lanes, n, camera):
    # Σ d² of a triple's points under the motion, infinite where one is behind the camera.
    lanes[_MISSED : _MISSED + n] = 0.0
    for j in range(3):
        _take_point(lanes, j)
        for i in range(n):
            quat, shift = _motion(lanes, i)
            point, nearness = _transformed(quat, shift, _three(lanes, _ONE, i), camera)
            miss = _difference(_three(lanes, _ONE + 3 * _LANES, i), _projected(point, nearness, camera))
            p, q, r = _white(lanes, _ONE, i, miss)
            squared = lanes[_MISSED + i] + p * p + q * q + r * r
            lanes[_MISSED + i] = squared if point[2] > 0.0 else np.inf


@njit(cache=True, error_model="numpy", inline="always")
def _put_slopes(lanes, n, camera):
    # Derivatives of the copied point; one behind the camera is treated as at infinity and seen at the pixels (0, 0, 0).
    for i in range(n):
        quat, shift = _motion(lanes, i)
        point, nearness = _transformed(quat, shift, _three(lanes, _ONE, i), camera)
        seen, front = _projected(point, nearness, camera), point[2] > 0.0
        seen = (seen[0] if front else 0.0, seen[1] if front else 0.0, seen[2] if front else 0.0)
        x, y = point[0] if front else -camera[2] / camera[0], point[1] if front else -camera[3] / camera[1]
        point, nearness = (x, y, point[2] if front else 1.0), nearness if front else 0.0
        left = _pixel_row(False, point, nearness, seen[0], camera)
        down = _pixel_row(True, point, nearness, seen[1], camera)
        right = _pixel_row(False, point, nearness, seen[2], camera)
        miss = _difference(_three(lanes, _ONE + 3 * _LANES, i), seen)
        _put_column(lanes, _SLOPE, i, _white(lanes, _ONE, i, (left[0], down[0], right[0])))
        _put_column(lanes, _SLOPE + _LANES, i, _white(lanes, _ONE, i, (left[1], down[1], right[1])))
        _put_column(lanes, _SLOPE + 2 * _LANES, i, _white(lanes, _ONE, i, (left[2], down[2], right[2])))
        _put_column(lanes, _SLOPE + 3 * _LANES, i, _white(lanes, _ONE, i, (left[3], down[3], right[3])))
        _put_column(lanes, _SLOPE + 4 * _LANES, i, _white(lanes, _ONE, i, (left[4], down[4], right[4])))
        _put_column(lanes, _SLOPE + 5 * _LANES, i, _white(lanes, _ONE, i, (left[5], down[5], right[5])))
        _put_column(lanes, _SLOPE + 6 * _LANES, i, _white(lanes, _ONE, i, miss))


@njit(cache=True, error_model="numpy", inline="always")
def _put_column(lanes, place, i, v):
    lanes[place + i], lanes[place + 7 * _LANES + i], lanes[place + 14 * _LANES + i] = v


@njit(cache=True, error_model="numpy")
def _solve_triples(lanes, n, camera):
    """Writes a Gauss-Newton step (6) into the last row of the products."""
    lanes[_PRODUCTS:] = 0.0
    for j in range(3):
        _take_point(lanes, j)
        _put_slopes(lanes, n, camera)
        for a in range(7):
            for b in range(min(a + 1, 6)):
                out, p, q = _at(a, b), _SLOPE + a * _LANES, _SLOPE + b * _LANES
                for i in range(n):
                    total = lanes[out + i] + lanes[p + i] * lanes[q + i]
                    total = total + lanes[p + 7 * _LANES + i] * lanes[q + 7 * _LANES + i]
                    lanes[out + i] = total + lanes[p + 14 * _LANES + i] * lanes[q + 14 * _LANES + i]
    for i in range(n):
        trace = lanes[_at(0, 0) + i] + lanes[_at(1, 1) + i] + lanes[_at(2, 2) + i]
        trace = trace + lanes[_at(3, 3) + i] + lanes[_at(4, 4) + i] + lanes[_at(5, 5) + i]
        for a in range(6):
            lanes[_at(a, a) + i] += STIFFNESS * trace + np.finfo(np.float64).tiny
    # Cholesky factorisation and substitution, as in `rbpf.kernels.dense`.
    for a in range(7):
        for b in range(min(a + 1, 6)):
            out, pivot = _at(a, b), _at(b, b)
            for c in range(b):
                _take_off(lanes, n, out, _at(a, c), _at(b, c))
            for i in range(n):
                lanes[out + i] = math.sqrt(lanes[out + i]) if a == b else lanes[out + i] / lanes[pivot + i]
    for a in range(5, -1, -1):
        for b in range(a + 1, 6):
            _take_off(lanes, n, _at(6, a), _at(b, a), _at(6, b))
        for i in range(n):
            lanes[_at(6, a) + i] /= lanes[_at(a, a) + i]


@njit(cache=True, error_model="numpy", inline="always")
def _take_off(lanes, n, out, p, q):
    for i in range(n):
        lanes[out + i] -= lanes[p + i] * lanes[q + i]


@njit(cache=True, error_model="numpy")
def propose(rows, before, now, z_prev, z_now, white, camera, start, steps, motions):
    """Fills motions (C, 7) with the proposals of triples of matches, `rows` (C, 3).

    The points `before` and `now` (K, 3) of a triple are aligned; the better of this motion and `start` (7,), judged on the
    triple's pixels z (K, 3), is refined by `steps` Gauss-Newton steps. `white` and `camera` as above.
    """
    lanes = np.empty(_OF_TRIPLES)
    camera = (camera[0], camera[1], camera[2], camera[3], camera[4])
    guess = ((start[0], start[1], start[2], start[3]), (start[4], start[5], start[6]))
    for first in range(0, rows.shape[0], _LANES):
        n = min(_LANES, rows.shape[0] - first)
        for i in range(n):
            for j in range(3):
                k, place = rows[first + i, j], j * _POINT + i
                for a in range(3):
                    lanes[place + a * _LANES], lanes[place + (3 + a) * _LANES] = z_prev[k, a], z_now[k, a]
                    for b in range(3):
                        lanes[place + (6 + 3 * a + b) * _LANES] = white[k, a, b]
            _put_motion(lanes, i, guess[0], guess[1])
        _squared_distances(lanes, n, camera)
        for i in range(n):
            lanes[_GUESSED + i] = lanes[_MISSED + i]
            quat, shift = _align(before, now, rows[first + i])
            _put_motion(lanes, i, quat, shift)
        _squared_distances(lanes, n, camera)
        for i in range(n):
            if lanes[_GUESSED + i] < lanes[_MISSED + i]:
                _put_motion(lanes, i, guess[0], guess[1])
        for _ in range(steps):
            _solve_triples(lanes, n, camera)
            for i in range(n):
                quat, shift = _motion(lanes, i)
                turn, way = exp_pair(_three(lanes, _at(6, 0), i), _three(lanes, _at(6, 3), i))
                way = turned(quat, way)
                _put_motion(lanes, i, multiply(quat, turn), (shift[0] + way[0], shift[1] + way[1], shift[2] + way[2]))
        for i in range(n):
            for a in range(7):
                motions[first + i, a] = lanes[_POSE + a * _LANES + i]
