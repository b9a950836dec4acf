"""The weighted particles, and the Gaussian from which each particle's increment is drawn.

A particle's state moves by an increment ε in the right chart at the motion model's mean. `Prior` is its distribution before
the observations, `Information` that of the observations, `Proposed` the Gaussian it is sampled from. The arithmetic of
log-weights is that of S05 (8)–(12).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rbpf import gaussian
from rbpf.arrays import Float, Int, numbers
from rbpf.errors import InputError
from rbpf.kernels.dense import chart, increments
from rbpf.lie import LieGroup

#: Fields of `Information` that add up over independent observations.
SUMMED = "info", "vector", "quad", "log_det", "log_factor", "rows"
ROUNDING = 1e-15  #: Variances below this fraction of the largest are rounding errors.
NOTHING_MOVED = 1e-12  #: χ² below which weights differ by rounding alone.


@dataclass
class Particles:
    """N states (N, E) and their normalised log-weights (N,)."""

    state: Float[np.ndarray, "N E"]
    log_weights: Float[np.ndarray, " N"]

    @property
    def n(self) -> int:
        return self.state.shape[0]

    @property
    def weights(self) -> np.ndarray:
        return np.exp(self.log_weights)


def uniform_log_weights(n: int) -> np.ndarray:
    """(N,) log 1/N."""
    return np.full(n, -np.log(n))


def reweight(log_weights: np.ndarray, log_factors: np.ndarray, what: str) -> tuple[np.ndarray, float]:
    """Normalised log-weights times factors (N or 1,), and log Σ W·factor. Raises InputError: NaN, +∞ or all zero."""
    if log_factors.size == 1 and math.isfinite(log_factors[0]):
        return log_weights, float(log_factors[0])
    with np.errstate(invalid="ignore"):  # a weight of zero times an infinite factor, refused below
        joint = log_weights + log_factors
    high = joint.max()
    if not math.isfinite(high):
        bad = np.flatnonzero(np.isnan(log_factors) | np.isposinf(log_factors))
        if not bad.size:
            raise InputError(f"{what}: all particle weights are zero, no particle explains the observations")
        weight = f"the weight of particle {bad[0]} is {log_factors[bad[0]]}"
        raise InputError(f"{what}: {weight}; check the models with rbpf.check_model")
    log_sum = np.log(np.exp(joint - high).sum())
    total = float(high + log_sum)
    # In so large a total the sum is rounded away.
    return joint - total if abs(high) < 1e9 else joint - high - log_sum, total


def effective_sample_size(weights: np.ndarray) -> float:
    """1 / Σ W², between 1 and N, for normalised weights (N,)."""
    return float(1.0 / np.square(weights).sum())


def weighted_mean(values: Float[np.ndarray, "N k"], weights: Float[np.ndarray, " N"]) -> Float[np.ndarray, " k"]:
    """Σ W values (k,), summed row by row: the summation order of BLAS depends on the number of threads."""
    return np.asarray((weights[:, None] * values).sum(axis=0))


def take(array: np.ndarray, ancestors: np.ndarray | slice) -> np.ndarray:
    """Rows of the ancestors; an array shared by all particles (first axis 1) is returned unchanged."""
    if array.shape[0] == 1:
        return array
    return array[ancestors] if isinstance(ancestors, slice) else array.take(ancestors, axis=0)


@dataclass(frozen=True)
class Prior:
    """Distribution of the increment before the observations: x = base · Exp(ε), ε ~ N(mean, factor factorᵀ)."""

    space: LieGroup  #: the group of the states.
    base: Float[np.ndarray, "N E"]  #: (N, E) origin of each particle's chart.
    mean: Float[np.ndarray, "#N d"]  #: (N or 1, d).
    factor: Float[np.ndarray, "#N d r"]  #: (N or 1, d, r).
    centred: bool = True  #: whether the mean is zero.

    @classmethod
    def exactly(cls, space: LieGroup, state: Float[np.ndarray, "N E"]) -> "Prior":
        """States (N, E) that are known exactly."""
        return cls(space, state, np.zeros((1, space.dim)), np.zeros((1, space.dim, 0)))

    def at(self, increment: Float[np.ndarray, "#N d"]) -> Float[np.ndarray, "N E"]:
        """States (N, E) at increments (N or 1, d)."""
        return self.space.retract(self.base, increment)

    def predicted(self) -> Float[np.ndarray, "N E"]:
        """States (N, E) at the mean."""
        return self._predicted

    def moved(self, u: Float[np.ndarray, "#N r"]) -> Float[np.ndarray, "#N d"]:
        """Increments (N, d) at whitened coordinates u (N or 1, r), ε = μ + L u."""
        mean, factor, u = (numbers(array, "increments") for array in (self.mean, self.factor, u))
        out = np.empty((max(len(mean), len(factor), len(u)), mean.shape[1]))
        increments(mean, factor, u, out)
        return out

    def spread(self, increment: Float[np.ndarray, "#N d"]) -> Float[np.ndarray, "#N d r"]:
        """The noise factor (N, d, r), to first order, in the charts at the states with increments (N or 1, d)."""
        if self.centred:
            return self.factor
        return self._spread if increment is self.mean else self.space.right_jacobian(increment) @ self.factor

    @cached_property
    def _predicted(self) -> np.ndarray:
        """Cached, as is `_spread`: used several times in a step."""
        return self.base if self.centred else self.at(self.mean)

    @cached_property
    def _spread(self) -> np.ndarray:
        return np.asarray(self.space.right_jacobian(self.mean) @ self.factor)

    def take(self, ancestors: Int[np.ndarray, " N"] | slice) -> "Prior":
        mean, factor = take(self.mean, ancestors), take(self.factor, ancestors)
        return Prior(self.space, take(self.base, ancestors), mean, factor, self.centred)


@dataclass
class Information:
    """Information of the observations about ε − μ; independent observations add up."""

    info: Float[np.ndarray, "N d d"]  #: (N, d, d) Σ HᵀS⁻¹H.
    vector: Float[np.ndarray, "N d"]  #: (N, d) Σ HᵀS⁻¹ν.
    quad: Float[np.ndarray, " N"]  #: (N,) Σ νᵀS⁻¹ν.
    log_det: Float[np.ndarray, " N"]  #: (N,) Σ log|2πS|.
    #: (N,) log-densities that do not depend on the increment: clutter, new landmarks.
    log_factor: Float[np.ndarray, " N"]
    #: (N,) number of scalar measurements in the sums, without gated and unassociated ones.
    rows: Float[np.ndarray, " N"]
    #: the same for other choices of outliers; their weights are lower bounds of the look-ahead weight.
    otherwise: "tuple[Information, ...]" = ()

    @classmethod
    def zeros(cls, n: int, dim: int) -> "Information":
        """No observations."""
        return cls(np.zeros((n, dim, dim)), np.zeros((n, dim)), *np.zeros((4, n)))

    def add(self, other: "Information") -> None:
        """Adds independent observations, in place."""
        for name in SUMMED:
            getattr(self, name).__iadd__(getattr(other, name))

    def charted(self, jacobian: Float[np.ndarray, "#N d d"], offset: Float[np.ndarray, "#N d"]) -> "Information":
        """The same for a perturbation δ of the chart's coordinates, where the state moves by J δ; J (N, d, d).

        It is relative to the linearisation point minus `offset` (N, d): ν + H·offset.
        """
        info, vector, quad = (np.array(each, order="C") for each in (self.info, self.vector, self.quad))
        chart(np.ascontiguousarray(jacobian), np.ascontiguousarray(offset), info, vector, quad)
        otherwise = tuple(other.charted(jacobian, offset) for other in self.otherwise)
        return Information(info, vector, quad, self.log_det, self.log_factor, self.rows, otherwise)


@dataclass(frozen=True)
class Proposed:
    """Gaussian in whitened coordinates u, ε = μ + L u, that each particle's descendants are sampled from."""

    mean: Float[np.ndarray, "#N r"]  #: (N, r) of u.
    root: Float[np.ndarray, "#N r r"]  #: (N or 1, r, r) upper triangular; the covariance of u is root rootᵀ.
    log_w1: Float[np.ndarray, " #N"]  #: (N or 1,) look-ahead weight.
    #: (N,) squared Mahalanobis distance of the joint innovation, None without linearisation.
    nis: Float[np.ndarray, " N"] | None = None
    #: (N,) number of scalar measurements used in each particle.
    rows: Float[np.ndarray, " N"] | None = None

    @cached_property
    def _is_prior(self) -> bool:
        return len(self.root) == 1 and not self.mean.any() and np.array_equal(self.root[0], np.eye(self.root.shape[2]))

    def take(self, ancestors: Int[np.ndarray, " N"]) -> "Proposed":
        """The Gaussians and weights of the descendants' parents."""
        if len(self.root) == len(self.mean) == len(self.log_w1) == 1:
            return self
        return Proposed(take(self.mean, ancestors), take(self.root, ancestors), take(self.log_w1, ancestors))

    def sample(
        self,
        n: int,
        rng: np.random.Generator,
        balance: tuple[Float[np.ndarray, " M"], Float[np.ndarray, "M d"]] | None = None,
    ) -> tuple[Float[np.ndarray, "M r"], Float[np.ndarray, " #M"]]:
        """One u for each of n particles (n, r), and log p(u) − log q(u) (n or 1,).

        `balance` has the arguments weights and apart of `balanced`; None for independent draws.
        """
        noise = rng.standard_normal((n, self.mean.shape[1]))
        if balance is not None:
            noise = balanced(noise, *balance)
        if self._is_prior:
            return noise, np.zeros(1)
        u = self.mean + np.einsum("nab,nb->na", self.root, noise)
        # Summed by columns: NumPy takes twice as long to sum many short rows.
        roots = np.ascontiguousarray(np.diagonal(self.root, axis1=1, axis2=2).T)
        squares = np.ascontiguousarray((noise * noise - u * u).T)
        return u, 0.5 * squares.sum(axis=0) + np.log(roots).sum(axis=0)


