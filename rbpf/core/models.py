"""All abstract classes that users subclass, and the data that these classes exchange.

One step of the filter: a `MotionModel` predicts; each `Sensor` turns the frame into `Observations`, given the `Belief`; the
marginalised parts (`Conditional`: a landmark `Map`, a Kalman substate) compute their information about the motion; a
`Proposal` refines and weighs the particles with it; a `Resampler` chooses their descendants; the `Conditional` is updated.
`Observations` have an `ObservationModel`, possibly of a `Landmark`, and are weighed by a `Likelihood`.

Shapes: N particles, K observations, E state storage, d its tangent, m linear substate, D landmark, A its constants,
C components, p measurement, r noise rank. Methods that are not abstract are hooks with a default.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import ClassVar, Generic, NamedTuple, TypeVar, final

import numpy as np

from rbpf import gaussian
from rbpf.arrays import Bool, Float, Int
from rbpf.core.genealogy import Lineage
from rbpf.core.particles import Information, Particles, Prior, Proposed
from rbpf.errors import InputError
from rbpf.kernels.signature import ObservationKernel
from rbpf.lie import Array, Euclidean, LieGroup, SE2Group, SE3Group

#: Step of central differences, where truncation and rounding errors balance.
STEP = float(np.finfo(float).eps) ** (1 / 3)
Control = TypeVar("Control", contravariant=True)  #: Control input of a motion model, such as odometry.
Frame = TypeVar("Frame", contravariant=True)  #: Input of a sensor, such as an image.
RigidSpace = SE2Group | SE3Group | Euclidean  #: Groups that act on points; elements of Euclidean(n) are positions.
#: Arrays over all particles: states, scalars (weights, densities), increments, substates.
ParticleStates = Float[np.ndarray, "N E"]
PerParticle = Float[np.ndarray, " N"]
Increments = Float[np.ndarray, "N d"]
ParticleSubstates = Float[np.ndarray, "N m"]
#: Inputs of observation models with broadcasting leading axes: states, landmarks, their constants, substates.
States = Float[np.ndarray, "*#batch E"]
Estimates = Float[np.ndarray, "*#batch D"]
Means = Estimates | None
Constants = Float[np.ndarray, "*#batch A"] | None
Substates = Float[np.ndarray, "*#batch m"] | None
#: Landmarks, constants or substates without stated shapes; None if a model does not read them.
Given = Array | None
Measured = Float[np.ndarray, "*#batch p"]
Result = Float[np.ndarray, "*batch p"]
Covariances = Float[np.ndarray, "*#batch p p"]
#: Ids of K landmarks, K measurements of one step, and the measurements' covariances.
Ids = Int[np.ndarray, " K"]
Z = Float[np.ndarray, "K p"]
CovZ = Float[np.ndarray, "K p p"]
Expected = tuple[Float[np.ndarray, "N K p"], Float[np.ndarray, "N K p p"]]  #: Of K landmarks in all particles.
ParticleRows = Int[np.ndarray, " n"] | slice  #: Some of the particles.
Moments = tuple[Float[np.ndarray, "*K D"], Float[np.ndarray, "*K d d"]]

NULL = -1  #: Marks an observation that a particle takes as clutter.
NEW = -2  #: Marks the first observation of a new landmark in a particle.


class Part(str):
    """Name of a sampled or marginalised part: what observations can depend on, and which `Conditional` holds it.

    `Part.STATE`, `Part.LANDMARK` and `Part.SUBSTATE` correspond to the arguments of an `ObservationModel`. Any other name
    is a user-defined part, such as `Part("occupancy grid")`.
    """

    __slots__ = ()
    STATE: ClassVar["Part"]
    LANDMARK: ClassVar["Part"]
    SUBSTATE: ClassVar["Part"]


Part.STATE, Part.LANDMARK, Part.SUBSTATE = Part("sampled state"), Part("landmark"), Part("linear substate")


@dataclass(frozen=True)
class Transition:
    """p(x_t, s_t | x_{t-1}, s_{t-1}, u_t): ε = B s + w₁ in the right chart at `mean`; s_t = A s + b + w₂.

    Mathematics (substate). Arrays that are equal for all particles may have a first axis of length 1.
    """

    mean: ParticleStates  #: (N, E) chart's origin, x_t = mean · Exp(ε).
    #: (N or 1, joint = d+m, r) L with cov(w₁, w₂) = L Lᵀ; may be singular.
    noise_factor: Float[np.ndarray, "#N joint r"]
    coupling: Float[np.ndarray, "#N d m"] | None = None  #: B, (N or 1, d, m); None without a substate.
    dynamics: Float[np.ndarray, "#N m m"] | None = None  #: A, (N or 1, m, m).
    drift: Float[np.ndarray, "#N m"] | None = None  #: b, (N or 1, m).


class Jacobians(NamedTuple):
    """Derivatives of a predicted measurement: (…, p, d), (…, p, D), (…, p, m); None for a part that is not read."""

    state: Float[np.ndarray, "... p d"] | None = None
    landmark: Float[np.ndarray, "... p D"] | None = None
    substate: Float[np.ndarray, "... p m"] | None = None


class FusedKernel(NamedTuple):
    """A compiled `rbpf.kernels.signature.observation_kernel` and the constants (P,) it is called with."""

    function: ObservationKernel
    params: Float[np.ndarray, " P"]


@dataclass(frozen=True)
class Records:
    """Estimates of K landmarks in N particles, or of their components."""

    mean: Float[np.ndarray, "N K *C D"]  #: (N, K, D), or (N, K, C, D) for a parametrisation with C > 1 components.
    cov: Float[np.ndarray, "N K *C D D"]  #: (N, K, D, D) or (N, K, C, D, D).
    #: (N, K, A), constants, such as an anchor pose; None if A = 0.
    const: Float[np.ndarray, "#N K A"] | None = None
    log_weights: Float[np.ndarray, "N K C"] | None = None  #: (N, K, C) log-weights of the components; None if C = 1.


@dataclass(frozen=True)
class Observations:
    """A group of measurements of one kind taken in one frame."""

    z: Z  #: (K, p) measurements.
    cov: CovZ  #: (K, p, p) covariance of their noise.
    model: "ObservationModel"  #: their observation model.
    likelihood: "Likelihood | None" = None  #: of the innovation; None is Gaussian.
    #: landmark of each, (K,) for all particles or (N, K) per particle; NULL and NEW are allowed. None if the model reads no
    #: landmark.
    ids: Int[np.ndarray, "... K"] | None = None
    log_new: float = 0.0  #: log-density, in inverse measurement units, of a NEW observation.
    log_clutter: float = 0.0  #: the same of a NULL one.
    #: log-odds (K,) that each is an inlier, if this is decided once for all particles by a conditional
    #: (`Conditional.decided`); None leaves it to the likelihood in every particle.
    log_odds: Float[np.ndarray, " K"] | None = None
    log_factor: float = 0.0  #: added to their log-density, for such decisions.
    #: STATE: it refines and weighs the particles; LANDMARK: it updates the landmark. Two groups may share a measurement,
    #: one for each (E06 §5.2: the epipolar part for the state, the full measurement for the depth).
    updates: frozenset[Part] = frozenset({Part.STATE, Part.LANDMARK})
    #: the part that the model reads, if a filter has several maps or substates; None is the only one.
    part: Part | None = None
    data: object = None  #: raw data, see `raw`; None for measurements in z.
    normalised: bool = True  #: whether the likelihood of raw data is a normalised density, as the evidence requires.

    @classmethod
    def raw(cls, data: object, part: Part, normalised: bool = True) -> "Observations":
        """Raw data such as a scan, without rows z and a model: the conditional `part` computes their likelihood."""
        return cls(np.zeros((0, 1)), np.zeros((0, 1, 1)), _NO_MODEL, part=part, data=data, normalised=normalised)


@dataclass(frozen=True)
class NewLandmarks:
    """Measurements that initialise landmarks, after the update."""

    z: Z  #: (K, p) measurements.
    cov: CovZ  #: (K, p, p) their covariance.
    model: "ObservationModel"  #: whose `initialise` gives the records.
    landmark: "Landmark"  #: the parametrisation.
    mask: Bool[np.ndarray, "N K"] | None = None  #: (N, K) which particles take them as new; None is all.
    #: (K,) the sensor's ids for them, unused numbers from 0 up; None lets the map number them.
    ids: Ids | None = None


class LogDensities(NamedTuple):
    """log p(z | x) (N,) of all observations, and of those not in the look-ahead weight."""

    all: PerParticle
    after_sampling: PerParticle


class MotionModel(ABC, Generic[Control]):
    """p(x_t | x_{t-1}, u_t): `sample` draws, then `transition` adds a Gaussian. Override one of them, or both.

    The Gaussian part is sampled given the observations, and may drive a substate; anything else, such as a switching mode,
    is drawn before by `sample`.
    """

    space: LieGroup

    def sample(self, state: ParticleStates, control: Control, dt: float, rng: np.random.Generator) -> ParticleStates:
        """States (N, E) drawn from any distribution given the previous ones (N, E); by default unchanged."""
        return state

    def transition(self, state: ParticleStates, control: Control, dt: float) -> Transition:
        """Gaussian of the next state, given states (N, E) from `sample`, a control and a time step in seconds.

        Its noise may depend on the state. By default no further motion.
        """
        return Transition(state, np.zeros((1, self.space.dim, 0)))

    def transition_given(
        self, state: ParticleStates, substate: ParticleSubstates, control: Control, dt: float
    ) -> Transition:
        """`transition`, linearised about the substate's mean (N, m); override it for nonlinear dependence."""
        return self.transition(state, control, dt)

    def log_density(
        self, before: ParticleStates, after: Float[np.ndarray, "J E"], control: Control, dt: float
    ) -> Float[np.ndarray, "J N"] | None:
        """Log p(after | before) (J, N) for states (N, E) and (J, E), for backward simulation if `sample` is overridden."""
        return None


