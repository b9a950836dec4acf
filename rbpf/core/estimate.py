"""Mean and covariance of a weighted mixture on a manifold."""

from dataclasses import dataclass

import numpy as np

from rbpf import gaussian
from rbpf.core.proposals import Prior, Proposed


@dataclass(frozen=True)
class Estimate:
    """A Gaussian summary of the state.

    Attributes:
        mean: (E,) weighted Fréchet mean.
        cov: (d, d) in the right chart at the mean, within + between particles.
    """

    mean: np.ndarray
    cov: np.ndarray


def mixture_estimate(prior: Prior, proposed: Proposed | None, log_weights: np.ndarray) -> Estimate:
    """Summary of the refined mixture before sampling, or of the prior's states where nothing was proposed."""
    weights = np.exp(log_weights)
    factor = prior.factor
    centres = prior.predicted()
    if proposed is not None:
        increment = prior.mean + np.einsum("nar,nr->na", factor, proposed.mean)
        centres = prior.at(increment)
        factor = prior.spread(increment) @ proposed.root
    mean = prior.space.mean(centres, weights)
    spread = prior.space.local(mean, centres)
    between = np.einsum("n,na,nb->ab", weights, spread, spread)
    fraction = weights if factor.shape[0] > 1 else np.ones(1)
    within = np.einsum("n,nar,nbr->ab", fraction, factor, factor)
    return Estimate(mean, gaussian.symmetrise(within + between))
