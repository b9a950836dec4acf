"""Every abstract class that a user subclasses, on one page.

Shapes: N particles, K observations, E state storage, d its tangent, m linear substate, D landmark, A its constants,
C components, p measurement, r noise rank. A method that is not abstract is a hook with a default.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import LieGroup

if TYPE_CHECKING:
    from rbpf.belief import Belief
    from rbpf.genealogy import Lineage
    from rbpf.proposals import Prior, Proposed, Terms

NULL = -1
"""An observation that a particle takes as clutter."""
NEW = -2
"""An observation that a particle takes as the first sighting of a landmark."""


class Part(Enum):
    """What an observation can depend on."""

    STATE = "sampled state"
    LANDMARK = "landmark"
    SUBSTATE = "linear substate"


@dataclass(frozen=True)
class Transition:
    """p(x_t, s_t | x_{t-1}, s_{t-1}, u_t): ε = B s + w₁ in the right chart at `mean`; s_t = A s + b + w₂.

    Arrays may have a first axis of length 1 where they do not differ between particles.

    Attributes:
        mean: (N, E) chart's origin, x_t = mean · Exp(ε).
        noise_factor: (N or 1, d+m, r) L with cov(w₁, w₂) = L Lᵀ; may be singular.
        coupling: B, (N or 1, d, m); None where there is no substate.
        dynamics: A, (N or 1, m, m).
        drift: b, (N or 1, m).
    """

    mean: np.ndarray
    noise_factor: np.ndarray
    coupling: np.ndarray | None = None
    dynamics: np.ndarray | None = None
    drift: np.ndarray | None = None


class MotionModel(ABC):
    """p(x_t | x_{t-1}, u_t), linear-Gaussian in the substate if there is one."""

    space: LieGroup

    @abstractmethod
    def transition(self, state: np.ndarray, control: Any, dt: float) -> Transition:
        """Law of the next state. Given states (N, E), a control and a time step in seconds."""


class Jacobians(NamedTuple):
    """Derivatives of a predicted measurement: (…, p, d), (…, p, D), (…, p, m); None where it is not read."""

    state: np.ndarray | None = None
    landmark: np.ndarray | None = None
    substate: np.ndarray | None = None


class FusedKernel(NamedTuple):
    """A compiled `rbpf.kernels.signature.observation_kernel` and the constants (P,) it is called with."""

    function: Any
    params: np.ndarray


class ObservationModel(ABC):
    """z = h(x, landmark, substate) + v, v ~ N(0, R)."""

    dim: int
    reads: frozenset[Part] = frozenset({Part.STATE, Part.LANDMARK})

    @abstractmethod
    def predict(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> np.ndarray:
        """h: plain NumPy that broadcasts over leading axes; (…, E), (…, D), (…, A), (…, m) → (…, p)."""

    def jacobians(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> Jacobians | None:
        """Analytic derivatives, in the right chart at the state; None asks for numeric ones.

        A block that is constant may come without the leading axes.
        """
        return None

    def residual(self, z: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Z − h (…, p); override to wrap angles."""
        return z - predicted

    def innovation(
        self,
        z: np.ndarray,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> np.ndarray:
        """ν (…, p): residual(z, predict(…)); override, with `jacobians`, for a constraint g(z, x, l) = 0 on z."""
        return self.residual(z, self.predict(state, landmark, const, substate))

    def visible(self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """Whether the sensor could see the landmark (…), bool; by default always."""
        return np.ones(np.broadcast_shapes(state.shape[:-1], landmark.shape[:-1]), dtype=bool)

    def invert(self, state: np.ndarray, z: np.ndarray) -> np.ndarray:
        """The landmark (…, D) that would be measured as z (…, p) from the state, for `initialise`."""
        raise InputError(
            f"{type(self).__name__} cannot start landmarks: override invert(state, z) or initialise(state, z, cov)"
        )

    def initialise(self, state: np.ndarray, z: np.ndarray, cov: np.ndarray) -> "Records":
        """First estimate of landmarks from (N, E), (K, p), (K, p, p); by default `invert` and its numeric Jacobian."""
        from rbpf.numeric import invert_with_covariance

        return invert_with_covariance(self, state, z, cov)

    def kernel(self) -> FusedKernel | None:
        """A compiled twin of residual(z, predict) and jacobians; None runs them in NumPy."""
        return None


@dataclass(frozen=True)
class Records:
    """Estimates of K landmarks in N particles, or of their components.

    Attributes:
        mean: (N, K, D), or (N, K, C, D) where the parametrisation has C > 1 components.
        cov: (N, K, D, D) or (N, K, C, D, D).
        const: (N, K, A), what stays fixed, as an anchor pose; None where A = 0.
        log_weights: (N, K, C) log-weights of the components; None where C = 1.
    """

    mean: np.ndarray
    cov: np.ndarray
    const: np.ndarray | None = None
    log_weights: np.ndarray | None = None


class Landmark(ABC):
    """A parametrisation of fixed record size; add one by subclassing, the store and the filter stay as they are."""

    dim: int
    constants: int = 0
    components: int = 1

    @abstractmethod
    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """World point of (…, D) and (…, A): (…, 4), (…, 3) in the plane; its last entry may be 0, at infinity."""

    def ready(self, records: Records) -> np.ndarray:
        """Whether an estimate is Gaussian enough to be promoted, (N, K) bool; by default never."""
        return np.zeros(records.mean.shape[:2], dtype=bool)

    def promote(self, records: Records) -> Records:
        """The estimates as single Gaussians of a world point; by default an unscented transform of each."""
        from rbpf.numeric import promote_to_points

        return promote_to_points(self, records)


class Likelihood(ABC):
    """Log-density of an innovation ν with covariance S; `normalised` says whether it integrates to one."""

    normalised: bool = True
    form: int = -1
    """Number of the compiled twin in `rbpf.kernels.gate`, called with `params`; −1 has none."""
    params: np.ndarray = np.zeros(1)

    @abstractmethod
    def log_density(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """(…, p), (…, p, p) → (…)."""

    def inlier(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """Whether the observation may move the state and the landmark, (…) bool; by default always."""
        return np.ones(nu.shape[:-1], dtype=bool)

    def log_inlier(self) -> float:
        """What an inlier's Gaussian log-density is increased by: log(1−ε) with outliers, else 0."""
        return 0.0

    def log_outlier(self) -> float:
        """Log-density of an observation taken as an outlier."""
        return 0.0


@dataclass(frozen=True)
class Observations:
    """A group of measurements of one kind taken in one frame.

    Attributes:
        z: (K, p) measurements.
        cov: (K, p, p) covariance of their noise.
        model: how they arise.
        likelihood: of the innovation; None is Gaussian.
        ids: landmark of each, (K,) for all particles or (N, K) per particle; NULL and NEW are allowed.
            None where the model reads no landmark.
        log_new: log-density, in inverse measurement units, that a particle pays for a NEW observation.
        log_clutter: the same for a NULL one.
        informs: STATE: it refines and weighs the particles; LANDMARK: it updates the landmark. Two groups may share
            a measurement, one for each (E06 §5.2: the epipolar part for the state, all of it for the depth).
    """

    z: np.ndarray
    cov: np.ndarray
    model: ObservationModel
    likelihood: Likelihood | None = None
    ids: np.ndarray | None = None
    log_new: float = 0.0
    log_clutter: float = 0.0
    informs: frozenset[Part] = frozenset({Part.STATE, Part.LANDMARK})


@dataclass(frozen=True)
class Births:
    """First sightings that start landmarks, after the update.

    Attributes:
        z: (K, p) measurements;  cov: (K, p, p) their covariance.
        model: whose `initialise` gives the records.
        landmark: the parametrisation.
        mask: (N, K) which particles take them as new; None is all.
        facts: per landmark, what the catalogue remembers of it (a descriptor, the log's own name).
    """

    z: np.ndarray
    cov: np.ndarray
    model: ObservationModel
    landmark: Landmark
    mask: np.ndarray | None = None
    facts: Sequence[Any] = field(default_factory=tuple)


class Sensor(ABC):
    """Raw data → observations, given the predicted belief; then new landmarks."""

    @abstractmethod
    def observe(self, frame: Any, belief: "Belief") -> Sequence[Observations]:
        """Groups of observations of known landmarks (or of none)."""

    def births(self, frame: Any, belief: "Belief", observed: Sequence[Observations]) -> Sequence[Births]:
        """First sightings, given the updated belief and what this sensor observed, ids of the descendants."""
        return ()


class Proposal(ABC):
    """q(x_t | x_{t-1}, z_t, u_t): where the particles are sampled."""

    exact: bool = True
    """Whether samples are corrected by w₂ = p(z|x) p(x|x⁻) / (q(x) w₁); E06 takes w₂ := 1."""

    @abstractmethod
    def propose(self, prior: "Prior", terms: "LineariseAt") -> "Proposed":
        """Gaussian to sample from, and the look-ahead weight log w₁."""


class LineariseAt(ABC):
    """What a proposal may ask: the observations' information about the increment."""

    @abstractmethod
    def __call__(self, increment: np.ndarray) -> "Terms":
        """Terms (relative to the prior's mean) linearised at the increments (N, d) in the prior's chart."""


class Conditional(ABC):
    """What is marginalised: Gaussian given the sampled states. A landmark map, a Kalman substate."""

    supplies: Part

    @abstractmethod
    def begin(self, n: int, lineage: "Lineage") -> None:
        """Makes room for n particles whose ancestry `lineage` keeps."""

    @abstractmethod
    def terms(self, state: np.ndarray, groups: Sequence[Observations], prior: "Prior") -> "Terms":
        """The information of the groups about a right perturbation of the states (N, E)."""

    @abstractmethod
    def correct(
        self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]
    ) -> "LogDensities":
        """Log p(z | x) at the sampled states, and the update by the same observations."""

    @abstractmethod
    def resample(self, ancestors: np.ndarray) -> None:
        """Every particle i becomes a copy of particle ancestors[i]; `lineage` has been advanced."""

    def predict(self, transition: Transition, space: LieGroup) -> "Prior":
        """Law of the increment; only a substate that drives the motion changes it."""
        from rbpf.proposals import Prior

        return Prior.of_transition(transition, space)

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint must hold."""

    @abstractmethod
    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`, after `begin`."""

    def options(self) -> dict[str, Any]:
        """What must agree between who saves a checkpoint and who loads it; plain values by name."""
        return {}


class LogDensities(NamedTuple):
    """log p(z | x) (N,) of all observations, and of those that took no part in the refinement."""

    all: np.ndarray
    late: np.ndarray


class Resampler(ABC):
    """Chooses ancestors in proportion to the weights; E[number of descendants of i] = N W_i."""

    @abstractmethod
    def ancestors(self, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        """(N,) normalised weights → (N,) ancestors, or None for no resampling in this step."""
