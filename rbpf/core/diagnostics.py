"""Numbers that tell whether a filter is healthy: NEES and its band, ancestors, corrections of the motion."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from rbpf.core.genealogy import History
from rbpf.core.particles import Estimate, Prior, Proposed
from rbpf.lie import LieGroup


@dataclass(frozen=True)
class Band:
    """Two-sided band of a normalised error: `low` and `high`, with `expected` between them."""

    low: float
    expected: float
    high: float


def nees(space: LieGroup, estimate: Estimate, truth: np.ndarray) -> float:
    """Normalised estimation error squared eᵀP⁺e, e = Log(mean⁻¹ truth), truth (E,); its mean is d for a consistent filter."""
    error = space.local(estimate.mean, truth)
    return float(error @ np.linalg.pinv(estimate.cov, hermitian=True) @ error)


def chi_square_quantile(probability: Any, dof: float) -> Any:
    """What a χ² variable stays below with this probability, a number or an array."""
    # As `scipy.stats` has it, which takes half a second to import.
    return 2.0 * gammaincinv(0.5 * dof, probability)


def chi_square_band(dof: float, runs: int = 1, probability: float = 0.95) -> Band:
    """Band of the mean over `runs` independent χ² variables of `dof` degrees of freedom each.

    A consistent filter stays inside with the given probability (Bar-Shalom, Li, Kirubarajan 2001, §5.4).
    """
    tail = 0.5 * (1.0 - probability)
    low, high = chi_square_quantile([tail, 1.0 - tail], dof * runs) / runs
    return Band(float(low), float(dof), float(high))


def ancestors_by_step(history: History) -> np.ndarray:
    """How many particles of each step kept still have descendants among the present ones, (T,) int."""
    counts = [np.full(len(b.states), history.lineage.distinct(b.generation)) for b in history.blocks]
    return np.concatenate([np.zeros(0, dtype=np.int64), *counts])


def coalescence_steps(history: History) -> int | None:
    """Steps back from the last one to the latest ancestor that all particles share; None where no step kept has one."""
    single = np.flatnonzero(ancestors_by_step(history) == 1)
    return int(history.stamps_ns.size - 1 - single[-1]) if single.size else None


@dataclass(frozen=True)
class Correction:
    """What the observations of one step say about the motion into it, beside what a consistent filter expects of them.

    The increment is μ + L u with u ~ N(0, I) before the observations. Given them, u has mean û and covariance C, within
    + between particles. By the law of total variance û has covariance I − C, and it is independent from step to step:
    an odometer with a bias of b standard deviations moves it to (I − C) b, and wrong noise makes it too large or small.
    """

    mean: np.ndarray  #: (r,) û.
    cov: np.ndarray  #: (r, r) I − C.


def motion_correction(mixture: tuple[Prior, Proposed | None, np.ndarray]) -> Correction | None:
    """The correction of a step's motion, from `StepReport.mixture`; None after a proposal that did not linearise."""
    _, proposed, log_weights = mixture
    if proposed is None:
        return None
    n = log_weights.size
    weights = np.exp(log_weights)
    centres = np.broadcast_to(proposed.mean, (n, proposed.mean.shape[1]))
    roots = np.broadcast_to(proposed.root, (n, *proposed.root.shape[1:]))
    mean = weights @ centres
    spread = np.sqrt(weights)[:, None] * (centres - mean)
    within = np.einsum("n,nab,ncb->ac", weights, roots, roots)
    return Correction(mean, np.eye(mean.size) - within - spread.T @ spread)
