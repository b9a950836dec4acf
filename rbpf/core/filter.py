"""The Rao-Blackwellised particle filter: one step, for every variant.

    p(x_0:t, m | z_1:t, u_1:t) ≈ Σ_i w_i δ(x_0:t − x_0:t^i) p(m | x_0:t^i, z_1:t)        Mathematics (posterior)

The bootstrap filter, FastSLAM 2.0 and the exact importance ratio, Mathematics (correction), differ in the proposal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.core.belief import Belief
from rbpf.core.checkpoint import read_checkpoint, write_checkpoint
from rbpf.core.checks import checked_ancestors, checked_observations, checked_start, checked_transition
from rbpf.core.conditional import Marginals
from rbpf.core.estimate import Estimate, mixture_estimate
from rbpf.core.genealogy import Lineage
from rbpf.core.history import History
from rbpf.core.models import (
    Conditional,
    MotionModel,
    NewLandmarks,
    Observations,
    Proposal,
    Resampler,
    Sensor,
)
from rbpf.core.particles import Particles, effective_sample_size, reweight, uniform_log_weights
from rbpf.core.proposals import EkfProposal, Prior, Proposed
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.errors import InputError


@dataclass(frozen=True, eq=False)
class StepReport:
    """What one step did.

    Attributes:
        stamp_ns: time of the step.
        mixture: what the estimate summarises: the refined mixture before sampling, with its log-weights; after a
            proposal that did not look at the observations, the weighted samples.
        ess: effective sample size before resampling.
        resampled: whether the particles were resampled.
        log_evidence: log p(z_t | z_1:t−1), Mathematics (evidence-increment); NaN where a likelihood is not a density.
        nis: weighted mean squared Mahalanobis distance of the joint innovation, NaN without a linearised one.
        rows: its degrees of freedom.
        groups: the observations that were used.
        first_observations: what landmarks were started from.
        new_landmarks: their ids, in that order.
    """

    stamp_ns: int
    mixture: tuple[Prior, Proposed | None, np.ndarray]
    ess: float
    resampled: bool
    log_evidence: float
    nis: float
    rows: int
    groups: Sequence[Observations]
    first_observations: Sequence[NewLandmarks]
    new_landmarks: np.ndarray

    @cached_property
    def estimate(self) -> Estimate:
        """Mean and covariance of the state."""
        return mixture_estimate(*self.mixture)


class Filter:
    """N weighted trajectories, each with its own marginalised part.

    Args:
        motion: p(x_t | x_{t−1}, u_t).
        sensors: what measures; a single Sensor or several.
        conditional: what is marginalised: a LandmarkMap, a KalmanSubstate, both in a list, or nothing.
        proposal: where the particles are sampled; by default EKF-refined with the exact ratio.
        resampler: by default systematic when the effective sample size falls below N/2.
        n: number of particles.
        rng: source of all randomness.
        start: (E,) or (N, E) initial state; by default the identity.
        lag: steps of trajectory kept, None keeps all.
        clouds: keep whole clouds, for backward simulation.
    """

    def __init__(
        self,
        motion: MotionModel,
        sensors: Sensor | Sequence[Sensor],
        conditional: Conditional | Sequence[Conditional] = (),
        proposal: Proposal | None = None,
        resampler: Resampler | None = None,
        n: int = 100,
        rng: np.random.Generator | None = None,
        start: np.ndarray | None = None,
        lag: int | None = None,
        clouds: bool = False,
    ) -> None:
        if n < 1:
            raise InputError(f"a filter needs at least one particle, got {n}")
        if lag is not None and lag < 1:
            raise InputError(f"a fixed lag keeps at least one step, got {lag}")
        self.motion = motion
        self.space = motion.space
        self.sensors = [sensors] if isinstance(sensors, Sensor) else list(sensors)
        parts = [conditional] if isinstance(conditional, Conditional) else list(conditional)
        self.marginals = Marginals(self.space, parts)
        self.proposal = proposal or EkfProposal()
        self.resampler = resampler or EssTriggered(Systematic())
        self.rng = rng or np.random.default_rng()
        origin = self.space.identity() if start is None else np.asarray(start, dtype=float)
        state = checked_start(origin, n, self.space)
        self.particles = Particles(state, uniform_log_weights(n))
        self.lineage = Lineage(n)
        self.marginals.begin(n, self.lineage)
        self.history = History(self.lineage, lag, clouds)
        self.log_evidence = 0.0
        self.stamp_ns: int | None = None
        self.steps = 0

    @property
    def n(self) -> int:
        """Number of particles."""
        return self.particles.n

    def expect(self, control: Any = None, stamp_ns: int | None = None) -> Belief:
        """What `step` would tell the sensors, for looking at a frame before it is filtered; no particle moves."""
        _, dt = self._clock(stamp_ns)
        return Belief(self.particles.log_weights, self._predict(control, dt), self.marginals)

    def step(
        self, frame: Any, control: Any = None, stamp_ns: int | None = None, proposal: Proposal | None = None
    ) -> StepReport:
        """Predicts, observes, refines, weighs, resamples, samples, corrects and updates; then starts landmarks.

        Args:
            frame: what the sensors observe.
            control: what the motion model moves by.
            stamp_ns: time of the frame; by default the previous one plus one second.
            proposal: of this step, where the filter's own would not do.

        Raises:
            InputError: time runs backwards, shapes do not fit, or no particle explains the observations. If the
                error is about what came in before the particles are weighed (time, control, measurements), the
                filter is as it was before the step; otherwise it stands between two steps: `load` a checkpoint.
        """
        stamp_ns, dt = self._clock(stamp_ns)
        prior = self._predict(control, dt)
        groups = self._observe(frame, Belief(self.particles.log_weights, prior, self.marginals))
        proposal = proposal or self.proposal
        proposed = proposal.propose(prior, self.marginals.linearised(prior, groups))
        log_weights, look_ahead = reweight(self.particles.log_weights, proposed.log_w1, f"step {self.steps}")
        mixture: tuple[Prior, Proposed | None, np.ndarray] = (prior, proposed, log_weights)
        weights = np.exp(log_weights)
        ancestors = self.resampler.ancestors(weights, self.rng)
        if ancestors is not None:
            log_weights = uniform_log_weights(self.n)
            prior, groups = self._descend(ancestors, prior, groups)

        parents = np.arange(self.n) if ancestors is None else ancestors
        state, log_w2 = self._sample_and_update(prior, proposed, groups, parents, proposal.exact)
        log_weights, correction = reweight(log_weights, log_w2, f"step {self.steps}")
        self.particles = Particles(state, log_weights)
        if proposed.nis is None:
            mixture = (Prior.exactly(self.space, state), None, log_weights)
        first_observations, new_landmarks = self._start_landmarks(frame, groups)
        normalised = all(group.likelihood is None or group.likelihood.normalised for group in groups)
        evidence = look_ahead + correction if normalised else float("nan")
        self.log_evidence += evidence
        self._end(stamp_ns)
        return StepReport(
            stamp_ns=stamp_ns,
            mixture=mixture,
            ess=effective_sample_size(weights),
            resampled=ancestors is not None,
            log_evidence=evidence,
            nis=float("nan") if proposed.nis is None else float((weights * proposed.nis).sum()),
            rows=proposed.rows,
            groups=groups,
            first_observations=first_observations,
            new_landmarks=new_landmarks,
        )

    def follow(
        self, state: np.ndarray, frame: Any, control: Any = None, stamp_ns: int | None = None
    ) -> np.ndarray:
        """A step along given states (E,) or (N, E): what is marginalised is conditioned on them, p(m | x_0:t, z_1:t).

        Mapping with known poses, or the maps of paths that were drawn elsewhere. The weights stay as they are.

        Returns:
            (N,) log-likelihood of the observations.

        Raises:
            InputError: see `step`, which has the same arguments.
        """
        stamp_ns, dt = self._clock(stamp_ns)
        state = checked_start(np.asarray(state, dtype=float), self.n, self.space)
        prior, log_weights = self._predict(control, dt), self.particles.log_weights
        groups = self._observe(frame, Belief(log_weights, Prior.exactly(self.space, state), self.marginals))
        densities = self.marginals.correct(state, self.space.local(prior.base, state), groups)
        self.particles = Particles(state, log_weights)
        self._start_landmarks(frame, groups)
        self._end(stamp_ns)
        return densities.all

    def estimate(self) -> Estimate:
        """Mean and covariance of the particles as they are."""
        here = Prior.exactly(self.space, self.particles.state)
        return mixture_estimate(here, None, self.particles.log_weights)

    def belief(self) -> Belief:
        """The particles as they are, for reading the map."""
        here = Prior.exactly(self.space, self.particles.state)
        return Belief(self.particles.log_weights, here, self.marginals)

    def save(self, path: Path | str, extra: dict[str, np.ndarray] | None = None) -> None:
        """Writes a checkpoint from which `load` goes on as if nothing had happened, with arrays of the caller's."""
        write_checkpoint(self, Path(path), extra or {})

    def load(self, path: Path | str) -> dict[str, np.ndarray]:
        """Continues from a checkpoint; this filter must have been built with the same models and options.

        Returns:
            The `extra` arrays that were saved.

        Raises:
            InputError: the file is missing, damaged, or belongs to another filter.
        """
        return read_checkpoint(self, Path(path))

    def _clock(self, stamp_ns: int | None) -> tuple[int, float]:
        previous = self.stamp_ns
        if stamp_ns is None:
            stamp_ns = 0 if previous is None else previous + 1_000_000_000
        if previous is not None and stamp_ns < previous:
            raise InputError(
                f"time runs backwards: step {self.steps} has stamp {stamp_ns} ns after {previous} ns"
            )
        return int(stamp_ns), 0.0 if previous is None else (stamp_ns - previous) * 1e-9

    def _predict(self, control: Any, dt: float) -> Prior:
        transition = self.motion.transition(self.particles.state, control, dt)
        what = f"step {self.steps}: {type(self.motion).__name__}.transition"
        checked_transition(transition, self.particles.state, self.space, what)
        return self.marginals.predict(transition, self.space)

    def _observe(self, frame: Any, belief: Belief) -> list[Observations]:
        observed = [
            [checked_observations(group) for group in sensor.observe(frame, belief)]
            for sensor in self.sensors
        ]
        self._ends = list(accumulate(len(groups) for groups in observed))
        return [group for groups in observed for group in groups]

    def _descend(
        self, ancestors: np.ndarray, prior: Prior, groups: list[Observations]
    ) -> tuple[Prior, list[Observations]]:
        self.lineage.advance(checked_ancestors(ancestors, self.n, self.resampler))
        self.marginals.resample(ancestors)
        groups = [
            replace(group, ids=group.ids[ancestors])
            if group.ids is not None and group.ids.ndim == 2
            else group
            for group in groups
        ]
        return prior.take(ancestors), groups

    def _sample_and_update(
        self, prior: Prior, proposed: Proposed, groups: list[Observations], parents: np.ndarray, exact: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """One state for each descendant, and log w₂ = log p(z|x) + log p(x|x⁻) − log q(x) − log w₁."""
        whitened, log_ratio = proposed.sample(parents, self.rng)
        increment = prior.mean + np.einsum("nar,nr->na", prior.factor, whitened)
        state = prior.at(increment)
        densities = self.marginals.correct(state, increment, groups)
        if not exact:
            return state, densities.late
        log_w1 = proposed.log_w1[parents]
        # A parent of weight zero that was not resampled keeps it, whatever its second factor is.
        return state, densities.all + log_ratio - np.where(log_w1 == -np.inf, 0.0, log_w1)

    def _end(self, stamp_ns: int) -> None:
        self.steps += 1
        self.stamp_ns = stamp_ns
        self.history.record(stamp_ns, self.particles.state, self.particles.log_weights)

    def _start_landmarks(
        self, frame: Any, groups: list[Observations]
    ) -> tuple[list[NewLandmarks], np.ndarray]:
        belief = self.belief()
        born, ids, first = list[NewLandmarks](), [np.zeros(0, dtype=np.int64)], 0
        for sensor, end in zip(self.sensors, self._ends, strict=True):
            for new_landmarks in sensor.new_landmarks(frame, belief, groups[first:end]):
                ids.append(belief.map.add(new_landmarks, self.particles.state))
                born.append(new_landmarks)
            first = end
        return born, np.concatenate(ids)
