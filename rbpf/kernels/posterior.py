"""Driver: from information about the increment to the refined Gaussian of each particle."""

import math

import numpy as np
from numba import njit, prange, void

from rbpf.kernels.block import add_squares, cholesky, packed, whiten_vector
from rbpf.kernels.signature import BLOCK, CUBE, MATRIX, VECTOR


@njit(cache=True, error_model="numpy")
def _load(info, vector, factor, start, count, info_block, vector_block, factor_block):
    """Particles from `start` on, field by field; a factor that all share is repeated."""
    dim, rank = factor.shape[1], factor.shape[2]
    shared = factor.shape[0] == 1
    for i in range(count):
        for e in range(dim):
            vector_block[e, i] = vector[start + i, e]
            for f in range(e + 1):
                info_block[packed(e, f), i] = info[start + i, e, f]
            for r in range(rank):
                factor_block[e, r, i] = factor[0 if shared else start + i, e, r]


@njit(cache=True, error_model="numpy")
def _whitened_information(info, vector, factor, count, moved, matrix, linear):
    """Moved = ΛL, the lower triangle of matrix = I + LᵀΛL, and linear = Lᵀη."""
    dim, rank = factor.shape[0], factor.shape[1]
    moved[:], linear[:] = 0.0, 0.0
    for r in range(rank):
        for e in range(dim):
            for i in range(count):
                linear[r, i] += factor[e, r, i] * vector[e, i]
            for f in range(dim):
                m = packed(e, f)
                for i in range(count):
                    moved[e, r, i] += info[m, i] * factor[f, r, i]
    for a in range(rank):
        for b in range(a + 1):
            for i in range(count):
                matrix[a, b, i] = 1.0 if a == b else 0.0
            for e in range(dim):
                for i in range(count):
                    matrix[a, b, i] += factor[e, a, i] * moved[e, b, i]


@njit(cache=True, error_model="numpy")
def _invert(factor, count, inverse):
    """Lower triangle of L⁻¹, for a factor made by `cholesky`."""
    for b in range(factor.shape[0]):
        for i in range(count):
            inverse[b, b, i] = factor[b, b, i]
        for a in range(b + 1, factor.shape[0]):
            for i in range(count):
                inverse[a, b, i] = 0.0
            for c in range(b, a):
                for i in range(count):
                    inverse[a, b, i] -= factor[a, c, i] * inverse[c, b, i]
            for i in range(count):
                inverse[a, b, i] *= factor[a, a, i]


@njit(cache=True, error_model="numpy")
def _store(inverse, linear, start, count, mean, root):
    """Mean = L⁻ᵀ linear and root = L⁻ᵀ of the particles from `start` on."""
    rank = linear.shape[0]
    for i in range(count):
        for a in range(rank):
            total = 0.0
            for b in range(a, rank):
                total += inverse[b, a, i] * linear[b, i]
                root[start + i, a, b] = inverse[b, a, i]
            for b in range(a):
                root[start + i, a, b] = 0.0
            mean[start + i, a] = total


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
    dim = factor.shape[1]
    for block in prange((n_particles + BLOCK - 1) // BLOCK):
        start = block * BLOCK
        count = min(BLOCK, n_particles - start)
        info_block = np.empty((dim * (dim + 1) // 2, BLOCK))
        vector_block = np.empty((dim, BLOCK))
        factor_block = np.empty((dim, rank, BLOCK))
        moved = np.empty((dim, rank, BLOCK))
        matrix = np.empty((rank, rank, BLOCK))
        inverse = np.empty((rank, rank, BLOCK))
        linear = np.empty((rank, BLOCK))
        gain = np.zeros(BLOCK)
        scale = np.ones(BLOCK)
        _load(info, vector, factor, start, count, info_block, vector_block, factor_block)
        _whitened_information(info_block, vector_block, factor_block, count, moved, matrix, linear)
        cholesky(matrix, count, scale)
        whiten_vector(matrix, count, linear)
        add_squares(linear, count, gain)
        _invert(matrix, count, inverse)
        _store(inverse, linear, start, count, mean, root)
        for i in range(count):
            nis[start + i] = quad[start + i] - gain[i]
            log_w1[start + i] = -0.5 * (nis[start + i] + log_det[start + i]) + math.log(scale[i])
