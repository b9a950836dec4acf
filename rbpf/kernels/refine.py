"""Driver: the information that observations of landmarks carry about each particle's increment."""

import math

import numpy as np
from numba import int64, njit, prange, void

from rbpf.kernels.block import (
    add_gram,
    add_squares,
    add_transposed_product,
    cholesky,
    load_record,
    load_states,
    packed,
    whiten_matrix,
    whiten_vector,
    workspace,
)
from rbpf.kernels.gate import accept_predicted, leave_out
from rbpf.kernels.innovation import innovation_covariance
from rbpf.kernels.signature import (
    BLOCK,
    CUBE,
    FACTORS_PER_LOG,
    INDEX_MATRIX,
    INDICES,
    MASK,
    MATRIX,
    VECTOR,
    kernel_at,
)


@njit(
    void(
        int64,
        VECTOR,
        MATRIX,
        CUBE,
        INDICES,
        INDICES,
        INDEX_MATRIX,
        MATRIX,
        CUBE,
        MASK,
        int64,
        VECTOR,
        CUBE,
        INDICES,
        CUBE,
        MATRIX,
        VECTOR,
        VECTOR,
    ),
    parallel=True,
    cache=True,
    error_model="numpy",
)
def refine(
    address,
    params,
    state,
    pool,
    slabs,
    which,
    maps,
    z,
    noise,
    mask,
    kernel_id,
    kernel_params,
    factor,
    sizes,
    info,
    vector,
    quad,
    log_det,
):
    """Adds Σ HᵀS⁻¹H, Σ HᵀS⁻¹ν, Σ νᵀS⁻¹ν and Σ log|2πS| over the observations, S = J P Jᵀ + R; see docs/mathematics.md.

    `address` is that of the model's kernel. `state` (N, E) holds the linearisation points; observation k reads slab
    `slabs[k]` of `pool` (slabs, fields, N) at the rows `maps[which[k]]`; `mask` (K, N) or (0, 0) says which particles
    saw it; `kernel_id` and `kernel_params` name the likelihood, `factor` (N or 1, d, r) is the prior's, used for gating only;
    `sizes` = (d, D, A).
    """
    n_particles, size = state.shape
    n_obs, p = noise.shape[0], noise.shape[1]
    dim, dim_map, size_const = sizes[0], sizes[1], sizes[2]
    for block in prange((n_particles + BLOCK - 1) // BLOCK):
        start = block * BLOCK
        count = min(BLOCK, n_particles - start)
        kernel = kernel_at(address)
        x, mean, cov, const, nu, jac_state, jac_map, cross, total = workspace(
            size, p, dim, dim_map, size_const
        )
        weight = np.ones(BLOCK)
        scale = np.ones(BLOCK)
        sum_info = np.zeros((dim * (dim + 1) // 2, BLOCK))
        sum_vector = np.zeros((dim, BLOCK))
        sum_quad = np.zeros(BLOCK)
        sum_log = np.zeros(BLOCK)
        penalty = np.zeros(BLOCK)
        used = np.zeros(BLOCK)
        pivots = 0
        load_states(state, start, count, x)
        for k in range(n_obs):
            load_record(pool, slabs[k], maps[which[k]], start, count, mean, cov, const)
            kernel(x, mean, const, z[k], params, count, nu, jac_state, jac_map)
            innovation_covariance(jac_map, cov, noise[k], count, cross, total)
            partial = mask.shape[0] > 0 or kernel_id != 0
            if partial:
                for i in range(count):
                    weight[i] = 1.0 if mask.shape[0] == 0 or mask[k, start + i] else 0.0
                accept_predicted(
                    kernel_id, kernel_params, nu, jac_state, total, factor, start, count, weight, penalty
                )
                leave_out(weight, count, nu, jac_state, total)
            cholesky(total, count, scale)
            whiten_vector(total, count, nu)
            whiten_matrix(total, count, jac_state)
            add_squares(nu, count, sum_quad)
            add_gram(jac_state, 1.0, count, sum_info)
            add_transposed_product(jac_state, nu, count, sum_vector)
            pivots += p
            for i in range(count):
                used[i] += weight[i]
            if pivots + p > FACTORS_PER_LOG or k == n_obs - 1:
                for i in range(count):
                    sum_log[i] -= 2.0 * math.log(scale[i])
                    scale[i] = 1.0
                pivots = 0
        for i in range(count):
            quad[start + i] += sum_quad[i]
            log_det[start + i] += penalty[i]
            if kernel_id != 1:
                log_det[start + i] += sum_log[i] + used[i] * p * math.log(2.0 * math.pi)
            for a in range(dim):
                vector[start + i, a] += sum_vector[a, i]
                for b in range(dim):
                    info[start + i, a, b] += sum_info[packed(a, b), i]
