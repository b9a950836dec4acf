"""Driver: records of landmarks out of the shared store."""

from numba import njit, types, void

from rbpf.kernels.signature import CUBE, INDEX_MATRIX, INDICES

_HYPERCUBE = types.Array(types.float64, 4, "C")


@njit(void(CUBE, INDICES, INDICES, INDEX_MATRIX, CUBE, _HYPERCUBE, CUBE), cache=True, error_model="numpy")
def gather(pool, slabs, which, maps, mean, cov, const):
    """Fills `mean` (N, K, D), `cov` (N, K, D, D) and `const` (N, K, A); particle i reads row `maps[which[k], i]`."""
    dim, size_const = mean.shape[2], const.shape[2]
    first_const = dim + dim * (dim + 1) // 2
    for k in range(slabs.size):
        slab, rows = pool[slabs[k]], maps[which[k]]
        for i in range(mean.shape[0]):
            row = rows[i]
            field = dim
            for a in range(dim):
                mean[i, k, a] = slab[a, row]
                for b in range(a + 1):
                    cov[i, k, a, b] = cov[i, k, b, a] = slab[field, row]
                    field += 1
            for a in range(size_const):
                const[i, k, a] = slab[first_const + a, row]
