"""Gaussian distributions: log-density, sampling, conditioning, and the image under a function."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbpf.arrays import Float, Like
from rbpf.errors import InputError
from rbpf.gaussian.matrices import Array, cholesky, generalised_inverse, gram, log_det, product, psd_factor, solve_lower

_LOG_2PI = float(np.log(2.0 * np.pi))


class Gaussian(NamedTuple):
    """Mean (..., n) and covariance (..., n, n)."""

    mean: Float[np.ndarray, "*batch n"]
    cov: Float[np.ndarray, "*batch n n"]


class Transformed(NamedTuple):
    """Mean (..., m) and covariance (..., m, m) of y, and cov_xy = cov(x, y) (..., n, m)."""

    mean: Float[np.ndarray, "*batch m"]
    cov: Float[np.ndarray, "*batch m m"]
    cov_xy: Float[np.ndarray, "*batch n m"]


def log_density(
    residual: Like[ArrayLike, "*#batch n"], cov: Like[ArrayLike, "*#batch n n"]
) -> Float[np.ndarray, "*batch"]:
    """Logarithm of the density N(residual; 0, cov).

    Args:
        residual: (..., n).
        cov: (..., n, n), positive definite.

    Returns:
        (...).

    Raises:
        InputError: A covariance is not positive definite.
    """
    chol = cholesky(cov)
    white = solve_lower(chol, residual)
    return -0.5 * (np.square(white).sum(-1) + log_det(chol) + white.shape[-1] * _LOG_2PI)


def sample(
    mean: Like[ArrayLike, "*#batch n"],
    factor: Like[ArrayLike, "*#batch n r"],
    rng: np.random.Generator,
    shape: tuple[int, ...] = (),
) -> Float[np.ndarray, "... n"]:
    """Draws of mean + factor e with e ~ N(0, I).

    Args:
        mean: (..., n).
        factor: (..., n, r); the covariance is factor factor^T.
        rng: Source of randomness.
        shape: Leading axes of independent draws, in front of the batch.

    Returns:
        (*shape, ..., n).
    """
    mean, factor = np.asarray(mean, dtype=float), np.asarray(factor, dtype=float)
    batch = np.broadcast_shapes(mean.shape[:-1], factor.shape[:-2])
    noise = rng.standard_normal((*shape, *batch, factor.shape[-1]))
    return mean + np.einsum("...nr,...r->...n", factor, noise)


def condition(
    mean_a: Like[ArrayLike, "*#batch n"],
    mean_b: Like[ArrayLike, "*#batch m"],
    cov_aa: Like[ArrayLike, "*#batch n n"],
    cov_ab: Like[ArrayLike, "*#batch n m"],
    cov_bb: Like[ArrayLike, "*#batch m m"],
    b: Like[ArrayLike, "*#batch m"],
) -> Gaussian:
    """Distribution of a given b, where (a, b) are jointly Gaussian.

    With the gain K = cov_ab cov_bb^- and a factor [F_a; F_b] of the joint covariance, the result is
    mean_a + K (b - mean_b) and (F_a - K F_b)(F_a - K F_b)^T, which cannot lose definiteness.
    Where cov_bb is singular, the generalised inverse leaves its null directions out.

    Args:
        mean_a: (..., n).
        mean_b: (..., m).
        cov_aa: (..., n, n).
        cov_ab: (..., n, m).
        cov_bb: (..., m, m).
        b: (..., m), the value observed.

    Returns:
        Mean (..., n) and covariance (..., n, n).

    Raises:
        InputError: The joint covariance holds NaN, is not symmetric or not positive semi-definite.
    """
    aa, ab, bb = (np.asarray(part, dtype=float) for part in (cov_aa, cov_ab, cov_bb))
    n, m = ab.shape[-2:]
    joint = np.empty((*np.broadcast_shapes(aa.shape[:-2], ab.shape[:-2], bb.shape[:-2]), n + m, n + m))
    joint[..., :n, :n], joint[..., :n, n:] = aa, ab
    joint[..., n:, :n], joint[..., n:, n:] = np.swapaxes(ab, -1, -2), bb
    factor = psd_factor(joint)
    gain = product(ab, generalised_inverse(bb))
    innovation = np.asarray(b, dtype=float) - np.asarray(mean_b, dtype=float)
    mean = np.asarray(mean_a, dtype=float) + np.einsum("...ij,...j->...i", gain, innovation)
    return Gaussian(mean, gram(factor[..., :n, :] - product(gain, factor[..., n:, :])))


def unscented_transform(
    function: Callable[[Array], Array],
    mean: Like[ArrayLike, "*#batch n"],
    cov: Like[ArrayLike, "*#batch n n"],
    kappa: float | None = None,
) -> Transformed:
    """Gaussian of y = function(x) from the 2n + 1 symmetric sigma points.

    x_0 = mean with the weight kappa / (n + kappa), and mean +- sqrt(n + kappa) times each column of
    a factor of cov with the weights 1 / (2 (n + kappa)); Julier and Uhlmann, "Unscented Filtering
    and Nonlinear Estimation" (2004). No weight is negative, so the covariance is semi-definite.

    Args:
        function: (2n + 1, ..., n) -> (2n + 1, ..., m); the sigma points are the first axis, so that
            arguments of its own which differ along the batch broadcast.
        mean: (..., n).
        cov: (..., n, n), may be singular.
        kappa: At least 0; by default max(0, 3 - n), which matches the fourth moment for n <= 3.

    Returns:
        Mean and covariance of y, covariance of x with y.

    Raises:
        InputError: kappa is negative, or cov is not a covariance.
    """
    mean = np.asarray(mean, dtype=float)
    n = mean.shape[-1]
    kappa = max(0.0, 3.0 - n) if kappa is None else kappa
    if kappa < 0.0:
        raise InputError(f"unscented_transform needs kappa >= 0, got {kappa}.")
    weights = np.full(2 * n + 1, 0.5 / (n + kappa))
    weights[0] = kappa / (n + kappa)
    # Zero, then plus and minus the factor's columns, (2n + 1, ..., n).
    columns = np.sqrt(n + kappa) * np.moveaxis(psd_factor(cov), -1, 0)
    offsets = np.concatenate([np.zeros_like(columns[:1]), columns, -columns])
    values = function(mean + offsets)
    roots = np.sqrt(weights)
    mean_y = np.einsum("s,s...->...", weights, values)
    weighted_y = np.moveaxis(values - mean_y, 0, -1) * roots
    weighted_x = np.moveaxis(offsets, 0, -1) * roots
    return Transformed(mean_y, gram(weighted_y), product(weighted_x, np.swapaxes(weighted_y, -1, -2)))
