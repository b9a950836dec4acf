"""Resampling: four unbiased schemes, and a wrapper that resamples only when the weights have degenerated.

R. Douc, O. Cappé, E. Moulines 2005. Ancestors are ascending, so that gathering by them reads memory forwards.
"""

from dataclasses import dataclass, field
from typing import final

import numpy as np

from rbpf.arrays import numbers
from rbpf.core.models import Resampler
from rbpf.core.particles import effective_sample_size
from rbpf.kernels.dense import comb
from rbpf.ranges import Count, Fraction, Ranged

_ROUNDING = 1e-12  #: Relative tolerance for equal weights and for integer N W.


def _inverse_cdf(weights: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Index of the weight in whose interval each of the ascending points in [0, 1) falls; never one of weight zero."""
    cdf = np.cumsum(weights)
    last = int(np.flatnonzero(weights)[-1])
    return np.minimum(np.searchsorted(cdf / cdf[-1], points, side="right"), last)


@final
class Systematic(Resampler):
    """One uniform number for N equidistant points."""

    def ancestors(self, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        ancestors = np.empty(weights.size, dtype=np.int64)
        comb(numbers(weights, "weights"), rng.random(), ancestors)
        return ancestors


@final
class Stratified(Resampler):
    """One uniform number in each of N strata."""

    def ancestors(self, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        n = weights.size
        return _inverse_cdf(weights, (np.arange(n) + rng.random(n)) / n)


@final
class Multinomial(Resampler):
    """N independent draws."""

    def ancestors(self, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return _inverse_cdf(weights, np.sort(rng.random(weights.size)))


@final
class Residual(Resampler):
    """⌊N W_i⌋ descendants each, the rest by multinomial draws of the remainders."""

    def ancestors(self, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        n = weights.size
        counts = np.floor(n * weights * (1.0 + _ROUNDING)).astype(np.int64)
        rest = n - int(counts.sum())
        if rest > 0:
            remainders = np.maximum(n * weights - counts, 0.0)
            draws = _inverse_cdf(remainders / remainders.sum(), np.sort(rng.random(rest)))
            counts += np.bincount(draws, minlength=n)
        return np.repeat(np.arange(n), counts)


@final
@dataclass(frozen=True, eq=False)
class EssTriggered(Ranged, Resampler):
    """Resamples when the effective sample size falls below a fraction of N; else the weights carry over to the next step.

    Raises InputError: the threshold does not lie in [0, 1].
    """

    #: The resampling scheme.
    scheme: Resampler
    #: Fraction of N in [0, 1]; 0 never resamples, 1 whenever the weights differ.
    threshold: Fraction = 0.5

    def ancestors(self, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        if effective_sample_size(weights) >= self.threshold * weights.size * (1.0 - _ROUNDING):
            return None
        return self.scheme.ancestors(weights, rng)


@final
@dataclass(frozen=True)
class Consolidation(Ranged):
    """When the spread of the particles is merged into the marginalised Gaussian, instead of resampling.

    Raises InputError: the window is shorter than a step, or the threshold does not lie in [0, 1].
    """

    #: Maximum steps between consolidations; weights degenerate within a sampled window of dozens of steps.
    window: Count = 5
    #: Fraction of N below which the effective sample size triggers it earlier.
    threshold: Fraction = 0.5
    #: Whether it is suspended: the map's frame must not move to the robot while its pose is unknown.
    held: bool = field(default=False, repr=False)

    def is_due(self, age: int, weights: np.ndarray) -> bool:
        """Whether to consolidate, `age` steps after the last time, with weights (N,)."""
        enough = self.threshold * weights.size * (1.0 - _ROUNDING)
        return not self.held and (age >= self.window or effective_sample_size(weights) < enough)
