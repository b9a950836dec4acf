"""Optimisation loops over GTSAM's factor graphs, and marginal covariances at the optimum.

The loops are here because GTSAM's own optimisers copy all values at every call of a factor written in
Python, a hundred times the cost; linearisation, elimination and retraction are GTSAM's.
"""

from collections.abc import Callable, Iterable
from typing import Any

import gtsam
import numpy as np

from rbpf.lie import Array

ROUGH = 1e-4
"""Fraction of the error that still counts as progress far from the optimum."""
EXACT = 1e-11
"""The same near by."""
ITERATIONS = 200
"""Most of them."""

OnIteration = Callable[[float], None]

_DAMPING = 1e-5
_MIN_DAMPING = 1e-10
_MAX_DAMPING = 1e10


def noise(cov: Array) -> Any:
    """Gaussian noise of a positive definite covariance."""
    # False, because GTSAM's search for diagonal matrices drops every covariance below 1e-8.
    return gtsam.noiseModel.Gaussian.Covariance(cov, False)


def huber(base: Any, threshold: float | None) -> Any:
    """Huber's loss on the norm of the whitened residual, in standard deviations; None leaves it Gaussian."""
    if threshold is None:
        return base
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(threshold), base)


def levenberg_marquardt(
    graph: Any,
    values: Any,
    tolerance: float,
    iterations: int = ITERATIONS,
    on_iteration: OnIteration | None = None,
) -> tuple[Any, int, bool]:
    """Damped Gauss-Newton.

    Args:
        graph: nonlinear factors.
        values: where to start.
        tolerance: it ends when a step gains less than this fraction of the error.
        iterations: most of them.
        on_iteration: told the error before each iteration; what it raises ends the optimisation.

    Returns:
        The values, the number of iterations, and whether it converged.
    """
    error, damping = graph.error(values), _DAMPING
    for count in range(1, iterations + 1):
        if on_iteration is not None:
            on_iteration(error)
        linear, slack = graph.linearize(values), tolerance * max(1.0, error)
        while damping <= _MAX_DAMPING:
            moved = _damped_step(linear, values, damping)
            before, after = error, graph.error(moved)
            if after <= before + slack:
                break
            damping *= 10
        else:
            return values, count, False
        values, error = moved, after
        if before - after <= slack:
            return values, count, True
        damping = max(damping / 10, _MIN_DAMPING)
    return values, iterations, False


def gauss_newton(graph: Any, values: Any) -> tuple[Any, int, bool]:
    """Full steps, none refused: on the way to hard constraints the error may rise. See `levenberg_marquardt`."""
    error = graph.error(values)
    for count in range(1, ITERATIONS + 1):
        before, values = error, _step(graph.linearize(values), values)
        error = graph.error(values)
        if abs(before - error) <= EXACT * max(1.0, before):
            return values, count, True
    return values, ITERATIONS, False


def marginals(graph: Any, values: Any, keys: Iterable[int]) -> list[Array]:
    """Marginal covariance of each key at the values, from one elimination of the whole graph.

    The conditionals' own square roots are used, because a constrained variable has no information matrix.
    """
    linear = graph.linearize(values)
    tree = linear.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(linear), gtsam.EliminateQR)

    def marginal(key: int) -> Array:
        conditional = tree.marginalFactor(key, gtsam.EliminateQR)
        factor = np.linalg.inv(conditional.R()) * conditional.get_model().sigmas()
        return np.asarray(factor @ factor.T)

    return [marginal(key) for key in keys]


def _damped_step(linear: Any, values: Any, damping: float) -> Any:
    damped, zero = gtsam.GaussianFactorGraph(), values.zeroVectors()
    damped.push_back(linear)
    for key in values.keys():  # noqa: SIM118, no mapping
        dim = len(zero.at(key))
        unit = gtsam.noiseModel.Unit.Create(dim)
        damped.push_back(gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(dim), np.zeros(dim), unit))
    return _step(damped, values)


def _step(linear: Any, values: Any) -> Any:
    # Cholesky is seven times as fast as QR, but GTSAM's refuses neighbours whose standard deviations differ by a
    # factor above 4096.
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
    try:
        return values.retract(linear.optimize(ordering))
    except RuntimeError:
        return values.retract(linear.optimize(ordering, gtsam.EliminateQR))