def balanced(
    noise: Float[np.ndarray, "N r"], weights: Float[np.ndarray, " N"], apart: Float[np.ndarray, "N d"]
) -> Float[np.ndarray, "N r"]:
    """Transforms draws `noise` to have exactly the moments that independent draws have on average.

    Their weighted mean is 0, their weighted covariance (1 − ΣW²) I, and they are uncorrelated with the particles' existing
    differences `apart` (N, d). So the sample has the moments of its Gaussian, and a filter that continues from the moments
    has no Monte Carlo error in them (second-order exact sampling, D. Pham 2001). With too few particles the draws are
    returned unchanged.
    """
    left = 1.0 - float(np.square(weights).sum())
    if left * effective_sample_size(weights) <= 2.0 * noise.shape[1] + apart.shape[1] + 1.0:
        return noise if left > 0.0 else np.zeros_like(noise)
    column = weights[:, None]
    noise, apart = noise - weighted_mean(noise, weights), apart - weighted_mean(apart, weights)
    # Directions whose spread is only rounding errors are ignored.
    values, vectors = np.linalg.eigh((column * apart).T @ apart)
    spread = values > ROUNDING * values[-1:]
    root = vectors[:, spread] / np.sqrt(values[spread])
    noise = noise - apart @ (root @ (root.T @ ((column * apart).T @ noise)))
    chol = np.linalg.cholesky((column * noise).T @ noise / left)
    return np.linalg.solve(chol, noise.T).T


