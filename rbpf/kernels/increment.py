"""Drivers: the Gaussians of each particle's increment, refined by observations or jointly with a substate; sound noise."""

import math

import numpy as np
from numba import boolean, njit, prange, void

from rbpf.kernels import dense
from rbpf.kernels.block import add_squares, cholesky, packed, whiten_vector
from rbpf.kernels.signature import BLOCK, CUBE, MATRIX, READ_ONLY, READ_ONLY_CUBE, VECTOR

_SINGULAR = 1e-12  #: The same as `rbpf.gaussian.psd_factor`'s: a pivot below this fraction of its variance is none.
_POSTERIOR = void(CUBE, MATRIX, VECTOR, VECTOR, CUBE, MATRIX, CUBE, VECTOR, VECTOR)


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


@njit(_POSTERIOR, parallel=True, cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _joint(stack, cov, noise, half, joint):
    """S P Sᵀ + L Lᵀ, exactly symmetric."""
    rows, m = stack.shape
    for a in range(rows):
        for c in range(m):
            total = 0.0
            for b in range(m):
                total += stack[a, b] * cov[b, c]
            half[a, c] = total
    for a in range(rows):
        for b in range(a + 1):
            total = 0.0
            for c in range(m):
                total += half[a, c] * stack[b, c]
            for r in range(noise.shape[1]):
                total += noise[a, r] * noise[b, r]
            joint[a, b] = joint[b, a] = total


@njit(cache=True, error_model="numpy")
def _condition(joint, gain, half, rest):
    """Rest = [−G I] J [−G I]ᵀ, which rounding cannot make indefinite."""
    m, d = gain.shape
    for c in range(d + m):
        for a in range(m):
            total = joint[d + a, c]
            for k in range(d):
                total -= gain[a, k] * joint[k, c]
            half[c, a] = total
    for a in range(m):
        for b in range(a + 1):
            total = half[d + b, a]
            for k in range(d):
                total -= half[k, a] * gain[b, k]
            rest[a, b] = rest[b, a] = total


@njit(boolean(CUBE, CUBE, CUBE, CUBE, CUBE, CUBE, CUBE), cache=True, error_model="numpy")
def conditioned(stack, cov, noise, joint, factor, gain, rest):
    """Fills the distribution of s given ε, for cov(ε, s) = S P Sᵀ + L Lᵀ.

    Fills, for each of J distributions, `joint` (J, d+m, d+m), the lower `factor` (J, d, d) of cov(ε), `gain` (J, m, d) =
    cov(s, ε) cov(ε)⁻¹ and `rest` (J, m, m) = cov(s | ε), from `stack` S (J or 1, d+m, m), `cov` P (J or 1, m, m) and
    `noise` L (J or 1, d+m, r). Returns whether every cov(ε) is definite; what depends on it is void where one is not.
    """
    m, d = gain.shape[1:]
    half, definite = np.empty(stack.shape[1:]), True
    for j in range(joint.shape[0]):
        of_stack, of_cov, of_noise = (min(j, stack.shape[0] - 1), min(j, cov.shape[0] - 1), min(j, noise.shape[0] - 1))
        _joint(stack[of_stack], cov[of_cov], noise[of_noise], half, joint[j])
        for a in range(d):
            for b in range(d):
                factor[j, a, b] = joint[j, a, b] if b <= a else 0.0
        definite = dense.factor(factor[j], _SINGULAR) and definite
        if definite:
            for a in range(m):
                gain[j, a] = joint[j, d + a, :d]
                dense.solve(factor[j], gain[j, a])
            _condition(joint[j], gain[j], half, rest[j])
    return definite


@njit(boolean(READ_ONLY, READ_ONLY_CUBE), cache=True, error_model="numpy")
def are_sound(z, cov):
    """Whether z (K, p) is finite and every cov (K, p, p) finite, symmetric to the bit and positive definite."""
    chol = np.empty(cov.shape[1:])
    for k in range(z.shape[0]):
        for a in range(z.shape[1]):
            if not math.isfinite(z[k, a]):
                return False
            for b in range(a + 1):
                if cov[k, a, b] != cov[k, b, a] or not math.isfinite(cov[k, a, b]):
                    return False
        chol[:] = cov[k]
        if not dense.factor(chol):
            return False
    return True
