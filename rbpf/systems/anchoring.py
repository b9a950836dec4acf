"""The start pose in each particle's world, re-estimated from everything that was learnt since.

A filter that starts from a known pose fixes its world by what it observed first, when the map was still poor; later
observations sharpen the map, but no particle can move the world it has committed to. Where the models do not change when
the whole world is moved (odometry, sensors that measure relative to the robot), the start pose of a particle can be
re-estimated from its own map: given the rest of the trajectory and the map without the first frame's measurements, x_0 has
the distribution of a filter step run backwards,

    p(x_0 | x_1, u_1, z_0, m) ∝ p(x_1 | x_0, u_1) p(z_0 | x_0, m),    Mathematics (start-again)

which leaves the posterior invariant (a Gibbs step for x_0, W. Gilks and C. Berzuini 2001) and, taken as the Gaussian that
it is instead of a draw from it, marginalises the world's place exactly. Poses and landmarks are reported relative to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import elements, integers, numbers, read
from rbpf.core.filter import StepReport
from rbpf.core.genealogy import Lineage
from rbpf.core.likelihoods import Gaussian
from rbpf.core.linearisation import innovation_covariance, linearise
from rbpf.core.models import (
    NULL,
    Conditional,
    Likelihood,
    LogDensities,
    ObservationModel,
    Observations,
    Part,
    Records,
    Transition,
)
from rbpf.core.particles import Estimate, Information, Prior, mixture_estimate
from rbpf.core.proposals import EkfProposal
from rbpf.errors import InputError
from rbpf.lie import LieGroup
from rbpf.maps.landmark_map import LandmarkMap

#: A landmark that owes more than this fraction of its information to the first frame says nothing about the start.
_MOST_OF_ALL = 0.999


@dataclass(frozen=True)
class Anchored:
    """The start pose in each particle's own world: world_from_start (N, E), and a factor (N, d, d) of its covariance there."""

    mean: np.ndarray
    factor: np.ndarray


def relative_estimate(space: LieGroup, anchored: Anchored, state: np.ndarray, log_weights: np.ndarray) -> Estimate:
    """Mean and covariance of states (N, E) relative to the anchored frame, x_0⁻¹ · x."""
    relative = space.between(anchored.mean, state)
    factor = space.adjoint(space.inverse(relative)) @ anchored.factor
    return mixture_estimate(Prior(space, relative, np.zeros((1, space.dim)), factor), None, log_weights)


