"""Where particles are sampled: the prior (bootstrap), the EKF-refined Gaussian (FastSLAM 2.0), its iteration.

All densities live in one chart per particle, at the transition's mean, and there in whitened coordinates u:
ε = μ + L u, so that the prior is N(0, I) even where Q = L Lᵀ is singular. With the information Λ = Σ HᵀS⁻¹H and
η = Σ HᵀS⁻¹ν about ε − μ, the refined distribution of u is N(M⁻¹Lᵀη, M⁻¹), M = I + LᵀΛL, Mathematics (refined), and the
joint marginal of the observations is log w₁ = −½[Σ νᵀS⁻¹ν − (Lᵀη)ᵀM⁻¹(Lᵀη)] − ½[Σ log|2πS| + log|M|],
Mathematics (look-ahead): E06 (10) for all observations together, with their correlation through the pose.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import final

import numpy as np

from rbpf.arrays import numbers
from rbpf.core.models import LineariseAt, Proposal
from rbpf.core.particles import Information, Prior, Proposed
from rbpf.kernels.dense import refine
from rbpf.kernels.signature import BLOCK, run_driver
from rbpf.ranges import Count, NotNegative, Ranged


@final
class PriorProposal(Proposal):
    """The bootstrap filter's: q is the motion model, w₁ = 1, w₂ = p(z | x) (S05 §II-A)."""

    def propose(self, prior: Prior, linearise: LineariseAt, rng: np.random.Generator) -> Proposed:
        return _unrefined(prior.factor.shape[2])


@lru_cache
def _unrefined(rank: int) -> Proposed:
    held = np.zeros((1, rank)), np.eye(rank)[None], np.zeros(1)
    for array in held:  # shared by all filters
        array.flags.writeable = False
    return Proposed(*held)


@final
@dataclass(frozen=True, eq=False)
class EkfProposal(Ranged, Proposal):
    """FastSLAM 2.0: the prior refined by the observations, linearised once or several times (E06 §4.2).

    Raises InputError: there is not at least one iteration, or `settled` is negative.
    """

    #: Whether weights include the exact importance ratio at the sample; False is E06's weight, the linearised marginal.
    exact: bool = True
    #: Maximum linearisations; 1 is E06, more is the iterated EKF (B. Bell and F. Cathey, 1993).
    iterations: Count = 1
    #: (d,) increment in each particle's chart at which to linearise first, if better known than by the prior; None is the
    #: prior's mean.
    start: np.ndarray | None = None
    #: Iteration ends once no particle's mean moves by more than this, in its standard deviations.
    settled: NotNegative = 0.0

    def propose(self, prior: Prior, linearise: LineariseAt, rng: np.random.Generator) -> Proposed:
        at = prior.mean if self.start is None else np.tile(self.start, (prior.base.shape[0], 1))
        proposed = refined(prior, linearise(at))
        for _ in range(self.iterations - 1):
            before = proposed
            at = prior.moved(before.mean)
            proposed = refined(prior, linearise(at))
            if self.settled:
                moved = np.linalg.solve(proposed.root, (proposed.mean - before.mean)[..., None])
                if np.abs(moved).max() < self.settled:
                    break
        return proposed


def refined(prior: Prior, information: Information) -> Proposed:
    """The refined Gaussian and the joint marginal weight of each particle, maximised over the choices of outliers."""
    n, rank = len(information.quad), prior.factor.shape[2]
    mean, root, squared, log_det = np.empty((n, rank)), np.empty((n, rank, rank)), np.empty(n), np.empty(n)
    # With M = C Cᵀ the covariance of u is C⁻ᵀC⁻¹, and its mean C⁻ᵀ of C⁻¹Lᵀη. Invalid values of a model make the weight NaN.
    given = (numbers(each, "information") for each in (information.info, information.vector, prior.factor))
    run_driver(refine, n * rank, -(-n // BLOCK), *given, mean, root, squared, log_det)
    nis = information.quad - squared
    log_w1 = information.log_factor - 0.5 * (nis + information.log_det + log_det)
    for other in information.otherwise:
        np.maximum(log_w1, refined(prior, other).log_w1, out=log_w1)
    return Proposed(mean, root, log_w1, nis, information.rows)
