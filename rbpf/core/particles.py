"""The weighted particles, and the arithmetic of log-weights (S05 (8)–(12))."""

import math
from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError


@dataclass
class Particles:
    """N weighted states.

    Attributes:
        state: (N, E).
        log_weights: (N,) normalised.
    """

    state: np.ndarray
    log_weights: np.ndarray

    @property
    def n(self) -> int:
        """Number of particles."""
        return self.state.shape[0]

    @property
    def weights(self) -> np.ndarray:
        """(N,) summing to one."""
        return np.exp(self.log_weights)


def uniform_log_weights(n: int) -> np.ndarray:
    """(N,) log 1/N."""
    return np.full(n, -np.log(n))


def reweight(log_weights: np.ndarray, log_factors: np.ndarray, what: str) -> tuple[np.ndarray, float]:
    """Normalised log-weights after multiplication, and log Σ W·factor.

    Raises:
        InputError: a factor is NaN or +∞, or all products are zero.
    """
    with np.errstate(invalid="ignore"):  # from a weight of zero times an infinite factor, which is refused
        joint = log_weights + log_factors
    high = joint.max()
    if not math.isfinite(high):
        raise _unusable(log_factors, what)
    total = float(high + np.log(np.exp(joint - high).sum()))
    return joint - total, total


def _unusable(log_factors: np.ndarray, what: str) -> InputError:
    bad = np.flatnonzero(np.isnan(log_factors) | np.isposinf(log_factors))
    if bad.size == 0:
        return InputError(f"{what}: all particle weights are zero, no particle explains the observations")
    return InputError(
        f"{what}: the weight of particle {bad[0]} is {log_factors[bad[0]]}; check the models with rbpf.check_model"
    )


def effective_sample_size(weights: np.ndarray) -> float:
    """1 / Σ W², between 1 and N, for normalised weights (N,)."""
    return float(1.0 / np.square(weights).sum())
