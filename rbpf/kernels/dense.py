"""Linear algebra of small matrices: Cholesky's factor in its lower triangle, what is solved by it, and products."""

import math

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def factor(matrix, least=0.0):
    """Replaces the lower triangle of a positive definite matrix by its Cholesky factor.

    Returns whether it is definite: every pivot is above the fraction `least` of its variance.
    """
    definite = True
    for a in range(matrix.shape[0]):
        for b in range(a + 1):
            rest = matrix[a, b]
            for c in range(b):
                rest -= matrix[a, c] * matrix[b, c]
            if a == b:
                definite = definite and rest > least * matrix[a, a]
            matrix[a, b] = math.sqrt(rest) if a == b else rest / matrix[b, b]
    return definite


@njit(cache=True, error_model="numpy")
def solve_lower(chol, vector):
    """Replaces a vector by L⁻¹ times it."""
    for a in range(vector.size):
        for b in range(a):
            vector[a] -= chol[a, b] * vector[b]
        vector[a] /= chol[a, a]


@njit(cache=True, error_model="numpy")
def solve(chol, vector):
    """Replaces a vector by (L Lᵀ)⁻¹ times it."""
    solve_lower(chol, vector)
    for a in range(vector.size - 1, -1, -1):
        for b in range(a + 1, vector.size):
            vector[a] -= chol[b, a] * vector[b]
        vector[a] /= chol[a, a]


@njit(cache=True, error_model="numpy")
def product(left, right):
    """(m, k) times (k, n), C-contiguous: the same bytes on any number of threads, which BLAS does not promise."""
    m, count = left.shape
    out = np.zeros((m, right.shape[1]))
    whole = count - count % 4
    for i in range(m):
        for k in range(0, whole, 4):
            a, b, c, d = left[i, k], left[i, k + 1], left[i, k + 2], left[i, k + 3]
            for j in range(right.shape[1]):
                out[i, j] += (a * right[k, j] + b * right[k + 1, j]) + (c * right[k + 2, j] + d * right[k + 3, j])
        for k in range(whole, count):
            for j in range(right.shape[1]):
                out[i, j] += left[i, k] * right[k, j]
    return out
