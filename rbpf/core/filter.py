"""The Rao-Blackwellised particle filter: one step, for every variant.

    p(x_0:t, m | z_1:t, u_1:t) ≈ Σ_i w_i δ(x_0:t − x_0:t^i) p(m | x_0:t^i, z_1:t)        Mathematics (posterior)

The bootstrap filter, FastSLAM 2.0 and the exact importance ratio, Mathematics (correction), differ in the proposal.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import numpy as np

from rbpf import gaussian
from rbpf.arrays import numbers
from rbpf.core import checkpoint
from rbpf.core.diagnostics import Health
from rbpf.core.genealogy import History, Lineage
from rbpf.core.marginals import Marginals
from rbpf.core.models import (
    Belief,
    Conditional,
    MotionModel,
    Observations,
    Part,
    Proposal,
    Resampler,
    Sensor,
    Transition,
    draws,
)
from rbpf.core.particles import (
    Estimate,
    Particles,
    Prior,
    Proposed,
    SecondWeight,
    effective_sample_size,
    mixture_estimate,
    reweight,
    take,
    uniform_log_weights,
)
from rbpf.core.proposals import EkfProposal
from rbpf.core.resampling import Consolidation, EssTriggered, Systematic
from rbpf.errors import InputError
from rbpf.lie import Array, LieGroup
from rbpf.ranges import require_memory


@dataclass(frozen=True, eq=False)
class StepReport:
    """The results of one step."""

    stamp_ns: int  #: time of the step.
    #: the refined mixture before sampling, with its log-weights; after a proposal that does not use the observations, the
    #: weighted samples.
    mixture: tuple[Prior, Proposed | None, np.ndarray]
    #: the samples, with their weights before and after the second weight; None if the mixture consists of them.
    second: SecondWeight | None
    ess: float  #: effective sample size before resampling.
    resampled: bool  #: whether the particles were resampled or consolidated in this step.
    #: log p(z_t | z_1:t−1), Mathematics (evidence-increment). NaN if a likelihood is not normalised, or if landmark
    #: observations updated only the state or only the landmarks without another group of the same measurements for the
    #: other: their product is then not a density of the measurements.
    log_evidence: float
    #: normalised innovation squared, NaN without linearisation: the squared Mahalanobis distance of the joint innovation of
    #: the rows used, a weighted mean over the particles.
    nis: float
    #: its degrees of freedom, the weighted mean number of those rows. A particle does not use rows that it does not
    #: associate with a known landmark, or that the likelihood gates as outliers.
    rows: float
    groups: Sequence[Observations]  #: the observations that were used.
    new_landmarks: np.ndarray  #: ids of the landmarks initialised in this step.

    @cached_property
    def estimate(self) -> Estimate:
        """Mean and covariance of the state by both weights, Mathematics (summary)."""
        return mixture_estimate(*self.mixture, self.second)


class Filter:
    """N weighted trajectories, each with its own marginalised part.

    Args:
        motion: p(x_t | x_{t−1}, u_t).
        sensors: a single Sensor or several.
        conditional: what is marginalised: a LandmarkMap, a KalmanSubstate, parts of your own, several in a list, or nothing.
        proposal: the proposal distribution; by default EKF-refined with the exact importance ratio.
        resampler: by default systematic when the effective sample size falls below N/2.
        n: number of particles.
        rng: source of all randomness.
        start: (E,) or (N, E) initial state; by default the identity.
        lag: steps of trajectory kept, None keeps all.
        clouds: keep whole clouds, for backward simulation.
        consolidation: when the spread of the particles is merged into a conditional that supports it; they are then never
            resampled. Stored paths end there: use a lag of one step. States are in a frame chosen by the conditional.

    Attributes:
        health: monitor for signs of divergence; `health.findings` holds its warnings.
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
        consolidation: Consolidation | None = None,
    ) -> None:
        if n < 1:
            raise InputError(f"a filter needs at least one particle, got {n}")
        if lag is not None and lag < 1:
            raise InputError(f"a fixed lag keeps at least one step, got {lag}")
        # Ancestry, states, and a few matrices of the state's size per particle.
        require_memory(8.0 * n * (40 + 4 * motion.space.dim**2), f"a filter of {n} particles")
        self.motion = motion
        self.space = motion.space
        self._draws = draws(motion)
        if not self._draws and type(motion).transition is MotionModel.transition:
            raise InputError(f"{type(motion).__name__} does not move: override transition, sample, or both")
        self.sensors = [sensors] if isinstance(sensors, Sensor) else list(sensors)
        parts = [conditional] if isinstance(conditional, Conditional) else list(conditional)
        self.marginals = Marginals(self.space, parts)
        self.proposal = proposal or EkfProposal()
        self.resampler = resampler or EssTriggered(Systematic())
        self.consolidation = consolidation
        self._age = 0
        self.rng = rng or np.random.default_rng()
        origin = self.space.identity() if start is None else np.asarray(start, dtype=float)
        state = checked_start(origin, n, self.space)
        self.particles = Particles(state, uniform_log_weights(n))
        self.lineage = Lineage(n)
        self.marginals.begin(n, self.lineage)
        self.history = History(self.lineage, lag, clouds)
        self.health = Health(n, self.space)
        self.log_evidence = 0.0
        self.stamp_ns: int | None = None
        self.steps = 0

    @property
    def n(self) -> int:
        return self.particles.n

    def expect(self, control: object = None, stamp_ns: int | None = None) -> Belief:
        """The predicted belief that `step` would pass to the sensors, without changing the filter."""
        _, dt = self._clock(stamp_ns)
        before = self.rng.bit_generator.state
        prior = self._predict(control, dt)
        self.rng.bit_generator.state = before
        return Belief(self.particles.log_weights, prior, self.marginals.parts, self.rng)

    def step(
        self, frame: object, control: object = None, stamp_ns: int | None = None, proposal: Proposal | None = None
    ) -> StepReport:
        """Predicts, observes, refines, weighs, resamples, samples, updates the map and the weights; then adds new landmarks.

        A consolidation replaces resampling; if it is due, it also follows the step.

        Args:
            frame: what the sensors observe.
            control: control input of the motion model.
            stamp_ns: time of the frame; by default the previous one plus one second.
            proposal: for this step, instead of the filter's own.

        Raises InputError: time runs backwards, shapes do not fit, or no particle explains the observations. After an error
        about the inputs, before the particles are weighed (time, control, measurements), the filter is unchanged; after
        others it is in an intermediate state: `load` a checkpoint.
        """
        proposal = proposal or self.proposal
        with _unchanged_by_failure(self):
            # Predict, and observe given the prediction.
            stamp_ns, dt = self._clock(stamp_ns)
            prior = self._predict(control, dt)
            groups = self._observe(frame, Belief(self.particles.log_weights, prior, self.marginals.parts, self.rng))

            # Refine the proposal, and weigh by the look-ahead w₁.
            proposed = proposal.propose(prior, self.marginals.linearised(prior, groups), self.rng)
            log_weights, look_ahead = reweight(self.particles.log_weights, proposed.log_w1, f"step {self.steps}")
        mixture: tuple[Prior, Proposed | None, np.ndarray] = (prior, proposed, log_weights)
        weights = np.exp(log_weights)

        # Consolidate before this step if the particles have degenerated with respect to its observations, and repeat the
        # prediction: the observations are independent of the map's frame.
        ancestors, consolidated = None, False
        if self.consolidation is None:
            ancestors = self.resampler.ancestors(weights, self.rng)
        elif self._age and self.consolidation.is_due(0, weights):
            self.consolidate()
            consolidated = True
            prior = self._predict(control, dt)
            proposed = proposal.propose(prior, self.marginals.linearised(prior, groups), self.rng)
            log_weights, look_ahead = reweight(self.particles.log_weights, proposed.log_w1, f"step {self.steps}")
            mixture, weights = (prior, proposed, log_weights), np.exp(log_weights)

        # Resample if it is due: descendants inherit from their ancestors, including per-particle associations.
        if ancestors is not None:
            fits = ancestors.dtype.kind in "iu" and ancestors.shape == (self.n,)
            if not fits or ancestors.min() < 0 or ancestors.max() >= self.n:
                name = type(self.resampler).__name__
                raise InputError(f"{name} must return {self.n} ancestors in 0..{self.n - 1}, got {ancestors}")
            log_weights = uniform_log_weights(self.n)
            self.lineage.advance(ancestors)
            self.marginals.resample(ancestors)
            if self._draws and proposed.nis is None:
                # `MotionModel.sample` did not depend on the observations: each descendant draws its own sample.
                self.particles = Particles(take(self.particles.state, ancestors), log_weights)
                prior = self._predict(control, dt)
            else:
                prior = prior.take(ancestors)
            groups = [
                replace(group, ids=group.ids[ancestors]) if group.ids is not None and group.ids.ndim == 2 else group
                for group in groups
            ]

        # Sample one state for each descendant from its parent's Gaussian, and update the marginalised parts.
        inherited = proposed if ancestors is None else proposed.take(ancestors)
        balance = None
        if self.consolidation is not None:
            balance = weights, self.space.local(prior.base[0], prior.base)
        whitened, log_ratio = inherited.sample(self.n, self.rng, balance)
        increment = prior.moved(whitened)
        state = prior.at(increment)
        densities = self.marginals.correct(state, increment, groups)

        # Correct by log w₂ = log p(z|x) + log p(x|x⁻) − log q(x) − log w₁.
        log_w2 = densities.after_sampling
        if proposal.exact:
            # A parent of weight zero that was not resampled keeps it, whatever its second weight is.
            log_w2 = densities.all + log_ratio
            np.subtract(log_w2, inherited.log_w1, out=log_w2, where=inherited.log_w1 != -np.inf)
        log_before = log_weights
        log_weights, correction = reweight(log_weights, log_w2, f"step {self.steps}")
        self.particles = Particles(state, log_weights)
        second = None
        if proposed.nis is None:
            mixture = Prior.exactly(self.space, state), None, log_weights
        else:
            second = SecondWeight(state, log_before, log_weights)

        # Initialise landmarks, monitor for divergence, and report.
        new_landmarks = self._start_landmarks(frame, groups)
        evidence = look_ahead + correction if are_explained(groups) else float("nan")
        self.log_evidence += evidence
        ess = effective_sample_size(weights)
        nis = float("nan") if proposed.nis is None else float((weights * proposed.nis).sum())
        rows = 0.0
        if proposed.rows is not None:
            # A weighted mean, exact if all are equal.
            rows = float(proposed.rows[0] + (weights * (proposed.rows - proposed.rows[0])).sum())
        if groups:
            self.health.innovations(self.steps, nis, rows, ess)
            if not (rows > 0.0 and np.isfinite(nis)):
                # Only without innovations: evidence also falls when the uncertainty rightly grows.
                self.health.evidence(self.steps, evidence / max(sum(group.z.size for group in groups), 1))
        if ancestors is not None:
            self.health.descendants(self.steps, ancestors)
        # Copies still coincide if `sample` ran before resampling, or if the motion has no noise (a zero time step).
        if self.consolidation is None and (ancestors is None if self._draws else prior.factor.any()):
            self.health.states(self.steps, state)
        self._end(stamp_ns)
        if self.consolidation is not None:
            self._age += 1
            if self.consolidation.is_due(self._age, self.particles.weights):
                self.consolidate()
        return StepReport(
            stamp_ns=stamp_ns,
            mixture=mixture,
            second=second,
            ess=ess,
            resampled=ancestors is not None or consolidated,
            log_evidence=evidence,
            nis=nis,
            rows=rows,
            groups=groups,
            new_landmarks=new_landmarks,
        )

    def follow(self, state: Array, frame: object, control: object = None, stamp_ns: int | None = None) -> Array:
        """A step along given states (E,) or (N, E): conditions the marginalised parts on them, p(m | x_0:t, z_1:t).

        For mapping with known poses, or the maps of paths that were sampled elsewhere. The weights are unchanged. Arguments
        and errors as of `step`; returns the log-likelihood (N,) of the observations.
        """
        if self._draws:
            raise InputError(f"follow needs Gaussian increments, but {type(self.motion).__name__} draws: see `sample`")
        stamp_ns, dt = self._clock(stamp_ns)
        state = checked_start(np.asarray(state, dtype=float), self.n, self.space)
        prior, log_weights = self._predict(control, dt), self.particles.log_weights
        groups = self._observe(
            frame, Belief(log_weights, Prior.exactly(self.space, state), self.marginals.parts, self.rng)
        )
        densities = self.marginals.correct(state, self.space.local(prior.base, state), groups)
        self.particles = Particles(state, log_weights)
        self._start_landmarks(frame, groups)
        self._end(stamp_ns)
        return densities.all

    def estimate(self) -> Estimate:
        here = Prior.exactly(self.space, self.particles.state)
        return mixture_estimate(here, None, self.particles.log_weights)

    def belief(self) -> Belief:
        """The current belief, for reading the map."""
        here = Prior.exactly(self.space, self.particles.state)
        return Belief(self.particles.log_weights, here, self.marginals.parts, self.rng)

    def save(self, path: Path | str, extra: dict[str, np.ndarray] | None = None) -> None:
        """Writes a checkpoint from which `load` continues identically, with additional arrays of the caller."""
        held = self.arrays() | {f"extra/{name}": array for name, array in (extra or {}).items()}
        checkpoint.write_checkpoint(Path(path), held, self._fingerprint(), self.rng.bit_generator.state)

    def load(self, path: Path | str) -> dict[str, np.ndarray]:
        """Continues from a checkpoint, in a filter built with the same models and options; returns the `extra` arrays.

        Raises InputError: the file is missing, damaged, or belongs to another filter.
        """
        arrays, rng_state = checkpoint.read_checkpoint(Path(path), self._fingerprint())
        with _unchanged_by_failure(self), checkpoint.fitting(Path(path)):
            self.restore(arrays)
            self.rng.bit_generator.state = rng_state
        return {name.removeprefix("extra/"): array for name, array in arrays.items() if name.startswith("extra/")}

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a checkpoint; the state of the random generator is stored separately."""
        return {
            "particles/state": self.particles.state,
            "particles/log_weights": self.particles.log_weights,
            "filter/numbers": np.array([self.steps, -1 if self.stamp_ns is None else self.stamp_ns]),
            "filter/started": np.array(self.stamp_ns is not None),
            "filter/log_evidence": np.array(self.log_evidence),
            **({} if self.consolidation is None else {"filter/age": np.array(self._age)}),
            **self.lineage.arrays(),
            **self.history.arrays(),
            **self.marginals.arrays(),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`. Raises InputError: an array does not fit; the filter is then in an intermediate state."""
        schema = {
            "particles/state": checkpoint.elements(self.space, "n"),
            "particles/log_weights": checkpoint.numbers("n", values="log"),
            "filter/numbers": checkpoint.integers(2),
            "filter/started": checkpoint.truths(),
            "filter/log_evidence": checkpoint.numbers(values="any"),
        }
        if self.consolidation is not None:
            schema["filter/age"] = checkpoint.integers(least=0)
        state, log_weights, counted, started, evidence, *age = checkpoint.read(arrays, schema, n=self.n).values()
        if abs(np.logaddexp.reduce(log_weights)) > 1e-6:
            raise InputError("the particles' weights do not sum to 1")
        lineage = Lineage(self.n)
        lineage.restore(arrays)
        history = History(lineage, self.history.lag, self.history.clouds)
        history.restore(arrays, self.particles.state.shape[1])
        self.lineage, self.history = lineage, history
        self.marginals.begin(self.n, lineage)
        self.marginals.restore(arrays)
        self.particles = Particles(state, log_weights)
        steps, stamp = counted.tolist()
        if steps < 0:
            raise InputError(f"the array filter/numbers counts {steps} steps")
        self.steps, self.stamp_ns = steps, stamp if started else None
        self.log_evidence = float(evidence)
        if age:
            self._age = int(age[0])

    def _fingerprint(self) -> dict[str, object]:
        return {
            "particles": self.n,
            "motion": type(self.motion).__name__,
            "state size": self.space.size,
            "proposal": type(self.proposal).__name__,
            "resampler": type(self.resampler).__name__,
            "conditional": [type(part).__name__ for part in self.marginals.parts.values()],
            "lag": self.history.lag,
            "clouds": self.history.clouds,
            "consolidation": None if self.consolidation is None else repr(self.consolidation),
            **self.marginals.options(),
            "random generator": type(self.rng.bit_generator).__name__,
        }

    def _clock(self, stamp_ns: int | None) -> tuple[int, float]:
        previous = self.stamp_ns
        if stamp_ns is None:
            stamp_ns = 0 if previous is None else previous + 1_000_000_000
        if previous is not None and stamp_ns < previous:
            raise InputError(f"time runs backwards: step {self.steps} has stamp {stamp_ns} ns after {previous} ns")
        return int(stamp_ns), 0.0 if previous is None else (stamp_ns - previous) * 1e-9

    def _predict(self, control: object, dt: float) -> Prior:
        state, what = self.particles.state, f"step {self.steps}: {type(self.motion).__name__}"
        if self._draws:
            drawn = numbers(self.motion.sample(state, control, dt, self.rng), f"{what}.sample")
            if drawn.shape != state.shape or not np.isfinite(drawn).all():
                raise InputError(f"{what}.sample must return {state.shape} finite numbers, got {drawn.shape}")
            state = np.ascontiguousarray(drawn)
        substate = self.marginals.driving()
        if substate is None:
            transition = self.motion.transition(state, control, dt)
        else:
            transition = self.motion.transition_given(state, substate, control, dt)
        transition = checked_transition(transition, state, self.space, f"{what}.transition")
        return self.marginals.predict(transition, self.space, dt)

    def _observe(self, frame: object, belief: Belief) -> list[Observations]:
        observed = []
        for sensor in self.sensors:
            groups = [checked_observations(group) for group in sensor.observe(frame, told(belief, sensor))]
            if sensor.part != Part.LANDMARK:
                # The landmark ids of its groups refer to its own map.
                its = [group.part is None and Part.LANDMARK in group.model.reads for group in groups]
                groups = [replace(g, part=sensor.part) if own else g for g, own in zip(groups, its, strict=True)]
            observed.append(groups)
        self._ends = list(accumulate(len(groups) for groups in observed))
        return self.marginals.decided([group for groups in observed for group in groups], belief)

    def consolidate(self) -> None:
        """Merges the spread of the particles into the marginalised part now, whether it is due or not."""
        self.particles = self.marginals.consolidate(self.particles)
        self._age = 0

    def _end(self, stamp_ns: int) -> None:
        self.steps += 1
        self.stamp_ns = stamp_ns
        self.history.record(stamp_ns, self.particles.state, self.particles.log_weights)

    def _start_landmarks(self, frame: object, groups: list[Observations]) -> np.ndarray:
        ids, first = [np.zeros(0, dtype=np.int64)], 0
        if all(type(sensor).new_landmarks is Sensor.new_landmarks for sensor in self.sensors):
            return ids[0]
        belief = self.belief()
        for sensor, end in zip(self.sensors, self._ends, strict=True):
            its = told(belief, sensor)
            for new_landmarks in sensor.new_landmarks(frame, its, groups[first:end]):
                ids.append(its.map.add(new_landmarks, self.particles.state))
            first = end
        return np.concatenate(ids)


