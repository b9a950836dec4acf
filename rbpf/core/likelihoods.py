"""Likelihoods of an innovation, and the associations that maximise them.

Each measurement is explained by a landmark within the gate, by a new landmark (only if no known one is near), or by
clutter; no landmark explains two. `associate` solves this in every particle separately, where landmarks are independent;
`associations` finds the most probable explanations of a whole frame by landmarks with one joint Gaussian. Costs,
Mathematics (association-cost), are negative log-densities in the measurement's units, consistent with the weights.
"""

from copy import copy
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from scipy.special import gammaln

from rbpf import gaussian
from rbpf.core.models import NEW, NULL, Likelihood
from rbpf.errors import InputError
from rbpf.lie import Array


@final
class Gaussian(Likelihood):
    """log N(ν; 0, S)."""

    kernel_id = 0

    def log_density(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        return gaussian.log_density(nu, cov)


@final
class TruncatedMahalanobis(Likelihood):
    """−½ min(T_l, νᵀS⁻¹ν), S05 (6); a null match costs T_l/2. It is not a density: evidence is not defined.

    T_l bounds the weight only. S05 does not say that clipped observations do not update the landmark: at 4.0 a quarter of
    the true measurements would be lost, those that contradict the particle's map.

    Args:
        limit: T_l, dimensionless; the paper's is 4.0.
        update_limit: νᵀS⁻¹ν beyond which an observation updates neither the state nor the landmark; None is T_l.
    """

    normalised = False
    rejects = True
    kernel_id = 1

    def __init__(self, limit: float = 4.0, update_limit: float | None = None) -> None:
        if not limit > 0:
            raise InputError(f"the limit T_l of a truncated Mahalanobis likelihood must be positive, got {limit}")
        update_limit = limit if update_limit is None else update_limit
        if not update_limit >= limit:
            raise InputError(
                f"the update_limit of a truncated Mahalanobis likelihood must be at least T_l = {limit:g}, "
                f"got {update_limit}"
            )
        self.params = np.array([limit, update_limit], dtype=float)

    def log_density(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        return -0.5 * np.minimum(self.params[0], squared_mahalanobis(nu, cov))

    def inlier(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        return squared_mahalanobis(nu, cov) <= self.params[1]

    def log_odds(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        return 0.5 * (self.params[1] - squared_mahalanobis(nu, cov))

    def predicted_inlier(self, nu: np.ndarray, cov: np.ndarray, predictive: np.ndarray) -> np.ndarray:
        """Within the limit for updates; for the look-ahead, at least as probable as an outlier."""
        if self.kernel_id == 1:
            return self.inlier(nu, predictive)
        log_ratio = gaussian.log_det(gaussian.cholesky(predictive)) - gaussian.log_det(gaussian.cholesky(cov))
        return squared_mahalanobis(nu, predictive) + log_ratio <= self.params[0]

    def of_look_ahead(self) -> Likelihood:
        """The likelihood with the inliers that T_l does not clip at the prediction, Mathematics (truncated-look-ahead)."""
        weighing = copy(self)
        weighing.kernel_id = 3
        return weighing

    def log_outlier(self) -> float:
        return -0.5 * float(self.params[0])


@final
class GaussianWithOutliers(Likelihood):
    """log[(1−ε) N(ν; 0, S) + ε/V].

    Args:
        rate: ε, the fraction of outliers, in (0, 1).
        volume: V, of the measurement space in which outliers are uniform, in the measurement's units.
    """

    rejects = True
    kernel_id = 2

    def __init__(self, rate: float, volume: float) -> None:
        if not 0 < rate < 1 or not volume > 0:
            raise InputError(f"outliers need a rate in (0, 1) and a positive volume, got {rate} and {volume}")
        self.params = np.array([np.log1p(-rate), np.log(rate / volume)])

    def log_density(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        return np.logaddexp(gaussian.log_density(nu, cov) + self.params[0], self.params[1])

    def inlier(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """An observation that is more probable as an inlier than as an outlier."""
        return gaussian.log_density(nu, cov) + self.params[0] >= self.params[1]

    def log_odds(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        return gaussian.log_density(nu, cov) + self.params[0] - self.params[1]

    def log_inlier(self) -> float:
        return float(self.params[0])

    def log_outlier(self) -> float:
        return float(self.params[1])


@final
class StudentT(Likelihood):
    """Multivariate t with the scale matrix S: a Gaussian of uncertain covariance, so that large innovations have less effect.

    In a joint map it models the measurement noise, and each observation's update uses its own learnt noise, Mathematics
    (joint-tails). In per-particle maps it only weighs, and the update is Kalman's with S.

    Args:
        dof: degrees of freedom; infinitely many are a Gaussian.
    """

    def __init__(self, dof: float = 4.0) -> None:
        if not 0.0 < dof < np.inf:
            raise InputError(f"Student's t needs degrees of freedom above 0 and finite, got {dof}")
        self.dof = dof

    def log_density(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        chol, half = gaussian.cholesky(cov), 0.5 * (self.dof + nu.shape[-1])
        squared = np.square(gaussian.solve_lower(chol, nu)).sum(axis=-1)
        scale = gaussian.log_det(chol) + nu.shape[-1] * np.log(self.dof * np.pi)
        return gammaln(half) - gammaln(0.5 * self.dof) - 0.5 * scale - half * np.log1p(squared / self.dof)


def squared_mahalanobis(nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """νᵀS⁻¹ν, (…, p), (…, p, p) → (…)."""
    white = gaussian.solve_lower(gaussian.cholesky(cov), nu)
    return np.square(white).sum(axis=-1)


#: Cost of an impossible pair: far above any log-density, yet finite as the assignment solver requires.
_FORBIDDEN = 1e12


@dataclass(frozen=True)
class Gates:
    """Gates of the association, and the costs of its alternatives."""

    accept: float  #: squared Mahalanobis distance up to which a landmark is a candidate.
    isolate: float  #: squared distance beyond which a measurement may start a landmark; between the two it is clutter.
    log_new: float  #: log-density of a new landmark's first measurement, in inverse measurement units.
    log_clutter: float  #: log-density of clutter.


def associate(nu: np.ndarray, cov: np.ndarray, present: np.ndarray, gates: Gates) -> np.ndarray:
    """Most probable association of K measurements with M landmarks, in each of N particles.

    Takes innovations (N, K, M, p), their predicted covariances (N, K, M, p, p) including the pose's, and whether a particle
    holds a landmark (N, M); returns (N, K): index of a landmark, NEW or NULL.
    """
    from scipy.optimize import linear_sum_assignment  # slow to import, rarely needed

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
    # Independent minima if they do not collide, else the Hungarian method.
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


class Association(NamedTuple):
    """An association of K measurements, and the predictions of M landmarks conditioned on it."""

    chosen: np.ndarray  #: (K,) index of a landmark, NEW or NULL.
    log_density: float  #: of all measurements.
    mean: np.ndarray  #: (M, p).
    cov: np.ndarray  #: (M, p, p).


WIDTH = 50  #: Beam width: maximum number of partial associations that are kept.


def associations(
    z: Array, noise: Array, mean: Array, cov: Array, gates: Gates, log_unit: Array, bound: float
) -> list[Association]:
    """The most probable associations of a frame, best first, Mathematics (association-search).

    Beam search over the measurements, those with the fewest candidates first. Each partial association conditions the
    landmarks' joint prediction by Kalman updates, which then scores the next measurement: jointly compatible matches are
    found together (as in the joint compatibility of J. Neira and J. Tardós 2001), and exclusion and all densities are those
    of the joint Gaussian.

    Args:
        z: (K, p) measurements.
        noise: (K, p, p) their covariance.
        mean: (M, p) predicted measurements of the landmarks.
        cov: (M p, M p) their joint covariance.
        gates: as of `associate`.
        log_unit: (K,) log-size of the gates' density unit, in units of z.
        bound: log-ratio to the best association up to which others are kept.
    """
    (k, p), m = z.shape, len(mean)
    best_else = max(gates.log_new, gates.log_clutter)
    total, chosen = np.zeros(1), np.full((1, k), NULL)
    mean, cov, each = mean.reshape(1, -1), cov[None], np.arange(m)

    def blocks() -> np.ndarray:
        return np.moveaxis(cov.reshape(len(cov), m, p, m, p)[:, each, :, each], 0, 1)

    alone = squared_mahalanobis(z[:, None] - mean.reshape(m, p), blocks()[0] + noise[:, None])
    for reading in np.argsort((alone <= gates.accept).sum(axis=1), kind="stable").tolist():
        # Options: an unused landmark within the gate, or none.
        nu, own = z[reading] - mean.reshape(len(mean), m, p), blocks() + noise[reading]
        free = (squared_mahalanobis(nu, own) <= gates.accept) & ~(chosen[:, :, None] == each).any(axis=1)
        by_landmark = np.where(free, gaussian.log_density(nu, own), -np.inf)
        log_else = np.full((len(total), 1), best_else - log_unit[reading])
        options = (total[:, None] + np.concatenate([by_landmark, log_else], axis=1)).ravel()
        kept = np.argsort(-options, kind="stable")[:WIDTH]
        kept = kept[options[kept] >= options[kept[0]] - 2.0 * bound]
        parent, which = np.divmod(kept, m + 1)
        total, chosen, mean, cov = options[kept], chosen[parent], mean[parent], cov[parent]
        took = np.flatnonzero(which < m)
        if took.size:
            which, parent = which[took], parent[took]
            chosen[took, reading] = which
            columns = (which[:, None] * p + np.arange(p))[:, None]
            cross = np.take_along_axis(cov[took], columns, axis=2)
            gain = cross @ gaussian.inverse(own[parent, which])
            mean[took] += (gain @ nu[parent, which][..., None])[..., 0]
            cov[took] -= gain @ np.swapaxes(cross, 1, 2)
    # Unmatched measurements are new, or clutter if a landmark is as near as the measurement's own noise: a landmark's
    # position uncertainty is no reason to add a second one beside it.
    for reading in np.flatnonzero((chosen == NULL).any(axis=0)).tolist():
        apart = squared_mahalanobis(z[reading] - mean.reshape(len(mean), m, p), noise[reading])
        near = apart.min(axis=1, initial=np.inf) <= gates.isolate
        none = chosen[:, reading] == NULL
        if gates.log_new >= gates.log_clutter:
            chosen[none & ~near, reading] = NEW
            total = total + np.where(none & near, gates.log_clutter - best_else, 0.0)
    order = np.argsort(-total, kind="stable")
    order, means, covs = order[total[order] >= total[order[0]] - bound], mean.reshape(len(mean), m, p), blocks()
    return [Association(chosen[i], float(total[i]), means[i], covs[i]) for i in order.tolist()]


@dataclass(frozen=True)
class ExistenceModel:
    """Log-odds that a landmark exists, per particle (M. Montemerlo and S. Thrun, FastSLAM, 2003)."""

    hit: float = 1.0  #: added for each observation.
    miss: float = 0.5  #: subtracted where it should have been observed and was not.
    limit: float = 5.0  #: log-odds are clipped to ± limit, so that any landmark can still be dropped.
    drop: float = -1.5  #: a landmark below this is dropped from the particle.

    def updated(self, log_odds: np.ndarray, seen: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """(N, M) log-odds after a frame; −inf where the landmark is dropped."""
        change = np.where(seen, self.hit, np.where(expected, -self.miss, 0.0))
        moved = np.clip(log_odds + change, -self.limit, self.limit)
        return np.where(np.isneginf(log_odds) | (moved < self.drop), -np.inf, moved)
