"""Compiled twins of `rbpf.motion.stereo_reprojection` and of the consensus' score: one match after the other."""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def white_rows(matrix, camera, z_prev, z_now, cov_prev, cov_now, noisy, sweeps, swept, rows, front, best):
    """Fills rows (K, 3, 7) with L⁻¹ [ν, −∂g/∂ξ], front (K,) and best (K, 3) with m̂; zeros for a point behind.

    Args:
        matrix: (4, 4) H.
        camera: (5,) fx, fy, cx, cy, fx · baseline.
        z_prev: (K, 3).
        z_now: (K, 3).
        cov_prev: (K, 3, 3).
        cov_now: (K, 3, 3).
        noisy: whether the earlier pixels' noise is in S.
        sweeps: of the adjustment of m̂, 0 for none.
        swept: change of m̂ that ends them.
        rows: to fill.
        front: to fill.
        best: to fill.
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
            _solve(chol, rows[k, :, 0], gained)
            change = 0.0
            for i in range(3):
                moved = z_prev[k, i]
                for j in range(3):
                    moved += gain[i, j] * gained[j]
                change = max(change, abs(moved - pixels[i]))
                pixels[i] = moved
        best[k] = pixels
        if front[k]:
            _derive(camera, pixels, seen, depth, rows[k])
            _whiten(chol, rows[k])
        else:
            rows[k] = 0.0


@njit(cache=True, error_model="numpy")
def scores(matrices, z_prev, z_now, white, gate, score, agreeing):
    """Fills score (C,) with Σ min(d², gate) over the matches and agreeing (C,) with how many have d² ≤ gate.

    Args:
        matrices: (C, 4, 4) H.
        z_prev: (K, 3).
        z_now: (K, 3).
        white: (K, 3, 3) W with d² = ‖W (z − g)‖².
        gate: on d².
        score: to fill.
        agreeing: to fill.
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
                    part = white[k, i, 0] * miss[0] + white[k, i, 1] * miss[1] + white[k, i, 2] * miss[2]
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
            for m in range(j):
                entry -= chol[i, m] * chol[j, m]
            chol[i, j] = np.sqrt(entry) if i == j else entry / chol[j, j]


@njit(cache=True, error_model="numpy")
def _solve(chol, b, x):
    # x = (L Lᵀ)⁻¹ b.
    for i in range(3):
        x[i] = b[i]
        for j in range(i):
            x[i] -= chol[i, j] * x[j]
        x[i] /= chol[i, i]
    for i in range(2, -1, -1):
        for j in range(i + 1, 3):
            x[i] -= chol[j, i] * x[j]
        x[i] /= chol[i, i]


@njit(cache=True, error_model="numpy")
def _derive(camera, pixels, seen, depth, row):
    # −∂g/∂ξ into row[:, 1:]: with the slope (a, b, c) of a pixel by the point p, −(slope × [p])  and  ρ · slope.
    fx, fy, cx, cy, shift = camera[0], camera[1], camera[2], camera[3], camera[4]
    x, y = (seen[0] - cx) * depth / fx, (seen[1] - cy) * depth / fy
    nearness = (pixels[0] - pixels[2]) / shift
    for i in range(3):
        a, b = (0.0, fy / depth) if i == 1 else (fx / depth, 0.0)
        c = ((cy if i == 1 else cx) - seen[i]) / depth
        row[i, 1], row[i, 2], row[i, 3] = c * y - b * depth, a * depth - c * x, b * x - a * y
        row[i, 4], row[i, 5], row[i, 6] = nearness * a, nearness * b, nearness * c


@njit(cache=True, error_model="numpy")
def _whiten(chol, row):
    for n in range(row.shape[1]):
        for i in range(3):
            for j in range(i):
                row[i, n] -= chol[i, j] * row[j, n]
            row[i, n] /= chol[i, i]
