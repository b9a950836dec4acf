"""Linear algebra on a block of particles: matrices are `(rows, columns, BLOCK)`, symmetric ones packed by rows.

Sizes are small numbers known at run time; the innermost loop always runs along the particles of the block.
"""

import math

import numpy as np
from numba import njit

from rbpf.kernels.se3 import rotation
from rbpf.kernels.signature import BLOCK, prefetch


@njit(cache=True, error_model="numpy", forceinline=True)
def packed(a, b):
    """Index of entry (a, b) of a symmetric matrix stored as its lower triangle by rows."""
    return a * (a + 1) // 2 + b if a >= b else b * (b + 1) // 2 + a


@njit(cache=True, error_model="numpy")
def lines(rows):
    """Memory for this many rows of a block, concatenated, aligned to a cache line.

    Each vector of eight numbers is then one line; unaligned, it spans two, and a sum takes half as long again.
    """
    held = np.empty(rows * BLOCK + 8)
    first = -(held.ctypes.data // 8) % 8
    return held[first : first + rows * BLOCK]


@njit(cache=True, error_model="numpy")
def workspace(size, p, dim, dim_map, size_const):
    """Memory for a block that processes one landmark after another.

    States (E, ·), a record's mean (D, ·), packed covariance and constants (A, ·), innovations (p, ·), Jacobians with
    respect to the state (p, d, ·) and the landmark (p, D, ·), J P (p, D, ·) and S (p, p, ·). The Jacobian with respect
    to the state is initially zero: a kernel fills the leading columns, those of the parts that it reads.
    """
    size_cov = dim_map * (dim_map + 1) // 2
    jac_state = lines(p * dim).reshape(p, dim, BLOCK)
    jac_state[:] = 0.0
    return (
        lines(size).reshape(size, BLOCK),
        lines(dim_map).reshape(dim_map, BLOCK),
        lines(size_cov).reshape(size_cov, BLOCK),
        lines(size_const).reshape(size_const, BLOCK),
        lines(p).reshape(p, BLOCK),
        jac_state,
        lines(p * dim_map).reshape(p, dim_map, BLOCK),
        lines(p * dim_map).reshape(p, dim_map, BLOCK),
        lines(p * p).reshape(p, p, BLOCK),
    )


@njit(cache=True, error_model="numpy")
def load_states(state, start, count, x):
    """Gathers the states of `count` particles from `start` on."""
    for e in range(state.shape[1]):
        for i in range(count):
            x[e, i] = state[start + i, e]


@njit(cache=True, error_model="numpy")
def load_record(pool, slab, rows, start, count, mean, cov, const):
    """Gathers one landmark's record for `count` particles from `start` on: mean, packed covariance, constants."""
    dim, size_cov, size_const = mean.shape[0], cov.shape[0], const.shape[0]
    first, apart = rows[start], False
    for i in range(count):
        apart |= rows[start + i] != first + i
    if not apart:  # consecutive rows, as before the first resampling after the record was written
        for f in range(dim):
            for i in range(count):
                mean[f, i] = pool[slab, f, first + i]
        for f in range(size_cov):
            for i in range(count):
                cov[f, i] = pool[slab, dim + f, first + i]
        for f in range(size_const):
            for i in range(count):
                const[f, i] = pool[slab, dim + size_cov + f, first + i]
        return
    for f in range(dim):
        for i in range(count):
            mean[f, i] = pool[slab, f, rows[start + i]]
    for f in range(size_cov):
        for i in range(count):
            cov[f, i] = pool[slab, dim + f, rows[start + i]]
    for f in range(size_const):
        for i in range(count):
            const[f, i] = pool[slab, dim + size_cov + f, rows[start + i]]


@njit(cache=True, error_model="numpy")
def expect_record(pool, slab, rows, start, count):
    """Prefetches the record that `load_record` will gather next; a cache line holds eight numbers."""
    for f in range(pool.shape[1]):
        field = pool.ctypes.data + 8 * (slab * pool.shape[1] + f) * pool.shape[2]
        for i in range(0, count, 8):
            prefetch(field + 8 * rows[start + i])


@njit(cache=True, error_model="numpy", forceinline=True)
def flat(array):
    """A block's rows concatenated: row m starts at m · BLOCK, a constant by which the compiler knows rows as distinct."""
    return array.reshape(array.size)


@njit(cache=True, error_model="numpy", forceinline=True)
def store_by_state(a0, a1, a2, x, y, z, row, i):
    """Stores a row of ∂z/∂ξ, flat, given the row a of ∂z/∂p at a point p = (x, y, z) in the moving frame: a × p, then −a."""
    row[i] = a1 * z - a2 * y
    row[BLOCK + i] = a2 * x - a0 * z
    row[2 * BLOCK + i] = a0 * y - a1 * x
    row[3 * BLOCK + i] = -a0
    row[4 * BLOCK + i] = -a1
    row[5 * BLOCK + i] = -a2


@njit(cache=True, error_model="numpy", forceinline=True)
def rotation_at(pose, i):
    """Rotation of lane i."""
    return rotation(pose[i], pose[BLOCK + i], pose[2 * BLOCK + i], pose[3 * BLOCK + i])


@njit(cache=True, error_model="numpy")
def whiten(total, count, vector, scale, squared):
    """Replaces the lower triangle of `total` by its Cholesky factor L with INVERTED diagonal, and a vector by L⁻¹ times it.

    `scale` is multiplied by the inverted pivots, the vector's squared norm is added to `squared`. Three rows are unrolled.
    """
    p = total.shape[0]
    for i in range(count):
        pivot = 1.0 / math.sqrt(total[0, 0, i])
        total[0, 0, i] = pivot
        scale[i] *= pivot
        vector[0, i] *= pivot
        squared[i] += vector[0, i] * vector[0, i]
    if p > 1:
        for i in range(count):
            first = total[1, 0, i] * total[0, 0, i]
            pivot = 1.0 / math.sqrt(total[1, 1, i] - first * first)
            total[1, 0, i] = first
            total[1, 1, i] = pivot
            scale[i] *= pivot
            rest = (vector[1, i] - first * vector[0, i]) * pivot
            vector[1, i] = rest
            squared[i] += rest * rest
    if p > 2:
        for i in range(count):
            first = total[2, 0, i] * total[0, 0, i]
            second = (total[2, 1, i] - first * total[1, 0, i]) * total[1, 1, i]
            pivot = 1.0 / math.sqrt(total[2, 2, i] - first * first - second * second)
            total[2, 0, i] = first
            total[2, 1, i] = second
            total[2, 2, i] = pivot
            scale[i] *= pivot
            rest = (vector[2, i] - first * vector[0, i] - second * vector[1, i]) * pivot
            vector[2, i] = rest
            squared[i] += rest * rest
    for a in range(3, p):
        for b in range(a):
            for c in range(b):
                for i in range(count):
                    total[a, b, i] -= total[a, c, i] * total[b, c, i]
            for i in range(count):
                total[a, b, i] *= total[b, b, i]
                total[a, a, i] -= total[a, b, i] * total[a, b, i]
                vector[a, i] -= total[a, b, i] * vector[b, i]
        for i in range(count):
            pivot = 1.0 / math.sqrt(total[a, a, i])
            total[a, a, i] = pivot
            scale[i] *= pivot
            vector[a, i] *= pivot
            squared[i] += vector[a, i] * vector[a, i]


@njit(cache=True, error_model="numpy")
def whiten_matrix(factor, count, matrix):
    """Solves L Y = matrix in place, for a factor made by `whiten`; up to three rows in one pass."""
    p = matrix.shape[0]
    for e in range(matrix.shape[1]):
        if p == 1:
            for i in range(count):
                matrix[0, e, i] *= factor[0, 0, i]
        elif p == 2:
            for i in range(count):
                first = matrix[0, e, i] * factor[0, 0, i]
                matrix[0, e, i] = first
                matrix[1, e, i] = (matrix[1, e, i] - factor[1, 0, i] * first) * factor[1, 1, i]
        else:
            for i in range(count):
                first = matrix[0, e, i] * factor[0, 0, i]
                second = (matrix[1, e, i] - factor[1, 0, i] * first) * factor[1, 1, i]
                rest = matrix[2, e, i] - factor[2, 0, i] * first - factor[2, 1, i] * second
                matrix[0, e, i], matrix[1, e, i], matrix[2, e, i] = first, second, rest * factor[2, 2, i]
        for a in range(3, p):
            for c in range(a):
                for i in range(count):
                    matrix[a, e, i] -= factor[a, c, i] * matrix[c, e, i]
            for i in range(count):
                matrix[a, e, i] *= factor[a, a, i]


@njit(cache=True, error_model="numpy")
def subtract_gram(matrix, count, total):
    """Total −= matrixᵀ matrix, packed; up to three rows per pass, so that a sum is loaded and stored once for them."""
    p = matrix.shape[0]
    done = min(p, 3) if p > 1 else 0
    for e in range(matrix.shape[1]):
        for f in range(e + 1):
            m = packed(e, f)
            if p == 2:
                for i in range(count):
                    first = total[m, i] - matrix[0, e, i] * matrix[0, f, i]
                    total[m, i] = first - matrix[1, e, i] * matrix[1, f, i]
            elif p > 2:
                for i in range(count):
                    first = total[m, i] - matrix[0, e, i] * matrix[0, f, i]
                    second = first - matrix[1, e, i] * matrix[1, f, i]
                    total[m, i] = second - matrix[2, e, i] * matrix[2, f, i]
            for a in range(done, p):
                for i in range(count):
                    total[m, i] -= matrix[a, e, i] * matrix[a, f, i]


@njit(cache=True, error_model="numpy")
def add_transposed_product(matrix, vector, count, total):
    """Total += matrixᵀ vector; up to three rows per pass, as in `subtract_gram`."""
    p = matrix.shape[0]
    done = min(p, 3) if p > 1 else 0
    for e in range(matrix.shape[1]):
        if p == 2:
            for i in range(count):
                total[e, i] = total[e, i] + matrix[0, e, i] * vector[0, i] + matrix[1, e, i] * vector[1, i]
        elif p > 2:
            for i in range(count):
                first = total[e, i] + matrix[0, e, i] * vector[0, i]
                total[e, i] = first + matrix[1, e, i] * vector[1, i] + matrix[2, e, i] * vector[2, i]
        for a in range(done, p):
            for i in range(count):
                total[e, i] += matrix[a, e, i] * vector[a, i]


@njit(cache=True, error_model="numpy")
def _filled(row, count):
    """Range of columns of a row (dim, BLOCK) without the leading and trailing ones that are zero in every lane."""
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
def innovation_covariance(jac, cov, noise, count, cross, total):
    """Cross = J P and the lower triangle of total = J P Jᵀ + R; for landmarks of two or three numbers in one pass each."""
    dim = jac.shape[1]
    if dim == 2:
        _innovation_covariance_of_two(jac, cov, noise, count, cross, total)
    elif dim == 3:
        _innovation_covariance_of_three(jac, cov, noise, count, cross, total)
    else:
        _innovation_covariance_of_many(jac, cov, noise, count, cross, total)


@njit(cache=True, error_model="numpy")
def _innovation_covariance_of_two(jac, cov, noise, count, cross, total):
    for a in range(len(jac)):
        for c in range(2):
            for i in range(count):
                cross[a, c, i] = jac[a, 0, i] * cov[c, i] + jac[a, 1, i] * cov[1 + c, i]
        for b in range(a + 1):
            r = noise[a, b]
            for i in range(count):
                total[a, b, i] = r + cross[a, 0, i] * jac[b, 0, i] + cross[a, 1, i] * jac[b, 1, i]


@njit(cache=True, error_model="numpy")
def _innovation_covariance_of_three(jac, cov, noise, count, cross, total):
    one, other, spread, out, n = flat(jac), flat(cov), flat(cross), flat(total), BLOCK
    for a in range(len(jac)):
        row = 3 * a * BLOCK
        end, r = (a * len(jac) + a) * BLOCK, noise[a, a]
        for i in range(count):
            x, y, z = one[row + i], one[row + n + i], one[row + 2 * n + i]
            first = x * other[i] + y * other[n + i] + z * other[3 * n + i]
            second = x * other[n + i] + y * other[2 * n + i] + z * other[4 * n + i]
            third = x * other[3 * n + i] + y * other[4 * n + i] + z * other[5 * n + i]
            spread[row + i], spread[row + n + i], spread[row + 2 * n + i] = first, second, third
            out[end + i] = r + first * x + second * y + third * z
        for b in range(a):
            left, end, r = 3 * b * BLOCK, (a * len(jac) + b) * BLOCK, noise[a, b]
            for i in range(count):
                first = r + spread[row + i] * one[left + i] + spread[row + n + i] * one[left + n + i]
                out[end + i] = first + spread[row + 2 * n + i] * one[left + 2 * n + i]


@njit(cache=True, error_model="numpy")
def _innovation_covariance_of_many(jac, cov, noise, count, cross, total):
    """Three terms per pass, so that a sum is loaded and stored once for them.

    Leading and trailing zero columns are skipped: if a measurement observes several points of one record, each row reads one.
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


@njit(cache=True, error_model="numpy")
def add_spread(jac, factor, start, count, column, total):
    """Adds H L (H L)ᵀ to the lower triangle of total."""
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