@contextmanager
def _unchanged_by_failure(of: Filter) -> Iterator[None]:
    """Restores a filter's attributes after an InputError; the step must not have modified them in place."""
    held = [(item, dict(vars(item))) for item in (of, *of.marginals.parts.values())]
    generator, state = of.rng.bit_generator, of.rng.bit_generator.state
    try:
        yield
    except InputError:
        for item, attributes in held:
            vars(item).clear()
            vars(item).update(attributes)
        generator.state = state
        raise


def are_explained(groups: Sequence[Observations]) -> bool:
    """Whether the weights include the predictive density of all of a step's measurements, each exactly once.

    Measurements with one group for the state and another one for the landmarks are complete.
    """
    if not all(group.normalised and (group.likelihood is None or group.likelihood.normalised) for group in groups):
        return False
    halves = [group for group in groups if Part.LANDMARK in group.model.reads and len(group.updates) == 1]
    rest = [half for half in halves if Part.STATE not in half.updates]
    return len(halves) == 2 * len(rest) and all(
        any(are_same(half, other) for other in rest) for half in halves if Part.STATE in half.updates
    )


def are_same(one: Observations, other: Observations) -> bool:
    """Whether two groups have the same measurements, whatever they update."""
    rows = {name: getattr(one, name) for name in ("z", "cov", "ids", "log_odds")}
    alike = vars(replace(other, **rows, updates=one.updates)) == vars(one)
    return alike and all(np.array_equal(array, getattr(other, name)) for name, array in rows.items())


