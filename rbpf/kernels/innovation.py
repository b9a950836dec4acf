"""Covariances of innovations on a block of particles, laid out as in `rbpf.kernels.block`."""

from numba import njit

from rbpf.kernels.block import flat, packed
from rbpf.kernels.signature import BLOCK


@njit(cache=True, error_model="numpy")
def innovation_covariance(jac, cov, noise, count, cross, total):
    """Cross = J P and the lower triangle of total = J P Jᵀ + R; the sizes of points in one pass."""
    p, dim = jac.shape[0], jac.shape[1]
    if p == 2 and dim == 2:
        _innovation_in_plane(flat(jac), flat(cov), noise, count, flat(cross), flat(total))
    elif dim == 3:
        _innovation_in_space(p, flat(jac), flat(cov), noise, count, flat(cross), flat(total))
    else:
        _innovation(jac, cov, noise, count, cross, total)


@njit(cache=True, error_model="numpy")
def _innovation_in_plane(jac, cov, noise, count, cross, total):
    r00, r10, r11 = noise[0, 0], noise[1, 0], noise[1, 1]
    for i in range(count):
        j00, j01, j10, j11 = jac[i], jac[BLOCK + i], jac[2 * BLOCK + i], jac[3 * BLOCK + i]
        p00, p10, p11 = cov[i], cov[BLOCK + i], cov[2 * BLOCK + i]
        c00, c01 = j00 * p00 + j01 * p10, j00 * p10 + j01 * p11
        c10, c11 = j10 * p00 + j11 * p10, j10 * p10 + j11 * p11
        cross[i], cross[BLOCK + i], cross[2 * BLOCK + i], cross[3 * BLOCK + i] = c00, c01, c10, c11
        total[i] = r00 + (c00 * j00 + c01 * j01)
        total[2 * BLOCK + i] = r10 + (c10 * j00 + c11 * j01)
        total[3 * BLOCK + i] = r11 + (c10 * j10 + c11 * j11)


@njit(cache=True, error_model="numpy")
def _innovation_in_space(p, jac, cov, noise, count, cross, total):
    for a in range(p):
        row = 3 * a * BLOCK
        for i in range(count):
            j0, j1, j2 = jac[row + i], jac[row + BLOCK + i], jac[row + 2 * BLOCK + i]
            p10, p20, p21 = cov[BLOCK + i], cov[3 * BLOCK + i], cov[4 * BLOCK + i]
            cross[row + i] = j0 * cov[i] + j1 * p10 + j2 * p20
            cross[row + BLOCK + i] = j0 * p10 + j1 * cov[2 * BLOCK + i] + j2 * p21
            cross[row + 2 * BLOCK + i] = j0 * p20 + j1 * p21 + j2 * cov[5 * BLOCK + i]
        for b in range(a + 1):
            other, entry, r = 3 * b * BLOCK, (p * a + b) * BLOCK, noise[a, b]
            for i in range(count):
                total[entry + i] = r + (
                    cross[row + i] * jac[other + i]
                    + cross[row + BLOCK + i] * jac[other + BLOCK + i]
                    + cross[row + 2 * BLOCK + i] * jac[other + 2 * BLOCK + i]
                )


@njit(cache=True, error_model="numpy")
def _filled(row, count):
    """First and end of the columns of a row (dim, BLOCK) between those that are zero in every lane."""
    first, end = 0, row.shape[0]
    while end > 0 and _is_zero(row[end - 1], count):
        end -= 1
    while first < end and _is_zero(row[first], count):
        first += 1
    return first, end


@njit(cache=True, error_model="numpy")
def _is_zero(lanes, count):
    filled = False
    for i in range(count):
        filled |= lanes[i] != 0.0
    return not filled


@njit(cache=True, error_model="numpy")
def _innovation(jac, cov, noise, count, cross, total):
    """Three terms at a time: a sum is loaded and stored once for them. Columns of zeros at both ends are left out.

    A measurement of several points of one record has rows that read one point each.
    """
    p, dim = jac.shape[0], jac.shape[1]
    for a in range(p):
        first, end = _filled(jac[a], count)
        last = end - (end - first) % 3
        for c in range(dim):
            for i in range(count):
                cross[a, c, i] = 0.0
            for b in range(first, last, 3):
                k, m, n = packed(b, c), packed(b + 1, c), packed(b + 2, c)
                for i in range(count):
                    partial = cross[a, c, i] + jac[a, b, i] * cov[k, i]
                    cross[a, c, i] = partial + jac[a, b + 1, i] * cov[m, i] + jac[a, b + 2, i] * cov[n, i]
            for b in range(last, end):
                k = packed(b, c)
                for i in range(count):
                    cross[a, c, i] += jac[a, b, i] * cov[k, i]
    for b in range(p):
        first, end = _filled(jac[b], count)
        last = end - (end - first) % 3
        for a in range(b, p):
            r = noise[a, b]
            for i in range(count):
                total[a, b, i] = r
            for c in range(first, last, 3):
                for i in range(count):
                    partial = total[a, b, i] + cross[a, c, i] * jac[b, c, i]
                    partial = partial + cross[a, c + 1, i] * jac[b, c + 1, i]
                    total[a, b, i] = partial + cross[a, c + 2, i] * jac[b, c + 2, i]
            for c in range(last, end):
                for i in range(count):
                    total[a, b, i] += cross[a, c, i] * jac[b, c, i]
