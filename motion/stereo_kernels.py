"""Compiled: the innovations of matches, and the score and the proposals of the consensus search; one match at a time.

In the proposals of triples vectors are tuples, and a pose is a quaternion (x, y, z, w) and a translation.
"""

import math

import numpy as np
from numba import njit

from rbpf.kernels.dense import factor, solve
from rbpf.kernels.se3 import cross, exp_pair, multiply, quaternion, turned

#: Added to the information of a triple, as a fraction of its trace: three points on a line leave a turn open.
STIFFNESS = 1e-9
FLAT = 1e-12  #: Shortest length that is divided by: points that coincide have no direction.


@njit(cache=True, error_model="numpy")
def white_rows(matrix, camera, z_prev, z_now, cov_prev, cov_now, noisy, sweeps, swept, rows, front, best):
    """Fills rows (K, 3, 7) with L⁻¹ [ν, −∂g/∂ξ], front (K,) and best (K, 3) with m̂; zeros for a point behind.

    Of pixels z (K, 3) with covariances (K, 3, 3), the matrix H (4, 4) and the `camera` (fx, fy, cx, cy, fx · baseline).
    `noisy`: the earlier pixels' noise is in S. m̂ is adjusted in `sweeps`, until it changes by less than `swept`.
    """
    pixels, seen, slope = np.empty(3), np.empty(3), np.empty((3, 3))
    chol, gain, gained = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(z_prev.shape[0]):
        for i in range(3):
            pixels[i] = z_prev[k, i]
        change = np.inf
        for sweep in range(sweeps + 1):
            depth = _see(matrix, pixels, seen, slope)
            front[k] = depth > 0.0
            if not front[k]:
                break
            _innovate(k, pixels, seen, slope, z_prev, z_now, cov_prev, cov_now, noisy, rows, gain, chol)
            if sweep == sweeps or change <= swept:
                break
            for i in range(3):
                gained[i] = rows[k, i, 0]
            _solve(chol, gained)
            change = 0.0
            for i in range(3):
                moved = z_prev[k, i]
                for j in range(3):
                    moved += gain[i, j] * gained[j]
                change = max(change, abs(moved - pixels[i]))
                pixels[i] = moved
        for i in range(3):
            best[k, i] = pixels[i]
        if front[k]:
            x, y = (seen[0] - camera[2]) * depth / camera[0], (seen[1] - camera[3]) * depth / camera[1]
            _pixel_jacobian((x, y, depth), (pixels[0] - pixels[2]) / camera[4], seen, camera, rows[k, :, 1:])
            rows[k, :, 1:] *= -1.0
            for n in range(7):
                _solve_lower(chol, rows[k, :, n])
        else:
            rows[k] = 0.0


@njit(cache=True, error_model="numpy")
def scores(matrices, z_prev, z_now, white, gate, score, agreeing):
    """Fills score (C,) with Σ min(d², gate) over the matches and agreeing (C,) with how many have d² ≤ gate.

    Of matrices H (C, 4, 4), pixels z (K, 3) and `white` W (K, 3, 3), with d² = ‖W (z − g)‖².
    """
    miss = np.empty(3)
    for c in range(matrices.shape[0]):
        matrix, total, count = matrices[c], 0.0, 0
        for k in range(z_prev.shape[0]):
            squared = np.inf
            depth = _raised(matrix, 3, z_prev[k])
            if depth > 0.0:
                for i in range(3):
                    miss[i] = z_now[k, i] - _raised(matrix, i, z_prev[k]) / depth
                squared = 0.0
                for i in range(3):
                    part = _whitened(white[k], miss, i)
                    squared += part * part
            if squared <= gate:
                count += 1
                total += squared
            else:
                total += gate
        score[c], agreeing[c] = total, count


@njit(cache=True, error_model="numpy", inline="always")
def _raised(matrix, i, pixels):
    return matrix[i, 0] * pixels[0] + matrix[i, 1] * pixels[1] + matrix[i, 2] * pixels[2] + matrix[i, 3]


@njit(cache=True, error_model="numpy")
def _see(matrix, pixels, seen, slope):
    # g and A at the pixels; returns the depth, relative to that before the motion.
    depth = _raised(matrix, 3, pixels)
    for i in range(3):
        seen[i] = _raised(matrix, i, pixels) / depth
        for j in range(3):
            slope[i, j] = (matrix[i, j] - seen[i] * matrix[3, j]) / depth
    return depth


@njit(cache=True, error_model="numpy")
def _innovate(k, pixels, seen, slope, z_prev, z_now, cov_prev, cov_now, noisy, rows, gain, chol):
    # ν into rows[k, :, 0], R⁻ Aᵀ into gain, the Cholesky factor of S into chol.
    for i in range(3):
        nu = z_now[k, i] - seen[i]
        for j in range(3):
            nu -= slope[i, j] * (z_prev[k, j] - pixels[j])
            gain[i, j] = 0.0
            for m in range(3):
                gain[i, j] += cov_prev[k, i, m] * slope[j, m]
        rows[k, i, 0] = nu
    for i in range(3):
        for j in range(i + 1):
            entry = cov_now[k, i, j]
            if noisy:
                for m in range(3):
                    entry += slope[i, m] * gain[m, j]
            chol[i, j] = entry
    _factor(chol)