def told(belief: Belief, sensor: Sensor) -> Belief:
    """The belief for a sensor, with the map that holds its landmarks."""
    return belief if sensor.part == Part.LANDMARK else replace(belief, landmarks=sensor.part)


def checked_transition(transition: Transition, state: np.ndarray, space: LieGroup, what: str) -> Transition:
    """A validated transition for the kernels. Raises InputError: mean or noise factor has a wrong shape or is not finite."""
    changed = {}
    for name, array in vars(transition).items():
        if array is not None and (checked := numbers(array, f"{what}: {name}")) is not array:
            changed[name] = checked
    if changed:
        transition = replace(transition, **changed)
    mean, factor, n = transition.mean, transition.noise_factor, state.shape[0]
    rows = space.dim + (0 if transition.coupling is None else transition.coupling.shape[-1])
    fits = factor.ndim == 3 and factor.shape[0] in (1, n) and factor.shape[1] == rows
    if mean.shape != state.shape or not fits:
        raise InputError(
            f"{what} returned mean {mean.shape} and noise_factor {factor.shape}: "
            f"expected {state.shape} and ({n} or 1, {rows}, r)"
        )
    if not (np.isfinite(mean).all() and np.isfinite(factor).all()):
        raise InputError(f"{what} returned NaN or infinity: check the control")
    return transition


