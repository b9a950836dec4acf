"""Drivers: landmark observations in many particles. `refine` and `update` make up a filter's step.

Their NumPy twins are in `rbpf.core.linearisation`. A driver calls the model's kernel by its address, so it is compiled
once for all models.
"""

import math

import numpy as np
from numba import int64, njit, types, void

from rbpf.kernels import block as lanes
from rbpf.kernels.block import packed
from rbpf.kernels.gate import accept_predicted, is_inlier, leave_out, log_likelihood
from rbpf.kernels.se3 import back, cross, exp_pair, left_jacobian, multiply, rotation, times, turned
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
    in_parts,
    kernel_at,
    observation_kernel,
)

#: Types of `fused` = (address, params, state), `records` = (pool, slabs, which, maps), and
#: `observed` = (z, noise, mask, kernel_id, kernel_params), see `refine`.
FUSED = int64, VECTOR, MATRIX
RECORDS = CUBE, INDICES, INDICES, INDEX_MATRIX
OBSERVED = MATRIX, CUBE, MASK, int64, VECTOR
#: Types of (address, params, state, mean, columns, clones, origins), see `linearise_group`.
_GROUP = int64, VECTOR, MATRIX, MATRIX, INDEX_MATRIX, INDEX_MATRIX, MATRIX
_PROJECT = void(types.Tuple(FUSED), types.Tuple(RECORDS), int64, VECTOR, CUBE, INDICES, MATRIX, CUBE)