# As in `rbpf.kernels.dense`, of three rows: what runs over a length that is known takes half the time.
@njit(cache=True, error_model="numpy", inline="always")
def _factor(chol):
    for a in range(3):
        for b in range(a):
            for c in range(b):
                chol[a, b] -= chol[a, c] * chol[b, c]
            chol[a, b] /= chol[b, b]
        for c in range(a):
            chol[a, a] -= chol[a, c] * chol[a, c]
        chol[a, a] = math.sqrt(chol[a, a])


@njit(cache=True, error_model="numpy", inline="always")
def _solve_lower(chol, vector):
    for a in range(3):
        for b in range(a):
            vector[a] -= chol[a, b] * vector[b]
        vector[a] /= chol[a, a]


@njit(cache=True, error_model="numpy", inline="always")
def _solve(chol, vector):
    _solve_lower(chol, vector)
    for a in range(2, -1, -1):
        for b in range(a + 1, 3):
            vector[a] -= chol[b, a] * vector[b]
        vector[a] /= chol[a, a]


@njit(cache=True, error_model="numpy")
def propose(rows, before, now, z_prev, z_now, white, camera, start, steps, motions):
    """Fills motions (C, 7) with what triples of matches, `rows` (C, 3), propose.

    A triple's points, of those `before` and `now` (K, 3), are aligned; the better of this and `start` (7,) on the triple's
    pixels z (K, 3) is refined by some `steps` of Gauss-Newton. `white` and `camera` as above.
    """
    row, vector, info = np.empty((3, 6)), np.empty(6), np.empty((6, 6))
    guess = ((start[0], start[1], start[2], start[3]), (start[4], start[5], start[6]))
    for c in range(rows.shape[0]):
        triple = rows[c]
        quat, shift = _align(before, now, triple)
        aligned = _squared_distance(quat, shift, triple, z_prev, z_now, white, camera)
        if _squared_distance(guess[0], guess[1], triple, z_prev, z_now, white, camera) < aligned:
            quat, shift = guess
        for _ in range(steps):
            _normal_equations(quat, shift, triple, z_prev, z_now, white, camera, row, vector, info)
            factor(info)
            solve(info, vector)
            turn, way = exp_pair((vector[0], vector[1], vector[2]), (vector[3], vector[4], vector[5]))
            way = turned(quat, way)
            quat, shift = multiply(quat, turn), (shift[0] + way[0], shift[1] + way[1], shift[2] + way[2])
        motions[c, 0], motions[c, 1], motions[c, 2], motions[c, 3] = quat
        motions[c, 4], motions[c, 5], motions[c, 6] = shift


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
    """T with T now = before: the triangles' planes, centres and first edges are laid on one another."""
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
    """A point (x, y, 1, ρ) ~ Q⁻¹ (m, 1) after the motion: its place relative to that depth, and ρ."""
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


@njit(cache=True, error_model="numpy")
def _whitened(white, v, i):
    return white[i, 0] * v[0] + white[i, 1] * v[1] + white[i, 2] * v[2]


@njit(cache=True, error_model="numpy")
def _squared_distance(quat, shift, triple, z_prev, z_now, white, camera):
    """Squared distance of a triple from a motion; infinite behind the camera."""
    total = 0.0
    for k in triple:
        point, nearness = _transformed(quat, shift, z_prev[k], camera)
        if not point[2] > 0.0:
            return np.inf
        miss = _difference(z_now[k], _projected(point, nearness, camera))
        for i in range(3):
            part = _whitened(white[k], miss, i)
            total += part * part
    return total


@njit(cache=True, error_model="numpy")
def _normal_equations(quat, shift, triple, z_prev, z_now, white, camera, row, vector, info):
    """Fills info (6, 6), its lower triangle, with JᵀJ and vector (6,) with Jᵀε of a triple's whitened pixels.

    A point behind the camera counts as one at infinity that is seen at the pixels (0, 0, 0).
    """
    info[:], vector[:] = 0.0, 0.0
    slope = np.empty(6)
    for k in triple:
        point, nearness = _transformed(quat, shift, z_prev[k], camera)
        if point[2] > 0.0:
            seen = _projected(point, nearness, camera)
        else:
            seen, nearness = (0.0, 0.0, 0.0), 0.0
            point = (-camera[2] / camera[0], -camera[3] / camera[1], 1.0)
        miss = _difference(z_now[k], seen)
        _pixel_jacobian(point, nearness, seen, camera, row)
        for i in range(3):
            error = _whitened(white[k], miss, i)
            for e in range(6):
                slope[e] = _whitened(white[k], (row[0, e], row[1, e], row[2, e]), i)
                vector[e] += slope[e] * error
                for f in range(e + 1):
                    info[e, f] += slope[e] * slope[f]
    trace = info[0, 0] + info[1, 1] + info[2, 2] + info[3, 3] + info[4, 4] + info[5, 5]
    for e in range(6):
        info[e, e] += STIFFNESS * trace + np.finfo(np.float64).tiny


@njit(cache=True, error_model="numpy")
def _pixel_jacobian(point, nearness, seen, camera, row):
    """∂g/∂ξ (3, 6): with the slope a of a pixel by the point p, a × p and −ρ a with the sign of T Exp(ξ)."""
    for i in range(3):
        a, b = (0.0, camera[1] / point[2]) if i == 1 else (camera[0] / point[2], 0.0)
        c = ((camera[3] if i == 1 else camera[2]) - seen[i]) / point[2]
        row[i, 0], row[i, 1] = b * point[2] - c * point[1], c * point[0] - a * point[2]
        row[i, 2] = a * point[1] - b * point[0]
        row[i, 3], row[i, 4], row[i, 5] = -nearness * a, -nearness * b, -nearness * c