def draws(motion: MotionModel) -> bool:
    """Whether `sample` is overridden."""
    return type(motion).sample is not MotionModel.sample


class ObservationModel(ABC):
    """z = h(x, landmark, substate) + v, v ~ N(0, R)."""

    dim: int
    reads: frozenset[Part] = frozenset({Part.STATE, Part.LANDMARK})
    #: (m,) linearisation point of the substate, with Jacobian `by_substate`; the kernel is evaluated there.
    about: np.ndarray | None = None

    @abstractmethod
    def predict(
        self, state: States, landmark: Means = None, const: Constants = None, substate: Substates = None
    ) -> Result:
        """h, in NumPy broadcasting over leading axes; (…, E), (…, D), (…, A), (…, m) → (…, p)."""

    def jacobians(
        self, state: States, landmark: Means = None, const: Constants = None, substate: Substates = None
    ) -> Jacobians | None:
        """Analytic derivatives, in the right chart at the state; None for numeric ones.

        A constant block may lack the leading axes.
        """
        return None

    def residual(self, z: Measured, predicted: Measured) -> Result:
        """Z − h (…, p); override to wrap angles."""
        return z - predicted

    def innovation(
        self, z: Measured, state: States, landmark: Means = None, const: Constants = None, substate: Substates = None
    ) -> Float[np.ndarray, "... p"]:
        """ν (…, p): residual(z, predict(…)); override, with `jacobians`, for a constraint g(z, x, l) = 0 on z."""
        return self.residual(z, self.predict(state, landmark, const, substate))

    def visible(self, state: States, landmark: Estimates, const: Constants = None) -> Bool[np.ndarray, "*batch"]:
        """Mask (…): whether the landmark is within the sensor's view; by default always."""
        return np.ones(np.broadcast_shapes(state.shape[:-1], landmark.shape[:-1]), dtype=bool)

    def invert(self, state: States, z: Measured) -> Float[np.ndarray, "*batch D"]:
        """Inverse of h: the landmark (…, D) whose measurement from the state is z (…, p), for `initialise`."""
        raise InputError(f"{type(self).__name__} cannot initialise landmarks: override invert or initialise")

    def initialise(self, state: ParticleStates, z: Z, cov: CovZ) -> Records:
        """Initial estimates of landmarks from states (N, E), z (K, p) and cov (K, p, p).

        By default `invert`, with the covariance J R Jᵀ of its numeric derivative by the measurement.
        """
        at, p = state[:, None, :], z.shape[-1]
        mean = self.invert(at, z)
        columns = [
            (self.invert(at, z + STEP * np.eye(p)[j]) - self.invert(at, z - STEP * np.eye(p)[j])) / (2 * STEP)
            for j in range(p)
        ]
        jac = np.stack(columns, axis=-1)
        return Records(mean, gaussian.symmetrise(jac @ cov @ np.swapaxes(jac, -1, -2)))

    def by_substate(
        self, state: States, landmark: Estimates, const: Constants = None
    ) -> Float[np.ndarray, "*batch p m"]:
        """∂z/∂substate (…, p, m) of a model with `about`, Mathematics (sensor-constants); must be overridden with it."""
        raise InputError(f"{type(self).__name__} has an `about`: override by_substate")

    def new_by_substate(self, z: Z) -> Float[np.ndarray, "K D m"] | None:
        """Derivatives (K, D, m) by the substate of landmarks that `initialise` makes from z (K, p); None for zero.

        They are in the frame of the state; the map transforms them to its own.
        """
        return None

    def kernel(self) -> FusedKernel | None:
        """A compiled twin of residual(z, predict) and jacobians; None for NumPy."""
        return None