@final
class StartAnchor(Conditional):
    """Remembers the first frame and motion of a filter that starts from the identity, and re-estimates the start.

    A part of the filter, so that descendants inherit what is kept of their ancestor. Call `after_step` after every step.

    Args:
        landmarks: the filter's map.
        model: how the first frame measured landmarks.
        every: steps between re-estimations.
        likelihood: of the first frame's innovations, by default Gaussian.

    Raises InputError: `every` is not positive.
    """

    supplies = Part("anchor")

    def __init__(
        self, landmarks: LandmarkMap, model: ObservationModel, every: int = 10, likelihood: Likelihood | None = None
    ) -> None:
        if every < 1:
            raise InputError(f"an anchor is re-estimated every 1, 2, … steps, got {every}")
        self.space, self._landmarks, self._model, self._every = landmarks.space, landmarks, model, every
        self._likelihood = likelihood or Gaussian()
        self._proposal, self._rng = EkfProposal(iterations=2), np.random.default_rng(0)  # it draws nothing

    def begin(self, n: int, lineage: Lineage) -> None:
        space, p = self.space, self._model.dim
        self._steps = 0
        # Landmarks of the first frame, and their measurements.
        self._ids, self._z, self._cov = np.zeros(0, dtype=np.int64), np.zeros((0, p)), np.zeros((0, p, p))
        # Where the first motion led each particle (N, E), its mean Δ (E,) and noise factor (d, r).
        self._second, self._delta, self._factor = space.identity((n,)), space.identity(), np.zeros((space.dim, 0))
        self._latest = Anchored(space.identity((n,)), np.zeros((n, space.dim, space.dim)))

    def predict(self, transition: Transition, space: LieGroup, dt: float) -> None:
        self._transition = transition

    def correct(self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]) -> LogDensities:
        """Takes note of the first motion: all particles came from the start, and moved alike but for noise."""
        self._steps += 1
        if self._steps == 2:
            self._second, self._delta = state.copy(), self._transition.mean[0]
            self._factor = self._transition.noise_factor[0]
        return LogDensities(*np.zeros((2, len(state))))

    def resample(self, ancestors: np.ndarray) -> None:
        self._second = self._second[ancestors]
        self._latest = Anchored(self._latest.mean[ancestors], self._latest.factor[ancestors])

    def after_step(self, report: StepReport) -> Anchored:
        """The start in each present particle's world; between re-estimations as it was inherited."""
        if self._steps == 1 and report.first_observations:
            first = report.first_observations
            self._ids, self._z = report.new_landmarks, np.concatenate([each.z for each in first])
            self._cov = np.concatenate([each.cov for each in first])
        if self._steps <= 3 or self._steps % self._every == 0:
            self._latest = self.estimate()
        return self._latest

    def estimate(self) -> Anchored:
        """The start in each present particle's world from all that is known now; before any motion, the start."""
        if self._steps < 2:
            return self._latest
        # The first motion, backwards: x_0 = x_1 · Exp(−w) · Δ⁻¹ = x_1 Δ⁻¹ · Exp(−Ad_Δ w), with Δ = x_0⁻¹ E[x_1].
        space, n = self.space, len(self._second)
        base = space.compose(self._second, space.inverse(self._delta))
        backwards = np.repeat((space.adjoint(self._delta) @ self._factor)[None], n, axis=0)
        prior = Prior(space, base, np.zeros((1, space.dim)), backwards)
        # The first frame's measurements of landmarks that are still held, which must be known from elsewhere too.
        rest, held = LandmarkMap(space, compiled=False), self._landmarks.holds(self._ids)
        rest.begin(n, Lineage(n))
        groups = [self._without_first_frame(rest, held)] if held.any() else []

        def linearise_at(increment: np.ndarray) -> Information:
            total = rest.information(prior.at(increment), groups, prior)
            return total.charted(space.right_jacobian(increment), increment - prior.mean)

        proposed = self._proposal.propose(prior, linearise_at, self._rng)
        mean = prior.at(np.einsum("nar,nr->na", prior.factor, proposed.mean))
        # A square factor (N, d, d), also of noise of lower rank.
        factor = prior.factor @ proposed.root
        lacking = np.zeros((n, space.dim, space.dim - factor.shape[2]))
        return Anchored(mean, np.concatenate([factor, lacking], axis=2))

    def _without_first_frame(self, rest: LandmarkMap, held: np.ndarray) -> Observations:
        """Adds landmarks (K,) without the first frame's information, by a Kalman update with −R; its rows, to be used anew."""
        ids, z, cov_z = self._ids[held], self._z[held], self._cov[held]
        records, present = self._landmarks.read(ids), ~np.isneginf(self._landmarks.log_odds(ids))
        start = self.space.identity((len(self._second), 1))
        nu, jac = linearise(self._model, self.space, z, start, records.mean, records.const)
        assert jac.landmark is not None
        explained = innovation_covariance(jac.landmark, records.cov, np.zeros_like(cov_z))
        chol = np.broadcast_to(gaussian.cholesky(cov_z), explained.shape)
        half = gaussian.solve_lower_matrix(chol, explained)
        fraction = np.linalg.eigvalsh(gaussian.symmetrise(gaussian.solve_lower_matrix(chol, np.swapaxes(half, -1, -2))))
        use = present & (fraction[..., -1] < _MOST_OF_ALL)
        left = np.where(use[..., None, None], cov_z - explained, np.eye(z.shape[1]))
        gain = records.cov @ np.swapaxes(jac.landmark, -1, -2) @ gaussian.inverse(left)
        mean = records.mean - np.einsum("nkdp,nkp->nkd", gain, nu)
        cov = gaussian.symmetrise(records.cov + gain @ jac.landmark @ records.cov)
        added = rest.add_records(Records(mean, cov, records.const), self._landmarks.landmark_of(int(ids[0])))
        return Observations(z, cov_z, self._model, self._likelihood, ids=np.where(use, added, NULL))

    def arrays(self) -> dict[str, np.ndarray]:
        latest = {"latest_mean": self._latest.mean, "latest_factor": self._latest.factor}
        first = {"ids": self._ids, "z": self._z, "cov": self._cov, "steps": np.array(self._steps)}
        return first | {"second": self._second, "delta": self._delta, "factor": self._factor} | latest

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        space, d, p = self.space, self.space.dim, self._model.dim
        schema = {
            "ids": integers("seen", least=0), "z": numbers("seen", p), "cov": numbers("seen", p, p),
            "steps": integers(least=0), "second": elements(space, "n"), "delta": elements(space),
            "factor": numbers(d, "rank"), "latest_mean": elements(space, "n"), "latest_factor": numbers("n", d, d),
        }  # fmt: skip
        self._ids, self._z, self._cov, steps, *moved, mean, factor = read(arrays, schema, n=len(self._second)).values()
        self._steps, self._latest = int(steps), Anchored(mean, factor)
        self._second, self._delta, self._factor = moved