def checked_observations(group: Observations) -> Observations:
    """A validated group for the kernels. Raises InputError: z or cov has a wrong shape, is not finite, or not a covariance."""
    if group.data is not None:
        return group
    name, ids = type(group.model).__name__, group.ids
    if ids is not None and ids.dtype.kind in "iu":
        ids = np.require(ids, np.int64, ["C", "W"])
    z, cov = numbers(group.z, f"z of {name}"), numbers(group.cov, f"cov of {name}")
    if not (z is group.z and cov is group.cov and ids is group.ids):
        group = replace(group, z=z, cov=cov, ids=ids)
    count, p = group.z.shape[0], group.model.dim
    if group.z.shape != (count, p) or group.cov.shape != (count, p, p):
        raise InputError(
            f"{name} measures {p} numbers: expected z (K, {p}) and cov (K, {p}, {p}), "
            f"got {group.z.shape} and {group.cov.shape}"
        )
    updates = group.updates
    if not (isinstance(updates, frozenset) and updates and updates <= {Part.STATE, Part.LANDMARK}):
        raise InputError(f"observations of {name} inform a frozenset of Part.STATE, Part.LANDMARK or both: {updates}")
    if Part.STATE not in updates and Part.LANDMARK not in group.model.reads:
        raise InputError(f"{name} reads no landmark: its observations must inform Part.STATE")
    if not (np.isfinite(group.z).all() and np.isfinite(group.cov).all()):
        raise InputError(f"a measurement of {name} or its covariance is not finite")
    try:
        gaussian.psd_factor(group.cov)
    except InputError as error:
        raise InputError(f"the noise covariance of {name} is not valid: {error}") from error
    return group


def checked_start(start: np.ndarray, n: int, space: LieGroup) -> np.ndarray:
    """States (N, E) from one for all particles or one each. Raises InputError: another shape, or not finite."""
    size = space.size
    if start.shape not in ((size,), (n, size)) or not np.isfinite(start).all():
        what = f"start must be ({size},) or ({n}, {size}) finite numbers"
        raise InputError(f"{what}, got {start.shape}: {start.tolist()}")
    return np.array(np.broadcast_to(start, (n, size)), order="C")
