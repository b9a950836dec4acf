"""Batched small Gaussians: Cholesky and semi-definite factors, triangular solves, log-density, unscented transform.

Every function broadcasts over leading axes and is meant for n up to about twelve. Covariances are full symmetric matrices
(..., n, n); a chol_* is lower triangular (..., n, n), a factor L is any matrix with L L^T = covariance. Results may be
stored entry by entry, so that further arithmetic runs along the batch: for C order use `numpy.ascontiguousarray`. Except
for few or large matrices, which are factored by LAPACK, loops run over the entries of a matrix and arithmetic along the
batch. Sums use no BLAS: equal input gives equal bytes.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotri

from rbpf.arrays import Array, Float, Like
from rbpf.errors import InputError

_LOG_2PI = float(np.log(2.0 * np.pi))
_ASYMMETRY = 1e-9
_NEGATIVE = 1e-9
_SINGULAR = 1e-12
_NO_SCALE = 1e-100
_NO_PIVOT = 5e-324  #: Factor on a variance: the product is zero, but infinite for an infinite variance.
_UNROLLED, _MANY = 8, 200  #: Up to this size and from this many matrices on, loops are faster than LAPACK.
_KEPT = 512  #: Maximum number of entries of matrices whose factors are cached.


def symmetrise(cov: Like[ArrayLike, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """Symmetric part, (..., n, n) -> (..., n, n)."""
    cov = np.asarray(cov, dtype=float)
    return 0.5 * (cov + np.swapaxes(cov, -1, -2))


def mixture_moments(
    weights: Float[np.ndarray, "N ..."], mean: Float[np.ndarray, "N ... D"], cov: Float[np.ndarray, "#N ... D D"]
) -> tuple[Float[np.ndarray, "... D"], Float[np.ndarray, "... D D"]]:
    """Mean (…, D) and covariance (…, D, D), within + between, of mixtures of Gaussians along the first axis.

    Weights (N, …) that sum to one, or (N,) common to all.
    """
    weights = weights.reshape(*weights.shape, *(1,) * (mean.ndim - weights.ndim))
    centre = (weights * mean).sum(axis=0)
    spread = mean - centre
    between = spread[..., :, None] * spread[..., None, :]
    return centre, symmetrise((weights[..., None] * (cov + between)).sum(axis=0))


def pack(cov: Like[ArrayLike, "*batch n n"]) -> Float[np.ndarray, "*batch packed"]:
    """Lower triangle row by row, c00 c10 c11 c20 c21 c22 ..., (..., n, n) -> (..., n (n + 1) / 2)."""
    cov = np.asarray(cov, dtype=float)
    rows, columns = _triangle(cov.shape[-1])
    return cov[..., rows, columns]


def unpack(packed: Like[ArrayLike, "*batch packed"], n: int) -> Float[np.ndarray, "*batch {n} {n}"]:
    """Symmetric matrix of a packed lower triangle, (..., n (n + 1) / 2) -> (..., n, n)."""
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
    """Inverse of `entries_first`, (n, m, ...) -> (..., n, m): a view, without a copy."""
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


def cholesky(cov: Like[ArrayLike, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """Lower Cholesky factor, upper triangle not read. Raises InputError: not positive definite, or NaN."""
    return _looked_up(_definite_factor, cov)


def psd_factor(cov: Like[ArrayLike, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """Square factor L with L L^T = cov of positive semi-definite, possibly singular matrices.

    A definite matrix gets its lower Cholesky factor, any other one its scaled eigenvectors, each independently of the
    rest of the batch. Raises InputError: NaN, not symmetric, or an eigenvalue below -1e-9 times the largest.
    """
    return _looked_up(_semidefinite_factor, cov)


def solve_lower(chol: Like[ArrayLike, "*#batch n n"], b: Like[ArrayLike, "*#batch n"]) -> Float[np.ndarray, "*batch n"]:
    """Solves chol x = b by forward substitution, b (..., n) -> (..., n)."""
    return solve_lower_matrix(chol, np.asarray(b, dtype=float)[..., None])[..., 0]


def solve_lower_matrix(
    chol: Like[ArrayLike, "*#batch n n"], b: Like[ArrayLike, "*#batch n k"]
) -> Float[np.ndarray, "*batch n k"]:
    """Solves chol X = B by forward substitution, B (..., n, k) -> (..., n, k)."""
    chol, b = np.asarray(chol, dtype=float), np.asarray(b, dtype=float)
    ndim = max(chol.ndim, b.ndim)
    lower, right = entries_first(chol, ndim), entries_first(b, ndim)
    n, k = right.shape[:2]
    out = np.empty((n, k, *np.broadcast_shapes(lower.shape[2:], right.shape[2:])))
    for i in range(n):
        row = right[i] - np.einsum("j...,jk...->k...", lower[i, :i], out[:i]) if i else right[0]
        out[i] = row / lower[i, i]
    return entries_last(out)


def inverse(cov: Like[ArrayLike, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """Inverse of positive definite matrices, exactly symmetric. Raises InputError: one is not positive definite."""
    chol = cholesky(cov)
    if chol.ndim == 2 and len(chol) > _UNROLLED:
        lower = dpotri(chol.T, overwrite_c=True)[0].T  # the upper triangle of the transpose
        return np.asarray(lower + np.tril(lower, -1).T)
    half = solve_lower_matrix(chol, np.eye(chol.shape[-1]))
    return gram(np.swapaxes(half, -1, -2))


def log_det(chol: Like[ArrayLike, "*batch n n"]) -> Float[np.ndarray, "*batch"]:
    """Logarithm of the determinant, log |chol chol^T|, (..., n, n) -> (...); a number for a single matrix."""
    return _looked_up(_log_det, chol)[()]


def log_density(
    residual: Like[ArrayLike, "*#batch n"], cov: Like[ArrayLike, "*#batch n n"]
) -> Float[np.ndarray, "*batch"]:
    """Logarithm of the density N(residual; 0, cov), residual (..., n) -> (...).

    Raises InputError: cov is not positive definite.
    """
    cov = np.asarray(cov, dtype=float)
    # One matrix along batch axes of stride 0, which repeat the same memory: it is factored once.
    chol = cholesky(cov[tuple(slice(None) if stride else slice(1) for stride in cov.strides[:-2])])
    white = solve_lower(chol, residual)
    return -0.5 * (np.square(white).sum(-1) + log_det(chol) + white.shape[-1] * _LOG_2PI)


def unscented_transform(
    function: Callable[[Array], Array], mean: Like[ArrayLike, "*#batch n"], cov: Like[ArrayLike, "*#batch n n"]
) -> tuple[Array, Array]:
    """Mean (..., m) and covariance (..., m, m) of y = function(x), x Gaussian, by 2n + 1 symmetric sigma points.

    x_0 = mean with the weight kappa / (n + kappa), and mean +- sqrt(n + kappa) times each column of a factor of cov (..., n,
    n), which may be singular, with the weights 1 / (2 (n + kappa)); Julier and Uhlmann, "Unscented Filtering and Nonlinear
    Estimation" (2004). No weight is negative, so the covariance is semi-definite. `function` maps (2n + 1, ..., n) to
    (2n + 1, ..., m): sigma points are the first axis, so that other arguments of it that vary along the batch broadcast.
    Raises InputError: cov is not a covariance.
    """
    mean = np.asarray(mean, dtype=float)
    n = mean.shape[-1]
    kappa = max(0.0, 3.0 - n)  # matches the fourth moment for n <= 3
    weights = np.full(2 * n + 1, 0.5 / (n + kappa))
    weights[0] = kappa / (n + kappa)
    # Zero, then plus and minus the factor's columns, (2n + 1, ..., n).
    columns = np.sqrt(n + kappa) * np.moveaxis(psd_factor(cov), -1, 0)
    offsets = np.concatenate([np.zeros_like(columns[:1]), columns, -columns])
    values = function(mean + offsets)
    mean_y = np.einsum("s,s...->...", weights, values)
    return mean_y, gram(np.moveaxis(values - mean_y, 0, -1) * np.sqrt(weights))


def _log_det(chol: Array) -> Array:
    return np.asarray(2.0 * np.log(chol.diagonal(axis1=-2, axis2=-1)).sum(-1))


def _looked_up(factor: Callable[[Array], Array], cov: Like[ArrayLike, "*batch n n"]) -> Array:
    cov = np.asarray(cov, dtype=float)
    return factor(cov) if cov.size > _KEPT else _kept_factor(factor, cov.tobytes(), cov.shape).copy()


@lru_cache(maxsize=64)
def _kept_factor(factor: Callable[[Array], Array], cov: bytes, shape: tuple[int, ...]) -> Array:
    # A sensor's noise is the same at every step, so its factor is cached.
    return factor(np.frombuffer(cov).reshape(shape))


def _definite_factor(cov: Array) -> Array:
    chol, definite = _factors(cov, _NO_PIVOT)
    _require(definite, "is not positive definite: hand in one of full rank, or use psd_factor")
    return chol


def _semidefinite_factor(cov: Array) -> Array:
    swapped = np.swapaxes(cov, -1, -2)
    # Reductions per matrix cost more than the factorisation, so they are made only if in doubt.
    if not (cov == swapped).all():
        _require_finite(cov)
        skewed = np.abs(cov - swapped).max((-1, -2)) > _ASYMMETRY * np.abs(cov).max((-1, -2))
        _require(~skewed, "is not symmetric: pass it through symmetrise if it is rounding")
    factor, definite = _factors(cov, _SINGULAR)
    if not definite.all():
        _require_finite(cov)
        singular = ~definite
        negative = np.zeros_like(singular)
        factor[singular], negative[singular] = _eigen_factor(cov[singular])
        _require(~negative, "has a negative eigenvalue: check how it was computed")
    return factor


def _factors(cov: Array, floor: float) -> tuple[Array, NDArray[np.bool_]]:
    n = cov.shape[-1]
    if n > _UNROLLED or cov.size <= _MANY * n * n:
        # LAPACK's error does not tell which matrix of the batch failed: the loops do.
        with suppress(np.linalg.LinAlgError):
            chol = np.asarray(np.linalg.cholesky(cov), dtype=float)
            pivots = chol.diagonal(axis1=-2, axis2=-1)
            # An entry that is not finite makes its row's pivot not finite.
            if (pivots * pivots > floor * cov.diagonal(axis1=-2, axis2=-1)).all():
                return chol, np.ones(cov.shape[:-2], dtype=bool)
    with np.errstate(invalid="ignore"):  # from infinite entries, which the callers report
        return _cholesky_batch(cov, floor)


def _cholesky_batch(cov: Array, floor: float) -> tuple[Array, NDArray[np.bool_]]:
    # A pivot that is not above `floor` times its variance, including infinite and NaN, means not definite.
    entries = entries_first(cov)
    chol = np.zeros(entries.shape)
    definite = np.ones(cov.shape[:-2], dtype=bool)
    for j in range(len(entries)):
        column = entries[j:, j]
        if j:
            column = column - np.einsum("ik...,k...->i...", chol[j:, :j], chol[j, :j])
        pivot = column[0]
        positive = pivot > floor * entries[j, j]
        definite &= positive
        chol[j:, j] = column / np.sqrt(np.where(positive, pivot, np.inf))
    return entries_last(chol), definite


def _eigen_factor(cov: Array) -> tuple[Array, NDArray[np.bool_]]:
    # The factor, and whether the matrix fails to be semi-definite.
    plain_values, plain_vectors = np.linalg.eigh(cov)
    negative = plain_values[..., 0] < -_NEGATIVE * np.abs(plain_values).max(-1)
    plain = plain_vectors * np.sqrt(np.maximum(plain_values, 0.0))[..., None, :]
    # Factor of the correlation matrix, to keep all digits with mixed units such as radians and metres.
    scale = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
    reciprocal = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > _NO_SCALE)
    values, vectors = np.linalg.eigh(symmetrise(cov) * reciprocal[..., :, None] * reciprocal[..., None, :])
    scaled = scale[..., :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    # With a variance of the order of rounding, correlations exceed one: there the covariance's own factor is closer.
    sound = values[..., :1, None] >= -_NEGATIVE * values[..., -1:, None]
    return np.where(sound, scaled, plain), negative


def _require_finite(cov: Array) -> None:
    _require(np.isfinite(cov).all((-1, -2)), "has an entry that is not finite: check the input it came from")


def _require(good: NDArray[np.bool_] | np.bool_, complaint: str) -> None:
    if not np.all(good):
        first = tuple(int(i) for i in np.argwhere(~np.asarray(good))[0])
        place = f"Covariance {first} of the batch" if first else "The covariance"
        raise InputError(f"{place} {complaint}.")