class _NoModel(ObservationModel):
    """Placeholder model of raw data, which have no rows."""

    dim = 1
    reads = frozenset()

    def predict(
        self, state: States, landmark: Means = None, const: Constants = None, substate: Substates = None
    ) -> Result:
        raise InputError("raw data have no observation model: the conditional of their part reads them")


_NO_MODEL = _NoModel()


class Landmark(ABC):
    """A landmark parametrisation of fixed record size; subclasses need no change of the store or the filter."""

    dim: int
    constants: int = 0
    components: int = 1
    #: Whether the estimate is relative to an anchor frame, world_from_anchor (E,), stored in its constants; else it is in
    #: the world.
    anchored: bool = False
    #: Index of the coordinate that is poorly known at first and multiplies the pose in the measurement, such as inverse
    #: depth. A joint map updates it alone while it is uncertain, Mathematics (learnt-alone).
    learnt_alone: int | None = None

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and vars(other) == vars(self)

    def __hash__(self) -> int:
        return hash(type(self))

    @abstractmethod
    def homogeneous(self, mean: Estimates, const: Constants = None) -> Float[np.ndarray, "*batch h"]:
        """Homogeneous world point of (…, D) and (…, A): (…, 4), (…, 3) in the plane; the last entry is 0 at infinity."""

    def point(
        self, mean: Estimates, const: Constants = None
    ) -> tuple[Float[np.ndarray, "*batch w"], Float[np.ndarray, "*batch w D"]]:
        """World point (…, 3), (…, 2) in the plane, and its derivative (…, 3, D) by the mean; by default numeric."""
        at, steps = partial(self._dehomogenised, const=const), STEP * np.eye(self.dim)
        return at(mean), np.stack([(at(mean + step) - at(mean - step)) / (2 * STEP) for step in steps], axis=-1)

    def seen_from(
        self, space: RigidSpace, pose: States, mean: Estimates
    ) -> tuple[Float[np.ndarray, "*batch D"], Float[np.ndarray, "*#batch D D"]]:
        """The mean (…, D) in the frame of a pose (…, E), and its derivative (…, D, D); used by maps whose frame moves.

        An anchored estimate is unchanged in its anchor's frame. Raises InputError: the subclass does not define it.
        """
        if not self.anchored:
            raise InputError(f"{type(self).__name__} cannot be transformed to another frame: override seen_from")
        return mean, np.eye(self.dim)

    def ready(self, records: Records) -> Bool[np.ndarray, "N K"]:
        """Whether an estimate is Gaussian enough to be promoted, (N, K) bool; by default never."""
        return np.zeros(records.mean.shape[:2], dtype=bool)

    def promote(self, records: Records) -> Records:
        """The estimates as single Gaussians of a world point.

        By default the unscented transform of each component (S. Julier and J. Uhlmann 1997), and moment matching.
        """
        const = records.const
        if const is not None and self.components > 1:
            const = const[:, :, None, :]

        at = partial(self._dehomogenised, const=const)
        mean, cov = gaussian.unscented_transform(at, records.mean, records.cov)
        if records.log_weights is None:
            return Records(mean, cov)
        by_component = (np.moveaxis(array, 2, 0) for array in (np.exp(records.log_weights), mean, cov))
        return Records(*gaussian.mixture_moments(*by_component))

    def _dehomogenised(self, mean: np.ndarray, const: np.ndarray | None) -> np.ndarray:
        world = self.homogeneous(mean, const)
        return world[..., :-1] / world[..., -1:]