@dataclass(frozen=True)
class SecondWeight:
    """States (N, E) that were sampled, and their normalised log-weights before and after w₂, Mathematics (summary)."""

    state: Float[np.ndarray, "N E"]
    log_before: Float[np.ndarray, " N"]
    log_after: Float[np.ndarray, " N"]

    @cached_property
    def trust(self) -> float:
        """Fraction χ² / (χ² + Σ W²), where χ² = Σ W²/V − 1 measures the change of the weights by w₂ from V to W.

        w₂ shifts a mean by at most √χ² standard deviations; the sampling error of a mean is √(Σ W²) of them.
        """
        held = np.isfinite(self.log_after)
        after, before = self.log_after[held], self.log_before[held]
        moved = float(np.exp(2.0 * after - before).sum()) - 1.0
        if moved < NOTHING_MOVED:
            return 0.0
        return moved / (moved + float(np.exp(2.0 * after).sum()))


@dataclass(frozen=True)
class Estimate:
    """A Gaussian: weighted Fréchet mean (E,), cov (d, d) in the right chart there, within + between particles."""

    mean: Float[np.ndarray, " E"]
    cov: Float[np.ndarray, "d d"]


def mixture_estimate(
    prior: Prior, proposed: Proposed | None, log_weights: Float[np.ndarray, " N"], second: SecondWeight | None = None
) -> Estimate:
    """Summary of the refined mixture before sampling, or of the prior's states without a proposal.

    The covariance within a particle at δ in the chart of the mean is transformed by J_r⁻¹(δ), to first order.
    With a second weight, the samples with final weights enter with the fraction `SecondWeight.trust`.
    """
    weights, factor, centres = np.exp(log_weights), prior.factor, prior.predicted()
    if proposed is not None:
        increment = prior.moved(proposed.mean)
        centres = prior.at(increment)
        factor = prior.spread(increment) @ proposed.root
    n, trust = weights.size, 0.0 if second is None else second.trust
    if second is not None and trust > 0.0:
        centres = np.concatenate([centres, second.state])
        weights = np.concatenate([(1.0 - trust) * weights, trust * np.exp(second.log_after)])
    mean = prior.space.mean(centres, weights)
    spread = prior.space.local(mean, centres)
    between = np.einsum("n,na,nb->ab", weights, spread, spread)
    if not factor.any():
        return Estimate(mean, gaussian.symmetrise(between))
    factor = prior.space.right_jacobian_inverse(spread[:n]) @ factor
    within = np.einsum("n,nar,nbr->ab", weights[:n], factor, factor)
    return Estimate(mean, gaussian.symmetrise(within + between))
