"""Linear algebra of one small matrix: Cholesky's factor in its lower triangle, and what is solved by it."""

import math

from numba import njit


@njit(cache=True, error_model="numpy")
def factor(matrix):
    """Replaces the lower triangle of a positive definite matrix by its Cholesky factor."""
    for a in range(matrix.shape[0]):
        for b in range(a + 1):
            rest = matrix[a, b]
            for c in range(b):
                rest -= matrix[a, c] * matrix[b, c]
            matrix[a, b] = math.sqrt(rest) if a == b else rest / matrix[b, b]


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