class Likelihood(ABC):
    """Log-density of an innovation ν with covariance S; `normalised` says whether it integrates to one."""

    normalised: bool = True
    #: Whether the likelihood models outliers, such as wrong associations.
    rejects: bool = False
    #: Degrees of freedom of Student-t measurement noise: a joint map learns the noise of each observation.
    dof: float = np.inf
    kernel_id: int = -1  #: Number of the compiled twin in `rbpf.kernels.gate`, called with `params`; −1 has none.
    params: np.ndarray = np.zeros(1)

    @abstractmethod
    def log_density(self, nu: Measured, cov: Covariances) -> Float[np.ndarray, "*batch"]:
        """(…, p), (…, p, p) → (…)."""

    def inlier(self, nu: Measured, cov: Covariances) -> Bool[np.ndarray, "*batch"]:
        """Mask (…): whether the observation updates state and landmark; by default always."""
        return np.ones(nu.shape[:-1], dtype=bool)

    def log_odds(self, nu: Measured, cov: Covariances) -> Float[np.ndarray, "*batch"]:
        """Log-odds (…) of an inlier against an outlier, at least 0 where `inlier` holds."""
        return np.where(self.inlier(nu, cov), np.inf, -np.inf)

    def predicted_inlier(self, nu: Measured, cov: Covariances, predictive: Covariances) -> Bool[np.ndarray, "*batch"]:
        """`inlier` before the state is sampled: its covariance makes S the `predictive` covariance S + H Q Hᵀ."""
        return self.inlier(nu, predictive)

    def of_look_ahead(self) -> "Likelihood":
        """The likelihood whose inliers the look-ahead weight uses, if not those of the update; by default itself."""
        return self

    def log_inlier(self) -> float:
        """Added to an inlier's Gaussian log-density: log(1−ε) with outliers, else 0."""
        return 0.0

    def log_outlier(self) -> float:
        """Log-density of an observation taken as an outlier."""
        return 0.0


