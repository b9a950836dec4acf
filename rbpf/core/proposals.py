"""Where particles are sampled: the prior (bootstrap), the EKF-refined Gaussian (FastSLAM 2.0), its iteration.

All densities live in one chart per particle, at the transition's mean, and there in whitened coordinates u:
ε = μ + L u, so that the prior is N(0, I) even where Q = L Lᵀ is singular. With the information Λ = Σ HᵀS⁻¹H and
η = Σ HᵀS⁻¹ν about ε − μ, the refined law of u is N(M⁻¹Lᵀη, M⁻¹), M = I + LᵀΛL, Mathematics (refined), and the
joint marginal of the observations is log w₁ = −½[Σ νᵀS⁻¹ν − (Lᵀη)ᵀM⁻¹(Lᵀη)] − ½[Σ log|2πS| + log|M|],
Mathematics (look-ahead): E06 (10) for all observations together, with their correlation through the pose.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from rbpf.core.models import LineariseAt, Proposal, Transition
from rbpf.errors import InputError
from rbpf.lie import LieGroup


def take(array: np.ndarray, ancestors: np.ndarray | slice) -> np.ndarray:
    """Rows of the ancestors; an array shared by all particles (first axis 1) stays as it is."""
    return array if array.shape[0] == 1 else array[ancestors]


@dataclass(frozen=True)
class Prior:
    """Law of the increment before the observations: x = base · Exp(ε), ε ~ N(mean, factor factorᵀ).

    Attributes:
        space: the group of the states.
        base: (N, E) origin of each particle's chart.
        mean: (N or 1, d).
        factor: (N or 1, d, r).
        centred: whether the mean is zero.
    """

    space: LieGroup
    base: np.ndarray
    mean: np.ndarray
    factor: np.ndarray
    centred: bool = True

    @classmethod
    def of_transition(cls, transition: Transition, space: LieGroup) -> "Prior":
        """The law without a substate.

        Raises:
            InputError: the motion model has one.
        """
        if transition.coupling is not None and transition.coupling.shape[-1]:
            raise InputError(
                "the motion model drives a substate: give the filter a KalmanSubstate to hold it"
            )
        return cls(space, transition.mean, np.zeros((1, space.dim)), transition.noise_factor)

    @classmethod
    def exactly(cls, space: LieGroup, state: np.ndarray) -> "Prior":
        """States (N, E) that are known exactly."""
        return cls(space, state, np.zeros((1, space.dim)), np.zeros((1, space.dim, 0)))

    def at(self, increment: np.ndarray) -> np.ndarray:
        """States (N, E) at increments (N or 1, d)."""
        return self.space.retract(self.base, increment)

    def predicted(self) -> np.ndarray:
        """States (N, E) at the mean."""
        return self._predicted

    def spread(self, increment: np.ndarray) -> np.ndarray:
        """The factor (N, d, r) in the charts at the states at increments (N or 1, d), to first order."""
        if self.centred:
            return self.factor
        return self._spread if increment is self.mean else self.space.right_jacobian(increment) @ self.factor

    @cached_property
    def _predicted(self) -> np.ndarray:
        """Asked for several times in a step, as is `_spread`."""
        return self.base if self.centred else self.at(self.mean)

    @cached_property
    def _spread(self) -> np.ndarray:
        return np.asarray(self.space.right_jacobian(self.mean) @ self.factor)

    def take(self, ancestors: np.ndarray | slice) -> "Prior":
        """The laws of the ancestors."""
        return replace(
            self,
            base=self.base[ancestors],
            mean=take(self.mean, ancestors),
            factor=take(self.factor, ancestors),
        )


@dataclass
class Terms:
    """What the observations say about ε − μ, in information form; sums over independent observations add.

    Attributes:
        info: (N, d, d) Σ HᵀS⁻¹H.
        vector: (N, d) Σ HᵀS⁻¹ν.
        quad: (N,) Σ νᵀS⁻¹ν.
        log_det: (N,) Σ log|2πS|.
        log_factor: (N,) log-densities that do not depend on the increment: clutter, first sightings.
        rows: number of scalar measurements.
    """

    info: np.ndarray
    vector: np.ndarray
    quad: np.ndarray
    log_det: np.ndarray
    log_factor: np.ndarray
    rows: int = 0

    @classmethod
    def zeros(cls, n: int, dim: int) -> "Terms":
        """No observations."""
        return cls(np.zeros((n, dim, dim)), np.zeros((n, dim)), np.zeros(n), np.zeros(n), np.zeros(n))

    @classmethod
    def of_parts(cls, parts: list["Terms"]) -> "Terms":
        """The same observations, of particles that were taken in several parts."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            np.concatenate([part.info for part in parts]),
            np.concatenate([part.vector for part in parts]),
            np.concatenate([part.quad for part in parts]),
            np.concatenate([part.log_det for part in parts]),
            np.concatenate([part.log_factor for part in parts]),
            parts[0].rows,
        )

    def add(self, other: "Terms") -> None:
        """Adds independent observations, in place."""
        for name in ("info", "vector", "quad", "log_det", "log_factor"):
            getattr(self, name).__iadd__(getattr(other, name))
        self.rows += other.rows

    def charted(self, jacobian: np.ndarray) -> "Terms":
        """The same for a perturbation δ of the chart's coordinates, where the state moves by J δ; J (N, d, d)."""
        turned = np.swapaxes(jacobian, -1, -2)
        vector = (turned @ self.vector[..., None])[..., 0]
        return replace(self, info=turned @ self.info @ jacobian, vector=vector)

    def shifted(self, offset: np.ndarray) -> "Terms":
        """The same relative to a point `offset` (N, d) before the one linearised at: ν + H·offset."""
        moved = np.einsum("nab,nb->na", self.info, offset)
        quad = self.quad + (offset * (2.0 * self.vector + moved)).sum(axis=1)
        return replace(self, vector=self.vector + moved, quad=quad)


