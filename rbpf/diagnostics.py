"""Numbers that tell whether a filter is healthy: effective sample size, NIS, NEES, ancestor diversity."""

from dataclasses import dataclass

import numpy as np

from rbpf.estimate import Estimate
from rbpf.genealogy import Lineage
from rbpf.lie import LieGroup
from rbpf.particles import effective_sample_size

__all__ = ["Band", "ancestor_diversity", "chi_square_band", "effective_sample_size", "nees"]


@dataclass(frozen=True)
class Band:
    """Two-sided band of a normalised error: `low` and `high`, with `expected` between them."""

    low: float
    expected: float
    high: float


def nees(space: LieGroup, estimate: Estimate, truth: np.ndarray) -> float:
    """Normalised estimation error squared eᵀP⁺e, e = Log(mean⁻¹ truth); its mean is d for an honest filter.

    Args:
        space: group of the state.
        estimate: mean and covariance in the chart at the mean.
        truth: (E,).
    """
    error = space.local(estimate.mean, truth)
    return float(error @ np.linalg.pinv(estimate.cov, hermitian=True) @ error)


def chi_square_band(dof: float, runs: int = 1, probability: float = 0.95) -> Band:
    """Band of the mean over independent runs of a χ² variable (Bar-Shalom, Li, Kirubarajan 2001, §5.4).

    Args:
        dof: degrees of freedom of one run.
        runs: how many were averaged.
        probability: that an honest filter stays inside.
    """
    from scipy.stats import chi2

    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], dof * runs) / runs
    return Band(float(low), float(dof), float(high))


def ancestor_diversity(lineage: Lineage, ages: list[int]) -> dict[int, int]:
    """Distinct ancestors of the present particles, by age in resamplings.

    Ages whose generation is no longer kept are left out.
    """
    wanted = {age: lineage.generation - age for age in ages}
    return {age: lineage.distinct(g) for age, g in wanted.items() if lineage.is_retained(g)}
