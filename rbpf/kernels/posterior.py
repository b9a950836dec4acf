"""Driver: from information about the increment to the refined Gaussian of each particle."""

import math

import numpy as np
from numba import njit, prange, void

from rbpf.kernels.signature import BLOCK, CUBE, MATRIX, VECTOR


@njit(cache=True, error_model="numpy")
def _whitened_information(info, vector, factor, matrix, linear):
    """Matrix = I + LᵀΛL and linear = Lᵀη for one particle."""
    dim, rank = factor.shape
    for a in range(rank):
        linear[a] = 0.0
        for e in range(dim):
            linear[a] += factor[e, a] * vector[e]
        for b in range(a + 1):
            total = 1.0 if a == b else 0.0
            for e in range(dim):
                row = 0.0
                for f in range(dim):
                    row += info[e, f] * factor[f, b]
                total += factor[e, a] * row
            matrix[a, b] = total


@njit(cache=True, error_model="numpy")
def _cholesky_in_place(matrix):
    """Lower Cholesky factor in place; returns log|matrix|."""
    log_det = 0.0
    for a in range(matrix.shape[0]):
        for b in range(a + 1):
            total = matrix[a, b]
            for c in range(b):
                total -= matrix[a, c] * matrix[b, c]
            if a == b:
                matrix[a, a] = math.sqrt(total)
                log_det += 2.0 * math.log(matrix[a, a])
            else:
                matrix[a, b] = total / matrix[b, b]
    return log_det


@njit(cache=True, error_model="numpy")
def _inverse_transposed(factor, root):
    """Root = L⁻ᵀ, upper triangular."""
    rank = factor.shape[0]
    for a in range(rank):
        for b in range(rank):
            root[a, b] = 0.0
    for b in range(rank):
        root[b, b] = 1.0 / factor[b, b]
        for a in range(b + 1, rank):
            total = 0.0
            for c in range(b, a):
                total -= factor[a, c] * root[b, c]
            root[b, a] = total / factor[a, a]


@njit(cache=True, error_model="numpy")
def _refine_one(info, vector, factor, matrix, linear, mean, root):
    """Mean and root of one particle; returns (Lᵀη)ᵀM⁻¹(Lᵀη) and log|M|."""
    rank = mean.size
    _whitened_information(info, vector, factor, matrix, linear)
    log_m = _cholesky_in_place(matrix)
    _inverse_transposed(matrix, root)
    gain = 0.0
    for a in range(rank):
        for b in range(a):
            linear[a] -= matrix[a, b] * linear[b]
        linear[a] /= matrix[a, a]
        gain += linear[a] * linear[a]
    for a in range(rank):
        mean[a] = 0.0
        for b in range(a, rank):
            mean[a] += root[a, b] * linear[b]
    return gain, log_m


@njit(
    void(CUBE, MATRIX, VECTOR, VECTOR, CUBE, MATRIX, CUBE, VECTOR, VECTOR),
    parallel=True,
    cache=True,
    error_model="numpy",
)
def posterior(info, vector, quad, log_det, factor, mean, root, log_w1, nis):
    """Whitened refined Gaussian: u ~ N(M⁻¹Lᵀη, M⁻¹), M = I + LᵀΛL, and the joint marginal log w₁.

    Fills `mean` (N, r), `root` (N, r, r) with root rootᵀ = M⁻¹ (the transposed inverse Cholesky factor of M, upper
    triangular), `log_w1` (N,) and `nis` (N,), the innovation's squared Mahalanobis distance.
    """
    n_particles, rank = mean.shape
    stride = 0 if factor.shape[0] == 1 else 1
    for block in prange((n_particles + BLOCK - 1) // BLOCK):
        matrix = np.empty((rank, rank))
        linear = np.empty(rank)
        for i in range(block * BLOCK, min((block + 1) * BLOCK, n_particles)):
            gain, log_m = _refine_one(
                info[i], vector[i], factor[i * stride], matrix, linear, mean[i], root[i]
            )
            nis[i] = quad[i] - gain
            log_w1[i] = -0.5 * (nis[i] + log_det[i] + log_m)
