"""How small symmetric matrices are stored: full, packed, or entries first."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbpf.arrays import Float, Like
from rbpf.errors import InputError

Array = NDArray[np.float64]


def symmetrise(cov: Like[ArrayLike, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """Symmetric part, (..., n, n) -> (..., n, n)."""
    cov = np.asarray(cov, dtype=float)
    return 0.5 * (cov + np.swapaxes(cov, -1, -2))


def pack(cov: Like[ArrayLike, "*batch n n"]) -> Float[np.ndarray, "*batch packed"]:
    """Lower triangle row by row, c00 c10 c11 c20 c21 c22 ..., (..., n, n) -> (..., n (n + 1) / 2)."""
    cov = np.asarray(cov, dtype=float)
    rows, columns = _triangle(cov.shape[-1])
    return cov[..., rows, columns]


def unpack(packed: Like[ArrayLike, "*batch packed"], n: int) -> Float[np.ndarray, "*batch {n} {n}"]:
    """Symmetric matrix of a packed lower triangle, (..., n (n + 1) / 2) -> (..., n, n).

    Raises:
        InputError: The last axis does not have n (n + 1) / 2 entries.
    """
    packed = np.asarray(packed, dtype=float)
    rows, columns = _triangle(n)
    if packed.shape[-1] != rows.size:
        raise InputError(f"A packed {n} x {n} matrix has {rows.size} entries, got {packed.shape[-1]}.")
    out = np.empty((*packed.shape[:-1], n, n))
    out[..., rows, columns] = packed
    out[..., columns, rows] = packed
    return out


def entries_first(matrix: Array, ndim: int = 0) -> Array:
    """(..., n, m) -> contiguous (n, m, ...), with at least ndim axes: operations run along the batch."""
    if matrix.ndim < ndim:
        matrix = matrix.reshape((1,) * (ndim - matrix.ndim) + matrix.shape)
    last = matrix.ndim - 1
    return np.ascontiguousarray(matrix.transpose(last - 1, last, *range(last - 1)))


def entries_last(entries: Array) -> Array:
    """Inverse of `entries_first`, (n, m, ...) -> (..., n, m): a view, so that the way back copies nothing either."""
    return entries.transpose(*range(2, entries.ndim), 0, 1)


def product(
    a: Float[np.ndarray, "*#batch n k"], b: Float[np.ndarray, "*#batch k m"]
) -> Float[np.ndarray, "*batch n m"]:
    """Matrix product of stacks that broadcast, (..., n, k) and (..., k, m) -> (..., n, m)."""
    ndim = max(a.ndim, b.ndim)
    return entries_last(np.einsum("ik...,kj...->ij...", entries_first(a, ndim), entries_first(b, ndim)))


def gram(factor: Float[np.ndarray, "*batch n r"]) -> Float[np.ndarray, "*batch n n"]:
    """Product factor factor^T, exactly symmetric, (..., n, r) -> (..., n, n)."""
    entries = entries_first(factor)
    return entries_last(np.einsum("ir...,jr...->ij...", entries, entries))


@lru_cache
def _triangle(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.tril_indices(n)
