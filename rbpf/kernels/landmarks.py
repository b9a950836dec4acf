"""Drivers: observations of landmarks in many particles. `refine` and `update` make a filter's step.

Their NumPy twins are in `rbpf.core.linearisation`. A driver calls the model's kernel by its address, so that it is
compiled once for all models.
"""

import math

import numpy as np
from numba import int64, njit, prange, void

from rbpf.kernels import block as lanes
from rbpf.kernels.block import packed
from rbpf.kernels.gate import accept_predicted, is_inlier, leave_out, log_likelihood
from rbpf.kernels.signature import (
    BLOCK,
    CUBE,
    FACTORS_PER_LOG,
    HYPERCUBE,
    INDEX_MATRIX,
    INDICES,
    MASK,
    MATRIX,
    VECTOR,
    kernel_at,
)

#: Types of (pool, slabs, which, maps) and of (z, noise, mask, kernel_id, kernel_params), see `refine`.
RECORDS = CUBE, INDICES, INDICES, INDEX_MATRIX
OBSERVED = MATRIX, CUBE, MASK, int64, VECTOR
_REFINE = void(int64, VECTOR, MATRIX, *RECORDS, *OBSERVED, CUBE, INDICES, CUBE, MATRIX, VECTOR, VECTOR, VECTOR)
_UPDATE = void(int64, VECTOR, MATRIX, *RECORDS, INDICES, *OBSERVED, INDICES, VECTOR)
_PROJECT = void(int64, VECTOR, MATRIX, *RECORDS, MATRIX, VECTOR, CUBE, INDICES, MATRIX, CUBE)


@njit(_REFINE, parallel=True, cache=True, error_model="numpy")
def refine(
    address, params, state, pool, slabs, which, maps, z, noise, mask, kernel_id, kernel_params, factor, sizes,
    info, vector, quad, log_det, rows,
):  # fmt: skip
    """Adds Σ HᵀS⁻¹H, Σ HᵀS⁻¹ν, Σ νᵀS⁻¹ν and Σ log|2πS| over the observations, S = J P Jᵀ + R; see docs/mathematics.md.

    `rows` (N,) counts the scalar measurements that entered these sums.

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
        x, mean, cov, const, nu, jac_state, jac_map, cross, total = lanes.workspace(size, p, dim, dim_map, size_const)
        weight = np.ones(BLOCK)
        scale = np.ones(BLOCK)
        sum_info = np.zeros((dim * (dim + 1) // 2, BLOCK))
        sum_vector = np.zeros((dim, BLOCK))
        sum_quad = np.zeros(BLOCK)
        sum_log = np.zeros(BLOCK)
        penalty = np.zeros(BLOCK)
        used = np.zeros(BLOCK)
        pivots = 0
        lanes.load_states(state, start, count, x)
        for k in range(n_obs):
            lanes.load_record(pool, slabs[k], maps[which[k]], start, count, mean, cov, const)
            kernel(x, mean, const, z[k], params, count, nu, jac_state, jac_map)
            lanes.innovation_covariance(jac_map, cov, noise[k], count, cross, total)
            partial = mask.shape[0] > 0 or kernel_id != 0
            if partial:
                for i in range(count):
                    weight[i] = 1.0 if mask.shape[0] == 0 or mask[k, start + i] else 0.0
                accept_predicted(kernel_id, kernel_params, nu, jac_state, total, factor, start, count, weight, penalty)
                leave_out(weight, count, nu, jac_state, total)
            lanes.cholesky(total, count, scale)
            lanes.whiten_vector(total, count, nu)
            lanes.whiten_matrix(total, count, jac_state)
            lanes.add_squares(nu, count, sum_quad)
            lanes.add_gram(jac_state, 1.0, count, sum_info)
            lanes.add_transposed_product(jac_state, nu, count, sum_vector)
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
            rows[start + i] += used[i] * p
            log_det[start + i] += penalty[i]
            if kernel_id == 0 or kernel_id == 2:
                log_det[start + i] += sum_log[i] + used[i] * p * math.log(2.0 * math.pi)
            for a in range(dim):
                vector[start + i, a] += sum_vector[a, i]
                for b in range(dim):
                    info[start + i, a, b] += sum_info[packed(a, b), i]


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


@njit(_UPDATE, parallel=True, cache=True, error_model="numpy")
def update(
    address, params, state, pool, slabs, which, maps, targets, z, noise, mask, kernel_id, kernel_params, sizes,
    log_density,
):  # fmt: skip
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
        x, mean, cov, const, nu, jac_state, jac_map, cross, total = lanes.workspace(size, p, dim, dim_map, size_const)
        weight = np.ones(BLOCK)
        scale = np.ones(BLOCK)
        squared = np.zeros(BLOCK)
        used = np.zeros(BLOCK)
        pivots = 0
        sum_log = np.zeros(BLOCK)
        lanes.load_states(state, start, count, x)
        for k in range(n_obs):
            rows = maps[which[k]]
            lanes.load_record(pool, slabs[k], rows, start, count, mean, cov, const)
            kernel(x, mean, const, z[k], params, count, nu, jac_state, jac_map)
            lanes.innovation_covariance(jac_map, cov, noise[k], count, cross, total)
            if mask.shape[0] > 0:
                for i in range(count):
                    weight[i] = 1.0 if mask[k, start + i] else 0.0
                leave_out(weight, count, nu, cross, total)
            if kernel_id != 0:
                for i in range(count):
                    squared[i] = 0.0
                    scale[i] = 1.0
            lanes.cholesky(total, count, scale)
            lanes.whiten_vector(total, count, nu)
            lanes.add_squares(nu, count, squared)
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
                        weight[i] = 1.0 if is_inlier(kernel_id, kernel_params, squared[i], scale[i], p) else 0.0
                        rejected = rejected or weight[i] == 0.0
            lanes.whiten_matrix(total, count, cross)
            if rejected:
                leave_out(weight, count, nu, cross, total)
            lanes.add_transposed_product(cross, nu, count, mean)
            lanes.add_gram(cross, -1.0, count, cov)
            _store_record(pool, targets[k], slabs[k], rows, start, count, mean, cov)
            if kernel_id != 0 and mask.shape[0] == 0:
                weight[:] = 1.0
        for i in range(count):
            if kernel_id == 0:
                sum_log[i] -= 0.5 * (squared[i] + used[i] * p * math.log(2.0 * math.pi))
            log_density[start + i] += sum_log[i]


@njit(cache=True, error_model="numpy")
def _add_between(weights, offset, mean, cov):
    """Mean = Σ W o and cov += Σ W (o − mean)(o − mean)ᵀ, of one landmark."""
    p, n = offset.shape
    for a in range(p):
        total = 0.0
        for i in range(n):
            total += weights[i] * offset[a, i]
        mean[a] = total
    for a in range(p):
        for b in range(a + 1):
            total = cov[a, b]
            for i in range(n):
                total += weights[i] * ((offset[a, i] - mean[a]) * (offset[b, i] - mean[b]))
            cov[a, b] = cov[b, a] = total


@njit(_PROJECT, cache=True, error_model="numpy")
def project(address, params, state, pool, slabs, which, maps, anchor, weights, factor, sizes, mean, cov):
    """Fills `mean` (K, p), relative to `anchor` (K, p), and `cov` (K, p, p) = within + between particles.

    The kernel's residual of `anchor`, with the sign reversed, is where a particle expects the landmark. Within is
    J P Jᵀ + H L (H L)ᵀ, with the `factor` L (N or 1, d, r) of the state. Other arguments as in `refine`.
    """
    kernel = kernel_at(address)
    n_particles, size = state.shape
    p = anchor.shape[1]
    dim, dim_map, size_const = sizes[0], sizes[1], sizes[2]
    x, record, packed_cov, const, nu, jac_state, jac_map, cross, total = lanes.workspace(
        size, p, dim, dim_map, size_const
    )
    column = np.empty((p, BLOCK))
    offset = np.empty((p, n_particles))
    nothing = np.zeros((p, p))
    for k in range(anchor.shape[0]):
        cov[k] = 0.0
        for start in range(0, n_particles, BLOCK):
            count = min(BLOCK, n_particles - start)
            if k == 0 or n_particles > BLOCK:
                lanes.load_states(state, start, count, x)
            lanes.load_record(pool, slabs[k], maps[which[k]], start, count, record, packed_cov, const)
            kernel(x, record, const, anchor[k], params, count, nu, jac_state, jac_map)
            lanes.innovation_covariance(jac_map, packed_cov, nothing, count, cross, total)
            lanes.add_spread(jac_state, factor, start, count, column, total)
            for a in range(p):
                for i in range(count):
                    offset[a, start + i] = -nu[a, i]
                for b in range(a + 1):
                    within = 0.0
                    for i in range(count):
                        within += weights[start + i] * total[a, b, i]
                    cov[k, a, b] += within
        _add_between(weights, offset, mean[k], cov[k])


@njit(void(int64, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, int64, MATRIX, CUBE, CUBE), cache=True, error_model="numpy")
def call_kernel(address, state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Runs the kernel at `address` on the lanes 0..n-1 of a block; arguments as in `rbpf.kernels.signature`."""
    kernel = kernel_at(address)
    kernel(state, mean, const, z, params, n, nu, jac_state, jac_landmark)


