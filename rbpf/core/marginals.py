"""Conditionals besides maps: a Kalman-filtered substate, nothing (`StateOnly`), and several parts side by side."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar, final

import numpy as np

from rbpf import gaussian
from rbpf.arrays import numbers
from rbpf.core import checkpoint
from rbpf.core.genealogy import Lineage
from rbpf.core.likelihoods import Gaussian
from rbpf.core.linearisation import EVERYTHING, information, linearise, stacked
from rbpf.core.models import NEW, NULL, Belief, Conditional, LineariseAt, LogDensities, Observations, Part, Transition
from rbpf.core.particles import Information, Particles, Prior, mixture_estimate, take
from rbpf.errors import InputError
from rbpf.kernels.dense import log_densities
from rbpf.lie import Array, LieGroup

GAUSSIAN = Gaussian()
Moves = Callable[[float], tuple[np.ndarray, np.ndarray, np.ndarray]]


@final
class StateOnly(Conditional):
    """Observations of the sampled state alone, such as a position fix: S = R, and nothing is stored.

    Raw data are functions of the states (N, E) that give log-likelihoods (N,), see `LikelihoodSensor`.
    """

    supplies = Part.STATE
    takes_raw = True

    def __init__(self, space: LieGroup) -> None:
        self.space = space
        self._ahead = False

    def begin(self, n: int, lineage: Lineage) -> None:
        """Nothing is stored."""

    def information(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Information:
        total = Information.zeros(state.shape[0], self.space.dim)
        self._ahead = not prior.factor.shape[2]
        for group in groups:
            if group.data is not None:
                # Without noise to sample the states are final, and the look-ahead weight is exact.
                if self._ahead:
                    total.log_factor += log_likelihoods(group, state)
                continue
            nu, jacobians = linearise(group.model, self.space, group.z, state[:, None, :])
            assert jacobians.state is not None
            cov = np.broadcast_to(group.cov, (*nu.shape, nu.shape[-1]))
            total.add(information(nu, jacobians.state, cov, group.likelihood or GAUSSIAN, prior))
        return total

    def correct(self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]) -> LogDensities:
        total, raw = np.zeros((2, state.shape[0]))
        for group in groups:
            if group.data is not None:
                raw += log_likelihoods(group, state)
                continue
            name = type(group.model).__name__
            nu = numbers(group.model.innovation(group.z, state[:, None, :]), f"the prediction of {name}")
            if len(nu) == 1:  # the same for all states
                nu = np.repeat(nu, state.shape[0], axis=0)
            if nu.shape != (state.shape[0], *group.z.shape):
                raise InputError(f"{name}: innovations have the shape {nu.shape} for {state.shape[0]} states")
            if group.likelihood is None or group.likelihood.kernel_id == GAUSSIAN.kernel_id:
                chol = gaussian.cholesky(group.cov)
                log_densities(nu, chol, gaussian.log_det(chol), total)
                continue
            cov = np.broadcast_to(group.cov, (*nu.shape, nu.shape[-1]))
            total += group.likelihood.log_density(nu, cov).sum(axis=1)
        return LogDensities(total + raw, np.zeros_like(raw) if self._ahead else raw)

    def resample(self, ancestors: np.ndarray) -> None:
        """Nothing is stored."""

    def moments(self, particles: Particles, of: Part | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        estimate = mixture_estimate(Prior.exactly(self.space, particles.state), None, particles.log_weights)
        return estimate.mean, estimate.cov

    def arrays(self) -> dict[str, np.ndarray]:
        return {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Nothing is stored."""


def log_likelihoods(group: Observations, state: np.ndarray) -> np.ndarray:
    """(N,) of raw data given states (N, E). Raises InputError: there is not one number each, or one is NaN."""
    found = numbers(np.asarray(group.data(state)), "a log-likelihood of the states")  # type: ignore[operator]
    if found.shape != state.shape[:1]:
        raise InputError(f"a log-likelihood of states must be {state.shape[:1]}, got {found.shape}")
    return found


#: Rounding error of a sum of few terms, as a standard deviation: a few times the root of the last digit.
ROUNDING = 8.0 * np.sqrt(np.finfo(float).eps)


