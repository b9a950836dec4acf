"""Compiled: the innovations of matches, one match at a time."""

import numpy as np
from numba import njit

from rbpf.kernels.dense import factor, solve, solve_lower


@njit(cache=True, error_model="numpy")
def white_rows(matrix, camera, z_prev, z_now, cov_prev, cov_now, noisy, sweeps, swept, rows, front, best):
    """Fills rows (K, 3, 7) with L⁻¹ [ν, −∂g/∂ξ], front (K,) and best (K, 3) with m̂; zeros for a point behind.

    Of pixels z (K, 3) with covariances (K, 3, 3), the matrix H (4, 4) and the `camera` (fx, fy, cx, cy, fx · baseline).
    `noisy`: the earlier pixels' noise is in S. m̂ is adjusted in `sweeps`, until it changes by less than `swept`.
    """
    pixels, seen, slope = np.empty(3), np.empty(3), np.empty((3, 3))
    chol, gain, gained = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(z_prev.shape[0]):
        pixels[:] = z_prev[k]
        change = np.inf
        for sweep in range(sweeps + 1):
            depth = _see(matrix, pixels, seen, slope)
            front[k] = depth > 0.0
            if not front[k]:
                break
            _innovate(k, pixels, seen, slope, z_prev, z_now, cov_prev, cov_now, noisy, rows, gain, chol)
            if sweep == sweeps or change <= swept:
                break
            gained[:] = rows[k, :, 0]
            solve(chol, gained)
            change = 0.0
            for i in range(3):
                moved = z_prev[k, i]
                for j in range(3):
                    moved += gain[i, j] * gained[j]
                change = max(change, abs(moved - pixels[i]))
                pixels[i] = moved
        best[k] = pixels
        if front[k]:
            x, y = (seen[0] - camera[2]) * depth / camera[0], (seen[1] - camera[3]) * depth / camera[1]
            _pixel_jacobian((x, y, depth), (pixels[0] - pixels[2]) / camera[4], seen, camera, rows[k, :, 1:])
            rows[k, :, 1:] *= -1.0
            for n in range(7):
                solve_lower(chol, rows[k, :, n])
        else:
            rows[k] = 0.0


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
    factor(chol)


@njit(cache=True, error_model="numpy")
def _pixel_jacobian(point, nearness, seen, camera, row):
    """∂g/∂ξ (3, 6): with the slope a of a pixel by the point p, a × p and −ρ a with the sign of T Exp(ξ)."""
    for i in range(3):
        a, b = (0.0, camera[1] / point[2]) if i == 1 else (camera[0] / point[2], 0.0)
        c = ((camera[3] if i == 1 else camera[2]) - seen[i]) / point[2]
        row[i, 0], row[i, 1] = b * point[2] - c * point[1], c * point[0] - a * point[2]
        row[i, 2] = a * point[1] - b * point[0]
        row[i, 3], row[i, 4], row[i, 5] = -nearness * a, -nearness * b, -nearness * c