@in_parts(*FUSED, *RECORDS, *OBSERVED, CUBE, INDICES, CUBE, MATRIX, VECTOR, VECTOR, VECTOR)
def refine(block, arguments):
    """Adds Σ HᵀS⁻¹H, Σ HᵀS⁻¹ν, Σ νᵀS⁻¹ν and Σ log|2πS| over the observations, S = J P Jᵀ + R; see docs/mathematics.md.

    Parts are blocks of particles. `rows` (N,) counts the scalar measurements that entered.

    `address` is that of the model's kernel. `state` (N, E) holds the linearisation points; observation k reads slab
    `slabs[k]` of `pool` (slabs, fields, N) at the rows `maps[which[k]]`; `mask` (K, N), or (0, 0) for all, selects the
    particles that observe it; `kernel_id` and `kernel_params` specify the likelihood; `factor` (N or 1, d, r) is the
    prior's, used only for gating; `sizes` = (d, D, A).
    """
    address, params, state = arguments[:3]
    pool, slabs, which, maps = arguments[3:7]
    z, noise, mask, kernel_id, kernel_params = arguments[7:12]
    factor, sizes, info, vector, quad, log_det, rows = arguments[12:]
    n_particles, size = state.shape
    n_obs, p = noise.shape[0], noise.shape[1]
    dim, dim_map, size_const = sizes[0], sizes[1], sizes[2]
    start = block * BLOCK
    count = min(BLOCK, n_particles - start)
    kernel = kernel_at(address)
    x, mean, cov, const, nu, jac_state, jac_map, cross, total = lanes.workspace(size, p, dim, dim_map, size_const)
    weight = np.ones(BLOCK)
    scale = np.ones(BLOCK)
    sum_info = lanes.lines(dim * (dim + 1) // 2).reshape(dim * (dim + 1) // 2, BLOCK)
    sum_vector = lanes.lines(dim).reshape(dim, BLOCK)
    sum_info[:] = sum_vector[:] = 0.0  # sum_info with reversed sign
    sum_quad = np.zeros(BLOCK)
    sum_log = np.zeros(BLOCK)
    penalty = np.zeros(BLOCK)
    used = np.zeros(BLOCK)
    pivots = 0
    lanes.load_states(state, start, count, x)
    for k in range(n_obs):
        lanes.load_record(pool, slabs[k], maps[which[k]], start, count, mean, cov, const)
        if k + 1 < n_obs:
            lanes.expect_record(pool, slabs[k + 1], maps[which[k + 1]], start, count)
        kernel(x, mean, const, z[k], params, count, nu, jac_state, jac_map)
        lanes.innovation_covariance(jac_map, cov, noise[k], count, cross, total)
        if mask.shape[0] > 0 or kernel_id != 0:
            for i in range(count):
                weight[i] = 1.0 if mask.shape[0] == 0 or mask[k, start + i] else 0.0
            accept_predicted(kernel_id, kernel_params, nu, jac_state, total, factor, start, count, weight, penalty)
            leave_out(weight, count, nu, jac_state, total)
        lanes.whiten(total, count, nu, scale, sum_quad)
        lanes.whiten_matrix(total, count, jac_state)
        lanes.subtract_gram(jac_state, count, sum_info)
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
                info[start + i, a, b] -= sum_info[packed(a, b), i]


@njit(cache=True, error_model="numpy")
def _store_record(pool, slab, source, rows, start, count, mean, cov):
    """Writes a record; the fields after mean and covariance are copied from the particle's old record."""
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


@in_parts(*FUSED, *RECORDS, *OBSERVED, INDICES, INDICES, VECTOR)
def update(block, arguments):
    """Adds Σ log p(z | x) to `log_density` (N,) and writes the updated landmarks to the slabs `targets`.

    Given the sampled pose, each landmark is an independent EKF: with S = J P Jᵀ + R = L Lᵀ, A = L⁻¹ J P and
    y = L⁻¹ν the update is m += Aᵀy, P −= AᵀA. Arguments as in `refine`; particle i reads row `maps[...][i]` of the
    slab it inherits and writes row i of the target, so that descendants of one parent never write to the same row.
    """
    address, params, state = arguments[:3]
    pool, slabs, which, maps = arguments[3:7]
    z, noise, mask, kernel_id, kernel_params = arguments[7:12]
    targets, sizes, log_density = arguments[12:]
    n_particles, size = state.shape
    n_obs, p = noise.shape[0], noise.shape[1]
    dim, dim_map, size_const = sizes[0], sizes[1], sizes[2]
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
        if k + 1 < n_obs:
            lanes.expect_record(pool, slabs[k + 1], maps[which[k + 1]], start, count)
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
        lanes.whiten(total, count, nu, scale, squared)
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
        lanes.subtract_gram(cross, count, cov)
        _store_record(pool, targets[k], slabs[k], rows, start, count, mean, cov)
        if kernel_id != 0 and mask.shape[0] == 0:
            weight[:] = 1.0
    for i in range(count):
        if kernel_id == 0:
            sum_log[i] -= 0.5 * (squared[i] + used[i] * p * math.log(2.0 * math.pi))
        log_density[start + i] += sum_log[i]


@observation_kernel
def given_rows(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Passes on precomputed linearised rows: for each observation p times (ν, ∂/∂state, ∂/∂landmark) in `state` (F, BLOCK).

    An observation's `z` is the start of its rows, `params` the number of columns of ∂/∂state; the others are zero.
    """
    row, by_state = int(z[0]), int(params[0])
    for a in range(nu.shape[0]):
        for i in range(n):
            nu[a, i] = state[row, i]
        for e in range(by_state):
            for i in range(n):
                jac_state[a, e, i] = state[row + 1 + e, i]
        row += 1 + by_state
        for e in range(jac_landmark.shape[1]):
            for i in range(n):
                jac_landmark[a, e, i] = state[row + e, i]
        row += jac_landmark.shape[1]


@njit(cache=True, error_model="numpy")
def _add_between(weights, offset, mean, cov):
    """Mean = Σ W o and cov += Σ W (o − mean)(o − mean)ᵀ, for one landmark."""
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
def project(fused, records, mode, weights, factor, sizes, mean, cov):
    """Fills `mean` (K, p) and `cov` (K, p, p) = within + between particles.

    Predictions are relative to that of particle `mode`, so that angles need no wrapping: a particle's difference from that
    prediction is its negative residual. The covariance within is J P Jᵀ + H L (H L)ᵀ, with the state's `factor` L (N or 1,
    d, r). Other arguments as in `refine`.
    """
    address, params, state = fused
    pool, slabs, which, maps = records
    kernel = kernel_at(address)
    n_particles, size = state.shape
    p = mean.shape[1]
    dim, dim_map, size_const = sizes[0], sizes[1], sizes[2]
    x, record, packed_cov, const, nu, jac_state, jac_map, cross, total = lanes.workspace(
        size, p, dim, dim_map, size_const
    )
    column = np.empty((p, BLOCK))
    offset = np.empty((p, n_particles))
    nothing = np.zeros((p, p))
    at, anchor = np.empty((size, BLOCK)), np.empty(p)
    one = int64(1)  # a literal would compile its callees once more
    lanes.load_states(state, mode, one, at)
    for k in range(mean.shape[0]):
        cov[k] = 0.0
        lanes.load_record(pool, slabs[k], maps[which[k]], mode, one, record, packed_cov, const)
        kernel(at, record, const, nothing[0], params, 1, nu, jac_state, jac_map)
        for a in range(p):
            anchor[a] = -nu[a, 0]
        for start in range(0, n_particles, BLOCK):
            count = min(BLOCK, n_particles - start)
            if k == 0 or n_particles > BLOCK:
                lanes.load_states(state, start, count, x)
            lanes.load_record(pool, slabs[k], maps[which[k]], start, count, record, packed_cov, const)
            kernel(x, record, const, anchor, params, count, nu, jac_state, jac_map)
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
        for a in range(p):
            mean[k, a] += anchor[a]


@njit(void(int64, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, int64, MATRIX, CUBE, CUBE), cache=True, error_model="numpy")
def call_kernel(address, state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Runs the kernel at `address` on the lanes 0..n-1 of a block; arguments as in `rbpf.kernels.signature`."""
    kernel = kernel_at(address)
    kernel(state, mean, const, z, params, n, nu, jac_state, jac_landmark)


@njit(cache=True, error_model="numpy")
def _load(mean, columns, clone, origin, start, count, landmark, pose):
    """Fills lanes with a landmark (D, BLOCK) and its anchor: its origin, or a clone K Exp(δ) (7, BLOCK)."""
    for i in range(count):
        own = mean[start + i]
        for j in range(columns.size):
            landmark[j, i] = own[columns[j]]
        for j in range(origin.size):
            pose[j, i] = origin[j]
        if clone.size:
            w = (own[clone[0]], own[clone[1]], own[clone[2]])
            turn, shift = exp_pair(w, (own[clone[3]], own[clone[4]], own[clone[5]]))
            q = (origin[0], origin[1], origin[2], origin[3])
            shift, q = turned(q, shift), multiply(q, turn)
            pose[0, i], pose[1, i], pose[2, i], pose[3, i] = q
            for j in range(3):
                pose[4 + j, i] = origin[4 + j] + shift[j]


@njit(cache=True, error_model="numpy")
def _add_by_clone(own, clone, state, anchor, i, by_state, weight, tangent, jacobian, out):
    """Adds −weight H Ad(y⁻¹ C) J_r(δ) of lane i to out (p, 6): the Jacobian with respect to δ of the clone C = K Exp(δ)."""
    for j in range(6):
        tangent[0, j] = -own[clone[j]]
    left_jacobian(tangent, jacobian)
    r = rotation(state[0, i], state[1, i], state[2, i], state[3, i])
    s = rotation(anchor[0, i], anchor[1, i], anchor[2, i], anchor[3, i])
    apart = (anchor[4, i] - state[4, i], anchor[5, i] - state[5, i], anchor[6, i] - state[6, i])
    for a in range(len(by_state)):
        # In the world's axes Ad(y⁻¹ C) takes (a, v) to (a + v × t, v).
        v = times(r, by_state[a, 3, i], by_state[a, 4, i], by_state[a, 5, i])
        w = times(r, by_state[a, 0, i], by_state[a, 1, i], by_state[a, 2, i])
        moment = cross(v, apart)
        w = back(s, w[0] + moment[0], w[1] + moment[1], w[2] + moment[2])
        v = back(s, v[0], v[1], v[2])
        for j in range(6):
            total = 0.0
            for k in range(3):
                total += w[k] * jacobian[0, k, j] + v[k] * jacobian[0, 3 + k, j]
            out[a, j] -= weight * total


@njit(void(*_GROUP, MATRIX, int64, CUBE, MATRIX), cache=True, error_model="numpy")
def linearise_group(address, params, state, mean, columns, clones, origins, z, first, said, slope):
    """Fills ν and ∂z/∂state in `said` (R, 1 + d, N), and mean slopes over the particles (R, q), from row `first` on.

    For K landmarks with measurements z (K, p), in particles with states (N, E) and means (N, n): `columns` (K, D) of the
    landmarks; `clones` (K, 6), the columns of the clones that anchor them, or (K, 0) without; `origins` (K, A), their
    constants, or the K of the clones. The slopes are ∂z/∂landmark, then ∂z/∂clone.
    """
    kernel = kernel_at(address)
    size, particles = said.shape[1:]
    count, dim = columns.shape
    p = z.shape[1]
    anchored = clones.shape[1] > 0
    x = np.empty((state.shape[1], BLOCK))
    landmark = np.empty((dim, BLOCK))
    anchor = np.empty((origins.shape[1], BLOCK))
    nu = np.empty((p, BLOCK))
    by_state = np.zeros((p, size - 1, BLOCK))
    by_landmark = np.empty((p, dim, BLOCK))
    tangent = np.empty((1, 6))
    jacobian = np.empty((1, 6, 6))
    for start in range(0, particles, BLOCK):
        n = min(BLOCK, particles - start)
        lanes.load_states(state, start, n, x)
        for k in range(count):
            _load(mean, columns[k], clones[k], origins[k], start, n, landmark, anchor)
            kernel(x, landmark, anchor, z[k], params, n, nu, by_state, by_landmark)
            for a in range(p):
                row = first + k * p + a
                for i in range(n):
                    said[row, 0, start + i] = nu[a, i]
                for e in range(size - 1):
                    for i in range(n):
                        said[row, 1 + e, start + i] = by_state[a, e, i]
                for j in range(dim):
                    total = 0.0
                    for i in range(n):
                        total += by_landmark[a, j, i]
                    slope[row, j] += total / particles
            if anchored:
                out = slope[first + k * p : first + (k + 1) * p, dim : dim + 6]
                for i in range(n):
                    _add_by_clone(
                        mean[start + i], clones[k], x, anchor, i, by_state, 1.0 / particles, tangent, jacobian, out
                    )


@njit(void(*_GROUP, MATRIX, CUBE, CUBE, HYPERCUBE), cache=True, error_model="numpy")
def expect_group(address, params, state, mean, columns, clones, origins, cov, root, predicted, within):
    """Fills each particle's predicted measurements (N, K, p), and J P Jᵀ + H L Lᵀ Hᵀ, `within` (N, K, p, p).

    Arguments as of `linearise_group`, and the map's covariance (n, n) and the factor L (N or 1, d, r) of the predicted states.
    """
    kernel = kernel_at(address)
    particles, count, p = predicted.shape
    dim = columns.shape[1]
    size, rank = root.shape[1:]
    x = np.empty((state.shape[1], BLOCK))
    landmark = np.empty((dim, BLOCK))
    anchor = np.empty((origins.shape[1], BLOCK))
    nu = np.empty((p, BLOCK))
    by_state = np.zeros((p, size, BLOCK))
    by_landmark = np.empty((p, dim, BLOCK))
    zero = np.zeros(p)
    carried = np.empty((p, dim, BLOCK))
    moved = np.empty((p, rank, BLOCK))
    total = np.empty(BLOCK)
    for start in range(0, particles, BLOCK):
        n = min(BLOCK, particles - start)
        lanes.load_states(state, start, n, x)
        for k in range(count):
            _load(mean, columns[k], clones[k], origins[k], start, n, landmark, anchor)
            kernel(x, landmark, anchor, zero, params, n, nu, by_state, by_landmark)
            moved[:, :, :n] = 0.0
            for a in range(p):
                for i in range(n):
                    predicted[start + i, k, a] = -nu[a, i]
                for j in range(dim):
                    for i in range(n):
                        carried[a, j, i] = 0.0
                    for b in range(dim):
                        shared = cov[columns[k, b], columns[k, j]]
                        for i in range(n):
                            carried[a, j, i] += by_landmark[a, b, i] * shared
                for r in range(rank):
                    for e in range(size):
                        if len(root) > 1:
                            for i in range(n):
                                moved[a, r, i] += by_state[a, e, i] * root[start + i, e, r]
                        else:
                            shared = root[0, e, r]
                            for i in range(n):
                                moved[a, r, i] += by_state[a, e, i] * shared
                for b in range(a + 1):
                    total[:n] = 0.0
                    for j in range(dim):
                        for i in range(n):
                            total[i] += carried[a, j, i] * by_landmark[b, j, i]
                    for r in range(rank):
                        for i in range(n):
                            total[i] += moved[a, r, i] * moved[b, r, i]
                    for i in range(n):
                        within[start + i, k, a, b] = within[start + i, k, b, a] = total[i]
