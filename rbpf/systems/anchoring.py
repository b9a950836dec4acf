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

from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import elements, integers, numbers, read, read_one
from rbpf.core.filter import Filter, StepReport
from rbpf.core.genealogy import Lineage
from rbpf.core.likelihoods import Gaussian
from rbpf.core.linearisation import innovation_covariance, linearise
from rbpf.core.models import NULL, Landmark, Likelihood, NewLandmarks, ObservationModel, Observations, Records
from rbpf.core.particles import Estimate, Information, Prior, mixture_estimate
from rbpf.core.proposals import EkfProposal
from rbpf.errors import InputError
from rbpf.lie import LieGroup
from rbpf.maps.landmark_map import LandmarkMap

#: A landmark that owes more than this fraction of its information to the first frame says nothing about the start.
_MOST_OF_ALL = 0.999
# Names in a checkpoint, of the parts of the first motion and of the latest re-estimation.
_SECOND, _LATEST = ("second", "state", "delta", "factor"), ("latest", "latest_mean", "latest_factor")


@dataclass(frozen=True)
class Anchored:
    """The start pose in each particle's own world: world_from_start (N, E), and a factor (N, d, d) of its covariance there."""

    mean: np.ndarray
    factor: np.ndarray


def relative_estimate(
    space: LieGroup, anchored: Anchored, state: np.ndarray, log_weights: np.ndarray, origin: np.ndarray | None = None
) -> Estimate:
    """Mean and covariance of states (N, E) relative to the anchored frame, origin · x_0⁻¹ · x; no origin, the identity."""
    relative = space.between(anchored.mean, state)
    factor = space.adjoint(space.inverse(relative)) @ anchored.factor
    base = relative if origin is None else space.compose(origin, relative)
    return mixture_estimate(Prior(space, base, np.zeros((1, space.dim)), factor), None, log_weights)