class Sensor(ABC, Generic[Frame]):
    """Raw data → observations, given the predicted belief; then new landmarks."""

    #: The map with its landmarks, if a filter has several; `Belief.map` is then this one.
    part: Part = Part.LANDMARK

    @abstractmethod
    def observe(self, frame: Frame, belief: "Belief") -> Sequence[Observations]:
        """Groups of observations of known landmarks (or of none)."""

    def new_landmarks(self, frame: Frame, belief: "Belief", observed: Sequence[Observations]) -> Sequence[NewLandmarks]:
        """New landmarks, given the updated belief and this sensor's observations, whose ids follow the resampling."""
        return ()


class LikelihoodSensor(Sensor[Frame]):
    """Weighs the sampled states by log p(frame | state) of any form."""

    normalised: bool = True  #: Whether it is a normalised density of the frame, as required for the evidence.

    @abstractmethod
    def log_likelihood(self, frame: Frame, state: ParticleStates) -> PerParticle:
        """(N,) for states (N, E); zeros if the frame has no data for this sensor."""

    @final
    def observe(self, frame: Frame, belief: "Belief") -> Sequence[Observations]:
        return [Observations.raw(partial(self.log_likelihood, frame), Part.STATE, self.normalised)]


#: The observations' information about the increment relative to the prior's mean, linearised at increments (N, d).
LineariseAt = Callable[[Increments], Information]


