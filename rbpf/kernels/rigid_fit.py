"""Driver: rigid motions that fit a shape to points, each weighed by what is known of its place in the shape."""

import numpy as np
from numba import float64, int64, njit, void

from rbpf.kernels.dense import factor, solve
from rbpf.kernels.se3 import exp_pair, multiply, rotation, turned
from rbpf.kernels.signature import CUBE, MATRIX, READ_ONLY, READ_ONLY_CUBE

_GIVEN = READ_ONLY_CUBE, READ_ONLY_CUBE, READ_ONLY, READ_ONLY_CUBE, READ_ONLY


@njit(cache=True, error_model="numpy")
def _linearise(quat, shift, world, shape, weight, weighed, info, vector):
    """Fills JᵀW (M, 6, 3), the lower triangle of Σ JᵀWJ (6, 6) and Σ JᵀW r (6,), r = T⁻¹p − k."""
    jac = np.zeros((3, 6))
    back = (-quat[0], -quat[1], -quat[2], quat[3])
    info[:], vector[:] = 0.0, 0.0
    for m in range(world.shape[0]):
        apart = (world[m, 0] - shift[0], world[m, 1] - shift[1], world[m, 2] - shift[2])
        q = turned(back, apart)
        rest = (q[0] - shape[m, 0], q[1] - shape[m, 1], q[2] - shape[m, 2])
        # [[q]× | −I], the derivative of T⁻¹p = q by T Exp(ξ).
        jac[0, 1], jac[0, 2], jac[1, 2] = -q[2], q[1], -q[0]
        jac[1, 0], jac[2, 0], jac[2, 1] = q[2], -q[1], q[0]
        jac[0, 3] = jac[1, 4] = jac[2, 5] = -1.0
        for e in range(6):
            for a in range(3):
                row = jac[0, e] * weight[m, 0, a] + jac[1, e] * weight[m, 1, a] + jac[2, e] * weight[m, 2, a]
                weighed[m, e, a] = row
                vector[e] += row * rest[a]
                for f in range(e + 1):
                    info[e, f] += row * jac[a, f]


@njit(cache=True, error_model="numpy")
def _spread(slope, cov, out):
    """Out += slope P slopeᵀ, symmetric to the bit."""
    size = cov.shape[0]
    moved = np.empty((6, size))
    for e in range(6):
        moved[e] = 0.0
        for a in range(size):
            for b in range(size):
                moved[e, b] += slope[e, a] * cov[a, b]
        for f in range(e + 1):
            total = out[e, f]
            for b in range(size):
                total += moved[e, b] * slope[f, b]
            out[e, f] = out[f, e] = total


@njit(void(*_GIVEN, int64, float64, MATRIX, CUBE, CUBE, CUBE), cache=True, error_model="numpy")
def rigid_fit(world, cov, shape, weight, start, rounds, settled, frame, slope, cov_fit, cov_frame):
    """Fills `frame` (N, 7) with the motions T that take the `shape` k (M, 3) to the points p (N, M, 3) `world`.

    Gauss-Newton on r_m = T⁻¹ p_m − k_m, of information `weight` (M, 3, 3), from `start` (1, 7): at most so many
    `rounds`, until no component of a step is longer than `settled`. In the right chart at the frame, `slope` (N, 6, 3M)
    is its derivative by the points, `cov_fit` (N, 6, 6) = Λ⁻¹ its covariance given the points, and `cov_frame`
    (N, 6, 6) that of all, for points of joint covariance `cov` (N, 3M, 3M).
    """
    weighed = np.empty((world.shape[1], 6, 3))
    info, step = np.empty((6, 6)), np.empty(6)
    for i in range(world.shape[0]):
        quat = (start[0, 0], start[0, 1], start[0, 2], start[0, 3])
        shift = (start[0, 4], start[0, 5], start[0, 6])
        for _ in range(rounds):
            _linearise(quat, shift, world[i], shape, weight, weighed, info, step)
            factor(info)
            solve(info, step)
            turn, way = exp_pair((-step[0], -step[1], -step[2]), (-step[3], -step[4], -step[5]))
            way = turned(quat, way)
            quat, shift = multiply(quat, turn), (shift[0] + way[0], shift[1] + way[1], shift[2] + way[2])
            if np.abs(step).max() <= settled:
                break
        frame[i, 0], frame[i, 1], frame[i, 2], frame[i, 3] = quat
        frame[i, 4], frame[i, 5], frame[i, 6] = shift
        # The fit's derivative by the points, −Λ⁻¹ JᵀW Rᵀ.
        back = rotation(-quat[0], -quat[1], -quat[2], quat[3])
        for m in range(weighed.shape[0]):
            for f in range(3):
                column, u, v, w = slope[i, :, 3 * m + f], back[f], back[3 + f], back[6 + f]
                for e in range(6):
                    column[e] = -(weighed[m, e, 0] * u + weighed[m, e, 1] * v + weighed[m, e, 2] * w)
                solve(info, column)
        # Λ⁻¹, symmetric to the bit.
        for f in range(6):
            column = cov_fit[i, :, f]
            column[:] = 0.0
            column[f] = 1.0
            solve(info, column)
        for e in range(6):
            for f in range(e):
                cov_fit[i, e, f] = cov_fit[i, f, e]
        cov_frame[i] = cov_fit[i]
        _spread(slope[i], cov[i], cov_frame[i])