@njit(void(int64, VECTOR, MATRIX, CUBE, CUBE, MATRIX, CUBE, HYPERCUBE, HYPERCUBE), cache=True, error_model="numpy")
def linearise_all(address, params, state, mean, const, z, nu, jac_state, jac_landmark):
    """Fills `nu` (N, K, p), `jac_state` (N, K, p, d) and `jac_landmark` (N, K, p, D) of K landmarks in N particles.

    The states are (N, E), the landmarks `mean` (N, K, D) and `const` (N, K, A), measured as `z` (K, p).
    """
    kernel = kernel_at(address)
    particles, count, p = nu.shape
    x = np.empty((state.shape[1], BLOCK))
    lane_mean, lane_const = np.empty((mean.shape[2], BLOCK)), np.empty((const.shape[2], BLOCK))
    lane_nu = np.empty((p, BLOCK))
    by_state = np.zeros((p, jac_state.shape[3], BLOCK))
    by_landmark = np.empty((p, jac_landmark.shape[3], BLOCK))
    for first in range(0, particles, BLOCK):
        n = min(BLOCK, particles - first)
        for i in range(n):
            x[:, i] = state[first + i]
        for k in range(count):
            for i in range(n):
                lane_mean[:, i], lane_const[:, i] = mean[first + i, k], const[first + i, k]
            kernel(x, lane_mean, lane_const, z[k], params, n, lane_nu, by_state, by_landmark)
            for i in range(n):
                nu[first + i, k] = lane_nu[:, i]
                jac_state[first + i, k] = by_state[:, :, i]
                jac_landmark[first + i, k] = by_landmark[:, :, i]