@final
class StartAnchor:
    """Remembers the first frame and motion of a filter started from one known state, and re-estimates the start.

    Call `after_step` after every step; between re-estimations, `every` so many, descendants inherit their ancestor's. The
    likelihood is of the first frame's innovations, by default Gaussian.
    """

    def __init__(self, filter_: Filter, every: int = 10, likelihood: Likelihood | None = None) -> None:
        if every < 1:
            raise InputError(f"an anchor is re-estimated every 1, 2, … steps, got {every}")
        self._filter, self._every = filter_, every
        self._start = filter_.particles.state[0].copy()
        self._proposal = EkfProposal(iterations=2)
        self._likelihood = likelihood or Gaussian()
        self._seen: list[tuple[np.ndarray, NewLandmarks]] = []
        self._second: _FirstMotion | None = None
        self._latest: tuple[int, Anchored] | None = None

    def after_step(self, report: StepReport, control: object = None) -> Anchored:
        """Takes note of a step that moved by `control`; returns the start in each present particle's world."""
        filter_, steps = self._filter, self._filter.steps
        if steps == 1:
            first = 0
            for new_landmarks in report.first_observations:
                count = new_landmarks.z.shape[0]
                self._seen.append((report.new_landmarks[first : first + count], new_landmarks))
                first += count
            self._stamp_ns = report.stamp_ns
        elif steps == 2:
            dt = (report.stamp_ns - self._stamp_ns) * 1e-9
            transition = filter_.motion.transition(self._start[None], control, dt)
            delta = filter_.space.between(self._start, transition.mean[0])
            generation = filter_.lineage.generation
            filter_.lineage.retain(generation)
            self._second = _FirstMotion(generation, filter_.particles.state.copy(), delta, transition.noise_factor[0])
        if self._latest is None or steps % self._every == 0 or steps <= 3:
            anchored, lineage = self.estimate(), self._filter.lineage
            if self._latest is not None:
                lineage.release(self._latest[0])
            lineage.retain(lineage.generation)
            self._latest = (lineage.generation, anchored)
        return self.current()

    def current(self) -> Anchored:
        """The latest re-estimation, inherited by the present particles."""
        assert self._latest is not None
        generation, anchored = self._latest
        rows = self._filter.lineage.rows(generation)
        return Anchored(anchored.mean[rows], anchored.factor[rows])

    def estimate(self) -> Anchored:
        """The start in each present particle's world from all that is known now; before any motion, the start."""
        space, n = self._filter.space, self._filter.n
        if self._second is None:
            return Anchored(np.repeat(self._start[None], n, axis=0), np.zeros((n, space.dim, space.dim)))
        # The first motion, backwards: x_0 = x_1 · Exp(−w) · Δ⁻¹ = x_1 Δ⁻¹ · Exp(−Ad_Δ w), with Δ = x_0⁻¹ E[x_1].
        second = self._second
        ancestors = second.state[self._filter.lineage.rows(second.generation)]
        base = space.compose(ancestors, space.inverse(second.delta))
        backwards = np.repeat((space.adjoint(second.delta) @ second.factor)[None], n, axis=0)
        prior = Prior(space, base, np.zeros((1, space.dim)), backwards)
        # The first frame's measurements of landmarks that are still held, which must be known from elsewhere too.
        rest, groups = LandmarkMap(space, compiled=False), list[Observations]()
        rest.begin(n, Lineage(n))
        for ids, first in self._seen:
            held = ids[self._filter.belief().map.holds(ids)]
            if held.size:
                groups.append(self._without_first_frame(rest, held, first, np.isin(ids, held)))

        def linearise_at(increment: np.ndarray) -> Information:
            total = rest.information(prior.at(increment), groups, prior)
            charted = total.charted(np.broadcast_to(space.right_jacobian(increment), total.info.shape))
            return charted.shifted(np.broadcast_to(increment - prior.mean, (n, space.dim)))

        proposed = self._proposal.propose(prior, linearise_at, self._filter.rng)
        mean = prior.at(np.einsum("nar,nr->na", prior.factor, proposed.mean))
        # A square factor (N, d, d), also of noise of lower rank.
        factor = prior.factor @ proposed.root
        lacking = np.zeros((n, space.dim, space.dim - factor.shape[2]))
        return Anchored(mean, np.concatenate([factor, lacking], axis=2))

    def state_estimate(self, anchored: Anchored) -> Estimate:
        """Mean and covariance of the present state relative to the start, start · x_0⁻¹ · x."""
        space, particles = self._filter.space, self._filter.particles
        return relative_estimate(space, anchored, particles.state, particles.log_weights, self._start)

    def arrays(self) -> dict[str, np.ndarray]:
        out = {"anchor/groups": np.array(len(self._seen))}
        for number, (ids, first) in enumerate(self._seen):
            out |= {f"anchor/{number}/ids": ids, f"anchor/{number}/z": first.z, f"anchor/{number}/cov": first.cov}
        if self._second is not None:
            out |= {f"anchor/{name}": np.asarray(part) for name, part in zip(_SECOND, self._second, strict=True)}
        if self._latest is not None:
            generation, anchored = self._latest
            parts = np.array(generation), anchored.mean, anchored.factor
            out |= {f"anchor/{name}": part for name, part in zip(_LATEST, parts, strict=True)}
        return out

    def restore(self, arrays: dict[str, np.ndarray], model: ObservationModel, landmark: Landmark) -> None:
        """The inverse of `arrays`; all first observations must have been of one model and parametrisation."""
        lineage, space, sizes = self._filter.lineage, self._filter.space, {"n": self._filter.n}
        z, cov = numbers("seen", model.dim), numbers("seen", model.dim, model.dim)
        seen = {"ids": integers("seen", least=0), "z": z, "cov": cov}
        for number in range(int(read_one(arrays, "anchor/groups", integers(least=0)))):
            found = read(arrays, seen, f"anchor/{number}/")
            self._seen.append((found["ids"], NewLandmarks(found["z"], found["cov"], model, landmark)))
        if "anchor/second" in arrays:
            kinds = integers(), elements(space, "n"), elements(space), numbers(space.dim, "rank")
            second = dict(zip(_SECOND, kinds, strict=True))
            generation, *parts = read(arrays, second, "anchor/", **sizes).values()
            self._second = _FirstMotion(int(generation), *parts)
            lineage.take_up(self._second.generation)
        if "anchor/latest" in arrays:
            latest = dict(
                zip(_LATEST, (integers(), elements(space, "n"), numbers("n", space.dim, space.dim)), strict=True)
            )
            generation, *parts = read(arrays, latest, "anchor/", **sizes).values()
            self._latest = int(generation), Anchored(*parts)
            lineage.take_up(self._latest[0])

    def _without_first_frame(
        self, rest: LandmarkMap, ids: np.ndarray, first: NewLandmarks, rows: np.ndarray
    ) -> Observations:
        """Adds landmarks (K,) without the first frame's information, by a Kalman update with −R; its rows, to be used anew."""
        space, n, landmark_map = self._filter.space, self._filter.n, self._filter.belief().map
        model, z, cov_z = first.model, first.z[rows], first.cov[rows]
        records, present = landmark_map.read(ids), ~np.isneginf(landmark_map.log_odds(ids))
        start = np.repeat(self._start[None, None], n, axis=0)
        nu, jac = linearise(model, space, z, start, records.mean, records.const)
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
        added = rest.add_records(Records(mean, cov, records.const), landmark_map.landmark_of(int(ids[0])))
        return Observations(z, cov_z, model, self._likelihood, ids=np.where(use, added, NULL))


class _FirstMotion(NamedTuple):
    """Where the first motion led each particle of a generation (N, E), its mean Δ (E,) and noise factor (d, r)."""

    generation: int
    state: np.ndarray
    delta: np.ndarray
    factor: np.ndarray
