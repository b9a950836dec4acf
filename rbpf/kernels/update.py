"""Driver: likelihood of the observations at the sampled states, and the landmarks' Kalman updates."""

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
    whiten_matrix,
    whiten_vector,
    workspace,
)
from rbpf.kernels.gate import is_inlier, leave_out, log_likelihood
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


@njit(cache=True, error_model="numpy")
def _store_record(pool, slab, source, rows, start, count, mean, cov):
    """Writes a record; the fields behind mean and covariance follow their particle."""
    dim, size_cov = mean.shape[0], cov.shape[0]
    for f in range(dim):
        for i in range(count):
            pool[slab, f, start + i] = mean[f, i]
    for f in range(size_cov):
        for i in range(count):
            pool[slab, dim + f, start + i] = cov[f, i]
    if slab != source:
        for f in range(dim + size_cov, pool.shape[1]):
            for i in range(count):
                pool[slab, f, start + i] = pool[source, f, rows[start + i]]


@njit(
    void(
        int64,
        VECTOR,
        MATRIX,
        CUBE,
        INDICES,
        INDICES,
        INDEX_MATRIX,
        INDICES,
        MATRIX,
        CUBE,
        MASK,
        int64,
        VECTOR,
        INDICES,
        VECTOR,
    ),
    parallel=True,
    cache=True,
    error_model="numpy",
)
def update(
    address,
    params,
    state,
    pool,
    slabs,
    which,
    maps,
    targets,
    z,
    noise,
    mask,
    kernel_id,
    kernel_params,
    sizes,
    log_density,
):
    """Adds Σ log p(z | x) to `log_density` (N,) and writes the updated landmarks to the slabs `targets`.

    Given the sampled pose, each landmark is an independent EKF: with S = J P Jᵀ + R = L Lᵀ, A = L⁻¹ J P and
    y = L⁻¹ν the update is m += Aᵀy, P −= AᵀA. Arguments as in `refine`; particle i reads row `maps[...][i]` of the
    slab it inherits and writes row i of the target, so that descendants of one parent never share what they write.
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
        squared = np.zeros(BLOCK)
        used = np.zeros(BLOCK)
        pivots = 0
        sum_log = np.zeros(BLOCK)
        load_states(state, start, count, x)
        for k in range(n_obs):
            rows = maps[which[k]]
            load_record(pool, slabs[k], rows, start, count, mean, cov, const)
            kernel(x, mean, const, z[k], params, count, nu, jac_state, jac_map)
            innovation_covariance(jac_map, cov, noise[k], count, cross, total)
            if mask.shape[0] > 0:
                for i in range(count):
                    weight[i] = 1.0 if mask[k, start + i] else 0.0
                leave_out(weight, count, nu, cross, total)
            if kernel_id != 0:
                for i in range(count):
                    squared[i] = 0.0
                    scale[i] = 1.0
            cholesky(total, count, scale)
            whiten_vector(total, count, nu)
            add_squares(nu, count, squared)
            rejected = False
            if kernel_id == 0:
                pivots += p
                for i in range(count):
                    used[i] += weight[i]
                if pivots + p > FACTORS_PER_LOG or k == n_obs - 1:
                    for i in range(count):
                        sum_log[i] += math.log(scale[i])
                        scale[i] = 1.0
                    pivots = 0
            else:
                for i in range(count):
                    if weight[i] != 0.0:
                        sum_log[i] += log_likelihood(kernel_id, kernel_params, squared[i], scale[i], p)
                        weight[i] = (
                            1.0 if is_inlier(kernel_id, kernel_params, squared[i], scale[i], p) else 0.0
                        )
                        rejected = rejected or weight[i] == 0.0
            whiten_matrix(total, count, cross)
            if rejected:
                leave_out(weight, count, nu, cross, total)
            add_transposed_product(cross, nu, count, mean)
            add_gram(cross, -1.0, count, cov)
            _store_record(pool, targets[k], slabs[k], rows, start, count, mean, cov)
            if kernel_id != 0 and mask.shape[0] == 0:
                weight[:] = 1.0
        for i in range(count):
            if kernel_id == 0:
                sum_log[i] -= 0.5 * (squared[i] + used[i] * p * math.log(2.0 * math.pi))
            log_density[start + i] += sum_log[i]
