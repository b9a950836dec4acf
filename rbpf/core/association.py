"""Maximum-likelihood association per particle, with mutual exclusion, new landmarks and clutter.

Each measurement is explained by a landmark within the gate, by a new landmark (only where nothing known is near), or
by clutter; no landmark explains two. Costs, Mathematics (association-cost), are negative log-densities in the
measurement's units, so that the choice and the particle's weight speak of the same thing.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from rbpf import gaussian
from rbpf.core.models import NEW, NULL

_FORBIDDEN = 1e12
"""Cost of an impossible pair: far above any log-density, and finite because the assignment solver wants numbers."""


@dataclass(frozen=True)
class Gates:
    """When a landmark may explain a measurement, and what the alternatives cost.

    Attributes:
        accept: squared Mahalanobis distance up to which a landmark is a candidate.
        isolate: distance beyond which a measurement may start a landmark; between the two it can only be clutter.
        log_new: log-density of a new landmark's first measurement, in inverse measurement units.
        log_clutter: log-density of clutter.
    """

    accept: float
    isolate: float
    log_new: float
    log_clutter: float


def associate(nu: np.ndarray, cov: np.ndarray, present: np.ndarray, gates: Gates) -> np.ndarray:
    """Most probable explanation of K measurements among M landmarks, in each of N particles.

    Args:
        nu: (N, K, M, p) innovations.
        cov: (N, K, M, p, p) their predicted covariances, the pose's included.
        present: (N, M) whether the particle holds the landmark.
        gates: candidates and alternatives.

    Returns:
        (N, K) index of a landmark, NEW or NULL.
    """
    chol = gaussian.cholesky(cov)
    squared = np.square(gaussian.solve_lower(chol, nu)).sum(axis=-1)
    log_density = -0.5 * (squared + gaussian.log_det(chol) + nu.shape[-1] * np.log(2 * np.pi))
    squared = np.where(present[:, None, :], squared, np.inf)
    cost = np.where(squared <= gates.accept, -log_density, _FORBIDDEN)
    isolated = squared.min(axis=2, initial=np.inf) > gates.isolate
    alternative = np.where(isolated, max(gates.log_new, gates.log_clutter), gates.log_clutter)
    fallback = np.where(isolated & (gates.log_new >= gates.log_clutter), NEW, NULL)
    alternative = np.minimum(-alternative, 0.1 * _FORBIDDEN)
    if not cost.shape[2]:
        return fallback
    # Independent minima where they do not collide, the Hungarian method where two measurements chose one landmark.
    _, k, m = cost.shape
    best = cost.argmin(axis=2)
    chosen = np.where(np.take_along_axis(cost, best[..., None], axis=2)[..., 0] < alternative, best, fallback)
    ordered = np.sort(chosen, axis=1)
    collide = ((ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any(axis=1)
    for i in np.flatnonzero(collide):
        square = np.full((k, m + k), _FORBIDDEN)
        square[:, :m] = cost[i]
        square[np.arange(k), m + np.arange(k)] = alternative[i]
        columns = linear_sum_assignment(square)[1]
        chosen[i] = np.where(columns < m, columns, fallback[i])
    return chosen


@dataclass(frozen=True)
class ExistenceModel:
    """Log-odds that a landmark exists, per particle (M. Montemerlo and S. Thrun, FastSLAM, 2003).

    Attributes:
        hit: added for each observation.
        miss: subtracted where it should have been observed and was not.
        limit: log-odds are held within ± limit, so that no landmark becomes immortal.
        drop: a landmark below this leaves the particle.
    """

    hit: float = 1.0
    miss: float = 0.5
    limit: float = 5.0
    drop: float = -1.5

    def updated(self, log_odds: np.ndarray, seen: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """(N, M) log-odds after a frame; −inf where the landmark leaves the particle."""
        change = np.where(seen, self.hit, np.where(expected, -self.miss, 0.0))
        moved = np.clip(log_odds + change, -self.limit, self.limit)
        return np.where(np.isneginf(log_odds) | (moved < self.drop), -np.inf, moved)