class Proposal(ABC):
    """q(x_t | x_{t-1}, z_t, u_t): the proposal distribution of the particles."""

    exact: bool = True  #: Whether samples are corrected by w₂ = p(z|x) p(x|x⁻) / (q(x) w₁); E06 takes w₂ := 1.

    @abstractmethod
    def propose(self, prior: Prior, linearise: LineariseAt, rng: np.random.Generator) -> Proposed:
        """Gaussian to sample from, and the look-ahead weight log w₁; random draws must use `rng`."""


class Conditional(ABC):
    """A part known in closed form given the sampled states: a landmark map, a Kalman substate, a grid.

    A step calls `predict`, `information` (once per linearisation), `resample` if the filter resamples, and `correct`. Only
    `correct` and `resample` may change the stored posterior, as `Filter.expect` predicts without a step. Values kept
    between `predict` and `correct` need a row per particle and have to be resampled, too.
    """

    supplies: Part  #: Its name in the filter. It gets the observations with this `part`, or whose model reads it.
    also: frozenset[Part] = frozenset()  #: Further parts that it supplies.
    takes_raw: bool = False  #: Whether `information` and `correct` accept groups of raw data.

    @abstractmethod
    def begin(self, n: int, lineage: Lineage) -> None:
        """Initialises n equal particles; `lineage` is their ancestry."""

    def predict(self, transition: Transition, space: LieGroup, dt: float) -> Prior | None:
        """Called in every step, with the seconds since the last one; possibly several times before the next call.

        A part that drives the motion, such as a substate with `Transition.coupling`, returns the distribution of the
        increment; at most one part may. By default nothing changes with time, and None is returned.
        """
        return None

    def decided(self, groups: Sequence[Observations], belief: "Belief") -> Sequence[Observations]:
        """The groups, with decisions made once for all particles; by default unchanged."""
        return groups

    def information(self, state: ParticleStates, groups: Sequence[Observations], prior: Prior) -> Information:
        """Information of the groups (at least one) about a right perturbation of the states (N, E).

        It serves proposal and look-ahead. By default none: then `correct` returns them in `LogDensities.after_sampling`.
        """
        return Information.zeros(state.shape[0], prior.space.dim)

    @abstractmethod
    def correct(self, state: ParticleStates, increment: Increments, groups: Sequence[Observations]) -> LogDensities:
        """Log p(z | x) at the sampled states, and the update by the same observations; in every step, even without any."""

    @abstractmethod
    def resample(self, ancestors: Int[np.ndarray, " N"]) -> None:
        """Every particle i becomes a copy of particle ancestors[i]; `lineage` has already been advanced.

        The copies must not share memory that is written to in place.
        """

    def driving(self) -> ParticleSubstates | None:
        """Mean of the substate that drives the motion, for `MotionModel.transition_given`; None without one."""
        return None

    def consolidate(self, particles: Particles) -> Particles:
        """Merges the spread of the particles into this part, instead of resampling: afterwards all particles are equal.

        The posterior keeps its mean and covariance; the weighted sample becomes part of the one Gaussian. Raises
        InputError: this part has a separate Gaussian in every particle, which requires resampling.
        """
        raise InputError(f"{type(self).__name__} cannot be consolidated: resample the particles")

    def moments(self, particles: Particles, of: Part | Ids) -> Moments:
        """See `Belief.moments`; for a part that it supplies, or landmarks. Raises InputError: they are not defined."""
        raise InputError(f"{type(self).__name__} does not define mean and covariance of {of}: override moments")

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a checkpoint."""

    @abstractmethod
    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`, after `begin`."""

    def options(self) -> dict[str, object]:
        """Options that must agree between saving and loading a checkpoint; plain values by name."""
        return {}


