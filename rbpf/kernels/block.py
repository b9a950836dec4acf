"""Linear algebra on a block of particles: matrices are `(rows, columns, BLOCK)`, symmetric ones packed by rows.

Sizes are small run-time numbers; the innermost loop always runs along the particles of the block.
"""

import math

from numba import njit


@njit(cache=True, error_model="numpy", inline="always")
def packed(a, b):
    """Index of entry (a, b) of a symmetric matrix stored as its lower triangle by rows."""
    return a * (a + 1) // 2 + b if a >= b else b * (b + 1) // 2 + a


@njit(cache=True, error_model="numpy")
def load_record(pool, slab, rows, start, count, mean, cov, const):
    """Gathers one landmark's record for the `count` particles from `start` on: mean, packed covariance, constants."""
    dim, size_cov, size_const = mean.shape[0], cov.shape[0], const.shape[0]
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
def innovation_covariance(jac, cov, noise, count, cross, total):
    """Cross = J P and the lower triangle of total = J P Jᵀ + R."""
    p, dim = jac.shape[0], jac.shape[1]
    for a in range(p):
        for c in range(dim):
            for i in range(count):
                cross[a, c, i] = 0.0
            for b in range(dim):
                m = packed(b, c)
                for i in range(count):
                    cross[a, c, i] += jac[a, b, i] * cov[m, i]
    for a in range(p):
        for b in range(a + 1):
            r = noise[a, b]
            for i in range(count):
                total[a, b, i] = r
            for c in range(dim):
                for i in range(count):
                    total[a, b, i] += cross[a, c, i] * jac[b, c, i]


@njit(cache=True, error_model="numpy")
def cholesky(total, count, scale):
    """Replaces the lower triangle of `total` by its Cholesky factor with INVERTED diagonal; scale *= Π 1/l_aa."""
    p = total.shape[0]
    for a in range(p):
        for b in range(a):
            for c in range(b):
                for i in range(count):
                    total[a, b, i] -= total[a, c, i] * total[b, c, i]
            for i in range(count):
                total[a, b, i] *= total[b, b, i]
        for c in range(a):
            for i in range(count):
                total[a, a, i] -= total[a, c, i] * total[a, c, i]
        for i in range(count):
            t = 1.0 / math.sqrt(total[a, a, i])
            total[a, a, i] = t
            scale[i] *= t


@njit(cache=True, error_model="numpy")
def whiten_vector(factor, count, vector):
    """Solves L y = vector in place, for a factor made by `cholesky`."""
    for a in range(factor.shape[0]):
        for c in range(a):
            for i in range(count):
                vector[a, i] -= factor[a, c, i] * vector[c, i]
        for i in range(count):
            vector[a, i] *= factor[a, a, i]


@njit(cache=True, error_model="numpy")
def whiten_matrix(factor, count, matrix):
    """Solves L Y = matrix in place, for a factor made by `cholesky`."""
    for a in range(factor.shape[0]):
        for e in range(matrix.shape[1]):
            for c in range(a):
                for i in range(count):
                    matrix[a, e, i] -= factor[a, c, i] * matrix[c, e, i]
            for i in range(count):
                matrix[a, e, i] *= factor[a, a, i]


@njit(cache=True, error_model="numpy")
def add_squares(vector, count, total):
    """Total += vectorᵀ vector."""
    for a in range(vector.shape[0]):
        for i in range(count):
            total[i] += vector[a, i] * vector[a, i]


@njit(cache=True, error_model="numpy")
def add_gram(matrix, sign, count, total):
    """Total += sign · matrixᵀ matrix, packed; two and three rows, the usual sizes, in one pass."""
    p = matrix.shape[0]
    for e in range(matrix.shape[1]):
        for f in range(e + 1):
            m = packed(e, f)
            if p == 2:
                for i in range(count):
                    total[m, i] += sign * (
                        matrix[0, e, i] * matrix[0, f, i] + matrix[1, e, i] * matrix[1, f, i]
                    )
            elif p == 3:
                for i in range(count):
                    total[m, i] += sign * (
                        matrix[0, e, i] * matrix[0, f, i]
                        + matrix[1, e, i] * matrix[1, f, i]
                        + matrix[2, e, i] * matrix[2, f, i]
                    )
            else:
                for a in range(p):
                    for i in range(count):
                        total[m, i] += sign * matrix[a, e, i] * matrix[a, f, i]


@njit(cache=True, error_model="numpy")
def add_transposed_product(matrix, vector, count, total):
    """Total += matrixᵀ vector."""
    for e in range(matrix.shape[1]):
        for a in range(matrix.shape[0]):
            for i in range(count):
                total[e, i] += matrix[a, e, i] * vector[a, i]