@dataclass(frozen=True)
class Proposed:
    """Gaussian in whitened coordinates that each particle's descendants are sampled from.

    Attributes:
        mean: (N, r) of u.
        root: (N or 1, r, r) upper triangular; the covariance of u is root rootᵀ.
        log_w1: (N,) look-ahead weight.
        nis: (N,) squared Mahalanobis distance of the joint innovation, None where nothing was linearised.
        rows: number of scalar measurements behind it.
    """

    mean: np.ndarray
    root: np.ndarray
    log_w1: np.ndarray
    nis: np.ndarray | None = None
    rows: int = 0

    def sample(self, ancestors: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """One u per descendant (N, r), and log p(u) − log q(u) (N,)."""
        noise = rng.standard_normal((ancestors.size, self.mean.shape[1]))
        root = take(self.root, ancestors)
        u = take(self.mean, ancestors) + np.einsum("nab,nb->na", root, noise)
        log_root = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        return u, 0.5 * (noise * noise - u * u).sum(axis=1) + log_root


@final
class PriorProposal(Proposal):
    """The bootstrap filter's: q is the motion model, w₁ = 1, w₂ = p(z | x) (S05 §II-A)."""

    def propose(self, prior: Prior, terms: LineariseAt) -> Proposed:
        """N(0, I) for every particle."""
        n, rank = prior.base.shape[0], prior.factor.shape[2]
        return Proposed(np.zeros((1, rank)), np.eye(rank)[None], np.zeros(n))


@final
class EkfProposal(Proposal):
    """FastSLAM 2.0: the prior refined by the observations, linearised once or several times (E06 §4.2).

    Args:
        exact: correct by the importance ratio at the sampled state; False is E06's weight, the linearised marginal.
        iterations: linearisations; 1 is E06, more is the iterated EKF (B. Bell and F. Cathey, 1993).
    """

    def __init__(self, exact: bool = True, iterations: int = 1) -> None:
        if iterations < 1:
            raise InputError(f"EkfProposal needs at least one iteration, got {iterations}")
        self.exact = exact
        self.iterations = iterations

    def propose(self, prior: Prior, terms: LineariseAt) -> Proposed:
        """Linearises at the prior's mean, then at the refined means."""
        at = prior.mean
        for iteration in range(self.iterations):
            proposed = refined(prior, terms(at))
            if iteration + 1 < self.iterations:
                at = prior.mean + np.einsum("nar,nr->na", prior.factor, proposed.mean)
        return proposed


def refined(prior: Prior, terms: "Terms") -> Proposed:
    """The refined Gaussian and the joint marginal weight of each particle."""
    from rbpf.kernels.posterior import posterior
    from rbpf.kernels.threads import run_driver

    n, rank = prior.base.shape[0], prior.factor.shape[2]
    mean, root = np.empty((n, rank)), np.empty((n, rank, rank))
    log_w1, nis = np.empty(n), np.empty(n)
    factor = np.ascontiguousarray(prior.factor)
    run_driver(
        posterior, n, terms.info, terms.vector, terms.quad, terms.log_det, factor, mean, root, log_w1, nis
    )
    log_w1 += terms.log_factor
    return Proposed(mean, root, log_w1, nis, terms.rows)