class Map(Conditional):
    """Interface of landmark maps, as used by sensors; `rbpf.maps.landmark_map.LandmarkMap` implements it.

    `evidence` tells whether it has the log-odds, per particle, that each landmark exists.
    """

    supplies = Part.LANDMARK
    evidence: bool

    @property
    @abstractmethod
    def ids(self) -> Int[np.ndarray, " M"]:
        """Ids (M,) of its landmarks, in order of initialisation."""

    @property
    @abstractmethod
    def stored_fraction(self) -> float:
        """Memory of the records, as a fraction of that of separate copies for all particles."""

    def world(self, state: States, particles: ParticleRows = slice(None)) -> States:
        """World_from_robot (n, E) of states (n, E) of some particles; by default landmarks and states are in the world."""
        return state

    @abstractmethod
    def holds(self, ids: Ids) -> Bool[np.ndarray, " K"]:
        """Mask (K,) of the ids (K,) that are in the map."""

    @abstractmethod
    def landmark_of(self, landmark_id: int) -> Landmark:
        """The parametrisation of a landmark."""

    @abstractmethod
    def are(self, ids: Ids, landmark: Landmark) -> Bool[np.ndarray, " K"]:
        """Mask (K,) of the landmarks (K,) that have this parametrisation."""

    @abstractmethod
    def read(self, ids: Ids, particles: ParticleRows = slice(None)) -> Records:
        """Estimates (N, K, …), in all or some particles. Raises InputError: a landmark is unknown, or their kinds differ."""

    @abstractmethod
    def add(self, new_landmarks: NewLandmarks, state: ParticleStates) -> Ids:
        """Initialises landmarks from the states (N, E); returns their ids (K,). Raises InputError: see `add_records`."""

    @abstractmethod
    def add_records(
        self,
        records: Records,
        landmark: Landmark,
        log_odds: Float[np.ndarray, "N K"] | None = None,
        ids: Ids | None = None,
    ) -> Ids:
        """Adds landmarks with given estimates (N, K, …); returns their ids (K,).

        Args:
            records: the estimates.
            landmark: their parametrisation.
            log_odds: (N, K) that they exist, for a map with evidence.
            ids: (K,) their ids; by default numbers never used before.

        Raises InputError: an id is negative, duplicate or in use, or the shapes do not fit.
        """

    @abstractmethod
    def remove(self, ids: Ids) -> None:
        """Drops landmarks (K,) from all particles. Raises InputError: one of them is not in the map."""

    @abstractmethod
    def promote(self, ids: Sequence[int] | Ids, to: Landmark | None = None) -> None:
        """Converts landmarks to single Gaussian points in all particles, by `Landmark.promote`."""

    @abstractmethod
    def log_odds(self, ids: Ids) -> Float[np.ndarray, "N K"]:
        """(N, K) log-odds that the landmarks exist; −inf where a particle does not hold one."""

    @abstractmethod
    def set_log_odds(self, ids: Ids, log_odds: Float[np.ndarray, "N K"]) -> None:
        """Overwrites log-odds (N, K), if the map has them; landmarks at −inf in every particle are removed."""

    @abstractmethod
    def innovations(
        self, model: ObservationModel, z: Z, ids: Ids, state: Float[np.ndarray, " E"], particle: int
    ) -> tuple[Z, Jacobians, Records]:
        """ν (K, p) of landmarks (K,) in one particle at a state (E,), its Jacobians, and the records (1, K, …)."""

    @abstractmethod
    def expected(self, model: ObservationModel, ids: Ids, belief: "Belief") -> Expected:
        """Predicted measurements of landmarks in each particle, and J P Jᵀ + H Q Hᵀ, including the state's uncertainty."""

    def project(self, model: ObservationModel, ids: Ids, belief: "Belief") -> tuple[Z, CovZ]:
        """See `Belief.project`; a map may fuse predictions and moments for speed."""
        predicted, within = self.expected(model, ids, belief)
        # Relative to the particle of highest weight, so that angles need not be wrapped.
        mode = predicted[belief.mode]
        mean, cov = gaussian.mixture_moments(belief.weights, model.residual(predicted, mode), within)
        return mode + mean, cov


