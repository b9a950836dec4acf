"""Driver: where landmarks will be measured, under all particles (E06 §4.1)."""

import numpy as np
from numba import int64, njit, void

from rbpf.kernels.block import load_record, load_states, workspace
from rbpf.kernels.innovation import innovation_covariance
from rbpf.kernels.signature import BLOCK, CUBE, INDEX_MATRIX, INDICES, MATRIX, VECTOR, kernel_at


@njit(cache=True, error_model="numpy")
def _add_spread(jac, factor, start, count, column, total):
    """Total += H L (H L)ᵀ, its lower triangle."""
    p, dim = jac.shape[0], factor.shape[1]
    shared = factor.shape[0] == 1
    for r in range(factor.shape[2]):
        for a in range(p):
            for i in range(count):
                column[a, i] = 0.0
            for e in range(dim):
                if shared:
                    weight = factor[0, e, r]
                    for i in range(count):
                        column[a, i] += jac[a, e, i] * weight
                else:
                    for i in range(count):
                        column[a, i] += jac[a, e, i] * factor[start + i, e, r]
        for a in range(p):
            for b in range(a + 1):
                for i in range(count):
                    total[a, b, i] += column[a, i] * column[b, i]


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
        VECTOR,
        CUBE,
        INDICES,
        MATRIX,
        CUBE,
    ),
    cache=True,
    error_model="numpy",
)
def project(address, params, state, pool, slabs, which, maps, anchor, weights, factor, sizes, mean, cov):
    """Fills `mean` (K, p), relative to `anchor` (K, p), and `cov` (K, p, p) = within + between particles.

    The kernel's residual of `anchor`, with the sign reversed, is where a particle expects the landmark. Within is
    J P Jᵀ + H L (H L)ᵀ, with the `factor` L (N or 1, d, r) of the state. Other arguments as in `refine`.
    """
    kernel = kernel_at(address)
    n_particles, size = state.shape
    p = anchor.shape[1]
    dim, dim_map, size_const = sizes[0], sizes[1], sizes[2]
    x, record, packed_cov, const, nu, jac_state, jac_map, cross, total = workspace(
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
                load_states(state, start, count, x)
            load_record(pool, slabs[k], maps[which[k]], start, count, record, packed_cov, const)
            kernel(x, record, const, anchor[k], params, count, nu, jac_state, jac_map)
            innovation_covariance(jac_map, packed_cov, nothing, count, cross, total)
            _add_spread(jac_state, factor, start, count, column, total)
            for a in range(p):
                for i in range(count):
                    offset[a, start + i] = -nu[a, i]
                for b in range(a + 1):
                    within = 0.0
                    for i in range(count):
                        within += weights[start + i] * total[a, b, i]
                    cov[k, a, b] += within
        _add_between(weights, offset, mean[k], cov[k])