@final
class KalmanSubstate(checkpoint.Kept, Conditional):
    """A linear substate s ~ N(ŝ, P) in every particle, given the sampled states.

    The motion model defines how it drives the increment and how it evolves (`Transition`): the increment is then a
    measurement of it, used exactly. Observations may read it together with the state, but not with a landmark.

    Args:
        space: the group of the sampled state.
        mean: (m,) initial mean.
        cov: (m, m) initial covariance, may be singular.
        part: its name, for a second substate another one than Part.SUBSTATE.
        moves: its own dynamics if the motion model does not drive it, such as a sensor's bias: seconds → A (m, m), b (m,)
            and the noise factor (m, r).

    Attributes:
        mean: (N, m) of each particle.
        cov: (N, m, m), or (1, m, m) as long as it does not differ between particles.
    """

    supplies = Part.SUBSTATE
    kept: ClassVar = {"mean": checkpoint.numbers("n", "m"), "cov": checkpoint.numbers("covs", "m", "m")}
    prefix = "substate/"

    def __init__(
        self, space: LieGroup, mean: np.ndarray, cov: np.ndarray, part: Part = Part.SUBSTATE, moves: Moves | None = None
    ) -> None:
        self.space = space
        self.supplies = part
        self.moves = moves
        self._mean = numbers(mean, "the mean of a substate").copy()
        self._cov = numbers(cov, "the cov of a substate").copy()
        if self._cov.shape != (self._mean.size, self._mean.size):
            raise InputError(f"a substate with mean {self._mean.shape} needs a cov of that size, got {self._cov.shape}")
        gaussian.psd_factor(self._cov)

    def begin(self, n: int, lineage: Lineage) -> None:
        self.mean = np.repeat(self._mean[None], n, axis=0)
        self.cov = self._cov[None]

    def predict(self, transition: Transition, space: LieGroup, dt: float) -> Prior | None:
        """Joint distribution of (ε, s_t), Mathematics (joint-substate), stored as s_t | ε; own dynamics know no ε."""
        if self.moves is not None:
            dynamics, drift, factor = self.moves(dt)
            self._increment_mean = np.zeros((1, space.dim))
            self._predicted = self.mean @ dynamics.T + drift
            self._gain = np.zeros((1, self._mean.size, space.dim))
            self._rest = gaussian.symmetrise(dynamics @ self.cov @ dynamics.T + factor @ factor.T)
            return None
        if transition.coupling is None or transition.dynamics is None or transition.drift is None:
            raise InputError("a Kalman substate needs coupling, dynamics and drift of the motion model")
        d, m = space.dim, self._mean.size
        sizes = (transition.coupling.shape[1:], transition.dynamics.shape[1:], transition.drift.shape[1:])
        if sizes != ((d, m), (m, m), (m,)):
            raise InputError(
                f"the substate has {m} numbers: expected coupling (·, {d}, {m}), dynamics (·, {m}, {m}) and "
                f"drift (·, {m}), the motion model gives (·, …) {sizes}"
            )
        count = max(len(transition.coupling), len(transition.dynamics))
        blocks = [
            np.broadcast_to(part, (count, *part.shape[1:])) for part in (transition.coupling, transition.dynamics)
        ]
        stack, noise = np.concatenate(blocks, axis=1), transition.noise_factor
        means = (stack @ self.mean[..., None])[..., 0]
        self._increment_mean = means[:, :d]
        self._predicted = means[:, d:] + transition.drift
        joint = stack @ self.cov @ np.swapaxes(stack, -1, -2) + noise @ np.swapaxes(noise, -1, -2)
        shared = len(joint) == 1  # by all particles
        parts = _kept_parts(joint.tobytes(), d, m) if shared else _split(joint, d)
        factor, self._gain, self._rest = (part.copy() if shared else part for part in parts)
        return Prior(space, transition.mean, self._increment_mean, factor, centred=False)

    def driving(self) -> np.ndarray | None:
        return None if self.moves else self.mean

    def given(self, increment: np.ndarray) -> np.ndarray:
        """Mean (N, m) of s_t given increments (N, d)."""
        offset = increment - self._increment_mean
        return self._predicted + (self._gain @ offset[..., None])[..., 0]

    def information(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Information:
        """All rows that read the substate are stacked: they are correlated through it."""
        increment = self.space.local(prior.base, state)
        nu, jac, noise = self._rows(state, self.given(increment), groups)
        slope = self.space.right_jacobian_inverse(increment)
        jac_state = jac[..., : self.space.dim] + jac[..., self.space.dim :] @ self._gain @ slope
        jac_sub = jac[..., self.space.dim :]
        cov = gaussian.symmetrise(jac_sub @ self._rest @ np.swapaxes(jac_sub, -1, -2)) + noise
        return information(nu[:, None], jac_state[:, None], cov[:, None], GAUSSIAN, prior)

    def correct(self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]) -> LogDensities:
        self.mean, self.cov = self.given(increment), self._rest
        total = np.zeros(state.shape[0])
        if groups:
            nu, jac, noise = self._rows(state, self.mean, groups)
            jac = jac[..., self.space.dim :]
            cov = gaussian.symmetrise(jac @ self.cov @ np.swapaxes(jac, -1, -2)) + noise
            total = gaussian.log_density(nu, cov)
            gain = self.cov @ np.swapaxes(jac, -1, -2) @ gaussian.inverse(cov)
            self.mean = self.mean + np.einsum("nij,nj->ni", gain, nu)
            closed = np.eye(self._mean.size) - gain @ jac
            self.cov = gaussian.symmetrise(
                closed @ self.cov @ np.swapaxes(closed, -1, -2) + gain @ noise @ np.swapaxes(gain, -1, -2)
            )
        return LogDensities(total, np.zeros_like(total))

    def resample(self, ancestors: np.ndarray) -> None:
        self._increment_mean = take(self._increment_mean, ancestors)
        self._predicted = self._predicted[ancestors]
        self._gain = take(self._gain, ancestors)
        self._rest = take(self._rest, ancestors)

    def moments(self, particles: Particles, of: Part | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return gaussian.mixture_moments(particles.weights, self.mean, self.cov)

    def options(self) -> dict[str, object]:
        return {"substate size": int(self._mean.size)}

    def restore(self, arrays: Mapping[str, np.ndarray], **sizes: int) -> None:
        n, m = self.mean.shape
        super().restore(arrays, n=n, m=m)
        if len(self.cov) not in (1, n):
            raise InputError(f"the array substate/cov must have 1 or {n} matrices")

    def _rows(self, state: Array, substate: Array, groups: Sequence[Observations]) -> tuple[Array, Array, Array]:
        nus, jacs, noises = [], [], []
        for group in groups:
            if group.likelihood is not None and group.likelihood.kernel_id != 0:
                raise InputError(
                    f"{type(group.model).__name__} reads the substate: its likelihood must be Gaussian, "
                    f"not {type(group.likelihood).__name__}"
                )
            nu, jacobians = linearise(group.model, self.space, group.z, state[:, None], None, None, substate[:, None])
            assert jacobians.substate is not None
            by_state = np.zeros((1, 1, 1, 1)) if jacobians.state is None else jacobians.state
            blocks = ((by_state, self.space.dim), (jacobians.substate, substate.shape[1]))
            jac = np.concatenate([np.broadcast_to(block, (*nu.shape, size)) for block, size in blocks], axis=-1)
            nus += list(np.moveaxis(nu, 1, 0))
            jacs += list(np.moveaxis(jac, 1, 0))
            noises += list(group.cov)
        return stacked(nus, jacs, noises, [None] * len(nus))


def _split(joint: Array, d: int) -> tuple[Array, Array, Array]:
    """From the joint covariance (…, d + m, d + m) of (ε, s): a factor of cov ε, and gain and covariance of s | ε."""
    of_increment, m = joint[:, :d, :d], joint.shape[-1] - d
    factor = gaussian.psd_factor(gaussian.symmetrise(of_increment))
    gain = joint[:, d:, :d] @ np.linalg.pinv(of_increment, hermitian=True)
    # The closed form stays positive semi-definite under rounding.
    closed = np.concatenate([-gain, np.broadcast_to(np.eye(m), (len(joint), m, m))], axis=2)
    rest = gaussian.symmetrise(closed @ joint @ np.swapaxes(closed, -1, -2))
    # If the increment determines a component exactly, cancellation leaves rounding errors, which the next inverse would
    # treat as information. They are small relative to the cancelling terms, in each component's unit.
    terms = np.abs(closed) @ np.sqrt(np.diagonal(joint, axis1=1, axis2=2))[..., None]
    scale = np.where(terms > 0.0, ROUNDING * terms, 1.0)
    values, vectors = np.linalg.eigh(rest / scale / np.swapaxes(scale, -1, -2))
    if (values <= 1.0).any():
        half = scale * vectors * np.sqrt(np.where(values > 1.0, values, 0.0))[:, None]
        rest = half @ np.swapaxes(half, -1, -2)
    return factor, gain, rest


@lru_cache(maxsize=64)
def _kept_parts(joint: bytes, d: int, m: int) -> tuple[Array, Array, Array]:
    # With equal time steps the recursion becomes stationary, bit by bit.
    return _split(np.frombuffer(joint).reshape(1, d + m, d + m), d)


@final
class Marginals(Conditional):
    """Several marginalised parts side by side; each observation goes to the part that it reads.

    A substate and a map together are exact only if no observation reads both.
    """

    supplies = Part.STATE

    def __init__(self, space: LieGroup, parts: Sequence[Conditional]) -> None:
        self.space = space
        self.parts = {part.supplies: part for part in (StateOnly(space), *parts)}
        self._holder = dict(self.parts)
        for part in parts:
            self._holder |= dict.fromkeys(part.also, part)
        held = [part.supplies for part in parts] + [other for part in parts for other in part.also - {Part.STATE}]
        twice = sorted({part for part in held if held.count(part) > 1})
        if twice or not isinstance(self.parts[Part.STATE], StateOnly):
            raise InputError(
                f"two parts of the filter are named {(twice or [Part.STATE])[0]!r}: give one of them another name, "
                "as LandmarkMap(…, part=Part('beacons')), or hold both in one"
            )

    def begin(self, n: int, lineage: Lineage) -> None:
        for part in self.parts.values():
            part.begin(n, lineage)

    def predict(self, transition: Transition, space: LieGroup, dt: float) -> Prior:
        """Predicts every part; the increment is distributed by the transition, or by the part that drives the motion."""
        found: Prior | None = None
        for name, part in self.parts.items():
            prior = part.predict(transition, space, dt)
            if prior is not None and found is not None:
                raise InputError(f"{name} is a second part that drives the motion: hold them in one substate")
            found = found or prior
        if found is not None:
            return found
        if transition.coupling is not None and transition.coupling.shape[-1]:
            raise InputError("the motion model drives a substate: give the filter a KalmanSubstate to hold it")
        return Prior(space, transition.mean, np.zeros((1, space.dim)), transition.noise_factor)

    def decided(self, groups: Sequence[Observations], belief: Belief) -> list[Observations]:
        """Each group by the part that it belongs to, in the groups' order."""
        found = dict[int, Observations]()
        for supplies, routed in self._routed(groups).items():
            found |= zip(map(id, routed), self.parts[supplies].decided(routed, belief), strict=True)
        return [found[id(group)] for group in groups]

    def information(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Information:
        by_part = {supplies: routed for supplies, routed in self._routed(groups).items() if routed}
        found = [self.parts[supplies].information(state, routed, prior) for supplies, routed in by_part.items()]
        total = found[0] if found else Information.zeros(state.shape[0], self.space.dim)
        for other in found[1:]:
            total.add(other)
        return total

    def linearised(self, prior: Prior, groups: Sequence[Observations]) -> LineariseAt:
        """The observations' information about the state, as a function of the linearisation point."""
        # Inliers for the update are also those of the look-ahead weight, unless a likelihood overrides `of_look_ahead`.
        ahead = [group.likelihood and group.likelihood.of_look_ahead() for group in groups]
        is_other = any(likelihood is not group.likelihood for likelihood, group in zip(ahead, groups, strict=True))

        def linearise_at(increment: np.ndarray) -> Information:
            is_mean = increment is prior.mean
            state = prior.predicted() if is_mean else prior.at(increment)
            found = self.information(state, groups, prior)
            if is_other:
                weighing = [replace(group, likelihood=other) for other, group in zip(ahead, groups, strict=True)]
                others = self.information(state, weighing, prior), _all_outliers(weighing, found)
                found = replace(found, otherwise=tuple(other for other in others if other is not None))
            if is_mean and prior.centred:
                return found
            return found.charted(prior.space.right_jacobian(increment), increment - prior.mean)

        return linearise_at

    def correct(self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]) -> LogDensities:
        routed = self._routed(groups)
        found = [self.parts[supplies].correct(state, increment, own) for supplies, own in routed.items()]
        zeros = np.zeros(state.shape[0])
        return LogDensities(*(sum(terms, zeros) for terms in zip(*found, strict=True)))

    def resample(self, ancestors: np.ndarray) -> None:
        for part in self.parts.values():
            part.resample(ancestors)

    def driving(self) -> np.ndarray | None:
        return next((mean for part in self.parts.values() if (mean := part.driving()) is not None), None)

    def consolidate(self, particles: Particles) -> Particles:
        """Of the only part: separate Gaussians could not hold the correlation between parts that the particles represent."""
        parts = [part for part in self.parts.values() if not isinstance(part, StateOnly)]
        if len(parts) != 1:
            raise InputError(f"consolidation needs one Gaussian: give the filter one conditional, not {len(parts)}")
        return parts[0].consolidate(particles)

    def arrays(self) -> dict[str, np.ndarray]:
        """By name; arrays of a part with a name of its own have that name as prefix."""
        parts = self.parts.items()
        return {prefix(of) + name: array for of, part in parts for name, array in part.arrays().items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        for of, part in self.parts.items():
            own = prefix(of)
            part.restore({name.removeprefix(own): array for name, array in arrays.items() if name.startswith(own)})

    def options(self) -> dict[str, object]:
        parts = self.parts.items()
        return {prefix(of) + name: value for of, part in parts for name, value in part.options().items()}

    def _routed(self, groups: Sequence[Observations]) -> dict[Part, list[Observations]]:
        routed: dict[Part, list[Observations]] = {supplies: [] for supplies in self.parts}
        for group in groups:
            holder = self._holder_of(group)
            if group.data is not None and not holder.takes_raw:
                raise InputError(f"{type(holder).__name__} takes no raw data, only rows with an observation model")
            routed[holder.supplies].append(group)
        return routed

    def _holder_of(self, group: Observations) -> Conditional:
        wanted = {group.part} if group.part is not None else group.model.reads - {Part.STATE} or {Part.STATE}
        holders = {self._holder.get(part) for part in wanted}
        if len(holders) > 1:
            raise InputError(
                f"{type(group.model).__name__} reads a landmark and the substate, which couples them: "
                "sample that part of the substate instead, or hold both in a JointMap"
            )
        holder = holders.pop()
        if holder is None:
            what = "raw data are for" if group.data is not None else f"{type(group.model).__name__} reads"
            raise InputError(f"{what} a {next(iter(wanted))}, which this filter does not hold")
        return holder


def prefix(part: Part) -> str:
    """Prefix of a part's arrays in a checkpoint: empty for the three standard parts."""
    return "" if part in EVERYTHING else f"{part}/"


def _all_outliers(groups: Sequence[Observations], like: Information) -> Information | None:
    """The information if all measurements are outliers, or None if a likelihood has no outliers."""
    weigh = [group for group in groups if Part.STATE in group.updates]
    if any(group.likelihood is None or group.likelihood.kernel_id != 3 for group in weigh):
        return None
    nothing = Information.zeros(like.quad.size, like.vector.shape[1])
    for group in weigh:
        ids = np.zeros(group.z.shape[0]) if group.ids is None else group.ids
        assert group.likelihood is not None
        for chosen, log_density in (
            (ids >= 0, group.likelihood.log_outlier()),
            (ids == NEW, group.log_new),
            (ids == NULL, group.log_clutter),
        ):
            nothing.log_factor += chosen.sum(axis=-1) * log_density
    return nothing