@dataclass(frozen=True)
class Belief:
    """The belief passed to sensors: a weighted mixture of Gaussians, each with its own marginalised parts."""

    log_weights: PerParticle  #: (N,) normalised.
    prior: Prior  #: distribution of each particle's increment; after the update its factor is zero.
    parts: Mapping[Part, Conditional]  #: the conditionals, by the parts they supply.
    rng: np.random.Generator = field(default_factory=np.random.default_rng)  #: the filter's, for sensors that need it.
    landmarks: Part = Part.LANDMARK  #: which part `map` is: that of the sensor.

    @cached_property
    def state(self) -> ParticleStates:
        """(N, E) predicted states; after the update the sampled ones."""
        return self.prior.predicted()

    @cached_property
    def weights(self) -> PerParticle:
        """(N,) summing to one."""
        return np.exp(self.log_weights)

    @cached_property
    def mode(self) -> int:
        """The particle of highest weight."""
        return int(np.argmax(self.log_weights))

    @cached_property
    def map(self) -> Map:
        """The landmark map. Raises InputError: the filter holds none."""
        held = self.parts.get(self.landmarks)
        if not isinstance(held, Map):
            named = "" if self.landmarks == Part.LANDMARK else f"(…, part={self.landmarks!r})"
            raise InputError(f"this sensor needs a landmark map: give the filter a LandmarkMap{named}")
        return held

    def read(self, ids: Sequence[int] | Ids, particles: ParticleRows = slice(None)) -> Records:
        """Estimates (N, K, …) of landmarks of one parametrisation, in all particles or some rows."""
        return self.map.read(np.asarray(ids, dtype=np.int64), particles)

    def moments(self, of: Part | Sequence[int] | Ids) -> Moments:
        """Mean and covariance over all particles (within + between) of landmarks or a part.

        Landmarks (K,) of any kind, mixtures too, are points in the world, (K, D) and (K, D, D), in the given order; a map's
        part is all of them. A substate is (m,) and (m, m); `Part.STATE` (E,) and (d, d), in the world. Raises InputError:
        the landmark or part does not exist, or a user-defined part does not override `Conditional.moments`.
        """
        particles = Particles(self.state, self.log_weights)
        if not isinstance(of, Part):
            return self.map.moments(particles, np.asarray(of, dtype=np.int64))
        holders = [part for part in self.parts.values() if of == part.supplies or of in part.also]
        if not holders:
            raise InputError(f"this filter does not hold a {of}")
        return holders[-1].moments(particles, of)

    def read_mode(self, ids: Sequence[int] | Ids) -> Records:
        """Estimates (1, K, …) in the particle of highest weight alone."""
        return self.read(ids, slice(self.mode, self.mode + 1))

    def innovations(self, model: ObservationModel, z: Z, ids: Ids) -> tuple[Z, Float[np.ndarray, "K p d"], CovZ]:
        """For K measurements in the particle of highest weight: ν (K, p), ∂z/∂state (K, p, d) and J P Jᵀ (K, p, p)."""
        nu, jac, records = self.map.innovations(model, z, ids, self.state[self.mode], self.mode)
        assert jac.state is not None and jac.landmark is not None
        return nu, jac.state, jac.landmark @ records.cov[0] @ np.swapaxes(jac.landmark, -1, -2)

    def predictions(
        self, model: ObservationModel, z: Z, cov: CovZ, ids: Int[np.ndarray, " M"]
    ) -> tuple[Float[np.ndarray, "N K M p"], Float[np.ndarray, "N K M p p"]]:
        """Innovations ν (N, K, M, p) of K measurements against M landmarks, and S + H Q Hᵀ (N, K, M, p, p)."""
        predicted, within = self.map.expected(model, ids, self)
        return model.residual(z[:, None, :], predicted[:, None]), within[:, None] + cov[:, None]

    def project(self, model: ObservationModel, ids: Ids) -> tuple[Z, CovZ]:
        """Predicted measurements of landmarks: mean (K, p) and covariance (K, p, p) over all particles (E06 §4.1).

        The covariance is within + between particles and includes H Q Hᵀ, but not the measurement noise.
        """
        return self.map.project(model, ids, self)


class Resampler(ABC):
    """Chooses ancestors in proportion to the weights; E[number of descendants of i] = N W_i.

    It is not part of a checkpoint: any state that it keeps between steps is lost when a filter is loaded.
    """

    @abstractmethod
    def ancestors(self, weights: PerParticle, rng: np.random.Generator) -> Int[np.ndarray, " N"] | None:
        """(N,) normalised weights → (N,) ancestors, or None for no resampling in this step."""
