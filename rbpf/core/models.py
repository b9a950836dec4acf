"""Every abstract class that a user subclasses, on one page; what they hand over stands in `rbpf.core.exchange`.

Shapes: N particles, K observations, E state storage, d its tangent, m linear substate, D landmark, A its constants,
C components, p measurement, r noise rank. A method that is not abstract is a hook with a default.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rbpf.arrays import Bool, Float, Int
from rbpf.core.exchange import NEW as NEW
from rbpf.core.exchange import NULL as NULL
from rbpf.core.exchange import FusedKernel as FusedKernel
from rbpf.core.exchange import Jacobians as Jacobians
from rbpf.core.exchange import LogDensities as LogDensities
from rbpf.core.exchange import NewLandmarks as NewLandmarks
from rbpf.core.exchange import Observations as Observations
from rbpf.core.exchange import Part as Part
from rbpf.core.exchange import Records as Records
from rbpf.core.exchange import Transition as Transition
from rbpf.errors import InputError
from rbpf.lie import LieGroup

if TYPE_CHECKING:
    from rbpf.core.belief import Belief
    from rbpf.core.genealogy import Lineage
    from rbpf.core.proposals import Prior, Proposed, Terms


class MotionModel(ABC):
    """p(x_t | x_{t-1}, u_t), linear-Gaussian in the substate if there is one."""

    space: LieGroup

    @abstractmethod
    def transition(self, state: Float[np.ndarray, "N E"], control: Any, dt: float) -> Transition:
        """Law of the next state. Given states (N, E), a control and a time step in seconds."""


class ObservationModel(ABC):
    """z = h(x, landmark, substate) + v, v ~ N(0, R)."""

    dim: int
    reads: frozenset[Part] = frozenset({Part.STATE, Part.LANDMARK})

    @abstractmethod
    def predict(
        self,
        state: Float[np.ndarray, "*#batch E"],
        landmark: Float[np.ndarray, "*#batch D"] | None = None,
        const: Float[np.ndarray, "*#batch A"] | None = None,
        substate: Float[np.ndarray, "*#batch m"] | None = None,
    ) -> Float[np.ndarray, "*batch p"]:
        """h: plain NumPy that broadcasts over leading axes; (…, E), (…, D), (…, A), (…, m) → (…, p)."""

    def jacobians(
        self,
        state: Float[np.ndarray, "*#batch E"],
        landmark: Float[np.ndarray, "*#batch D"] | None = None,
        const: Float[np.ndarray, "*#batch A"] | None = None,
        substate: Float[np.ndarray, "*#batch m"] | None = None,
    ) -> Jacobians | None:
        """Analytic derivatives, in the right chart at the state; None asks for numeric ones.

        A block that is constant may come without the leading axes.
        """
        return None

    def residual(
        self, z: Float[np.ndarray, "*#batch p"], predicted: Float[np.ndarray, "*#batch p"]
    ) -> Float[np.ndarray, "*batch p"]:
        """Z − h (…, p); override to wrap angles."""
        return z - predicted

    def innovation(
        self,
        z: Float[np.ndarray, "*#batch p"],
        state: Float[np.ndarray, "*#batch E"],
        landmark: Float[np.ndarray, "*#batch D"] | None = None,
        const: Float[np.ndarray, "*#batch A"] | None = None,
        substate: Float[np.ndarray, "*#batch m"] | None = None,
    ) -> Float[np.ndarray, "... p"]:
        """ν (…, p): residual(z, predict(…)); override, with `jacobians`, for a constraint g(z, x, l) = 0 on z."""
        return self.residual(z, self.predict(state, landmark, const, substate))

    def visible(
        self,
        state: Float[np.ndarray, "*#batch E"],
        landmark: Float[np.ndarray, "*#batch D"],
        const: Float[np.ndarray, "*#batch A"] | None = None,
    ) -> Bool[np.ndarray, "*batch"]:
        """Whether the sensor could see the landmark (…), bool; by default always."""
        return np.ones(np.broadcast_shapes(state.shape[:-1], landmark.shape[:-1]), dtype=bool)

    def invert(
        self, state: Float[np.ndarray, "*#batch E"], z: Float[np.ndarray, "*#batch p"]
    ) -> Float[np.ndarray, "*batch D"]:
        """The landmark (…, D) that would be measured as z (…, p) from the state, for `initialise`."""
        raise InputError(
            f"{type(self).__name__} cannot start landmarks: override invert(state, z) or initialise(state, z, cov)"
        )

    def initialise(
        self, state: Float[np.ndarray, "N E"], z: Float[np.ndarray, "K p"], cov: Float[np.ndarray, "K p p"]
    ) -> Records:
        """First estimate of landmarks from (N, E), (K, p), (K, p, p); by default `invert` and its numeric Jacobian."""
        from rbpf.core.numeric import invert_with_covariance

        return invert_with_covariance(self, state, z, cov)

    def kernel(self) -> FusedKernel | None:
        """A compiled twin of residual(z, predict) and jacobians; None runs them in NumPy."""
        return None


class Landmark(ABC):
    """A parametrisation of fixed record size; add one by subclassing, the store and the filter stay as they are."""

    dim: int
    constants: int = 0
    components: int = 1

    @abstractmethod
    def homogeneous(
        self, mean: Float[np.ndarray, "*#batch D"], const: Float[np.ndarray, "*#batch A"] | None = None
    ) -> Float[np.ndarray, "*batch h"]:
        """World point of (…, D) and (…, A): (…, 4), (…, 3) in the plane; its last entry may be 0, at infinity."""

    def ready(self, records: Records) -> Bool[np.ndarray, "N K"]:
        """Whether an estimate is Gaussian enough to be promoted, (N, K) bool; by default never."""
        return np.zeros(records.mean.shape[:2], dtype=bool)

    def promote(self, records: Records) -> Records:
        """The estimates as single Gaussians of a world point; by default an unscented transform of each."""
        from rbpf.core.numeric import promote_to_points

        return promote_to_points(self, records)


class Likelihood(ABC):
    """Log-density of an innovation ν with covariance S; `normalised` says whether it integrates to one."""

    normalised: bool = True
    kernel_id: int = -1
    """Number of the compiled twin in `rbpf.kernels.gate`, called with `params`; −1 has none."""
    params: np.ndarray = np.zeros(1)

    @abstractmethod
    def log_density(
        self, nu: Float[np.ndarray, "*#batch p"], cov: Float[np.ndarray, "*#batch p p"]
    ) -> Float[np.ndarray, "*batch"]:
        """(…, p), (…, p, p) → (…)."""

    def inlier(
        self, nu: Float[np.ndarray, "*#batch p"], cov: Float[np.ndarray, "*#batch p p"]
    ) -> Bool[np.ndarray, "*batch"]:
        """Whether the observation may move the state and the landmark, (…) bool; by default always."""
        return np.ones(nu.shape[:-1], dtype=bool)

    def log_inlier(self) -> float:
        """What an inlier's Gaussian log-density is increased by: log(1−ε) with outliers, else 0."""
        return 0.0

    def log_outlier(self) -> float:
        """Log-density of an observation taken as an outlier."""
        return 0.0


class Sensor(ABC):
    """Raw data → observations, given the predicted belief; then new landmarks."""

    @abstractmethod
    def observe(self, frame: Any, belief: "Belief") -> Sequence[Observations]:
        """Groups of observations of known landmarks (or of none)."""

    def new_landmarks(
        self, frame: Any, belief: "Belief", observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
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
    def __call__(self, increment: Float[np.ndarray, "N d"]) -> "Terms":
        """Terms (relative to the prior's mean) linearised at the increments (N, d) in the prior's chart."""


class Conditional(ABC):
    """What is marginalised: Gaussian given the sampled states. A landmark map, a Kalman substate."""

    supplies: Part

    @abstractmethod
    def begin(self, n: int, lineage: "Lineage") -> None:
        """Makes room for n particles whose ancestry `lineage` keeps."""

    @abstractmethod
    def terms(
        self, state: Float[np.ndarray, "N E"], groups: Sequence[Observations], prior: "Prior"
    ) -> "Terms":
        """The information of the groups about a right perturbation of the states (N, E)."""

    @abstractmethod
    def correct(
        self,
        state: Float[np.ndarray, "N E"],
        increment: Float[np.ndarray, "N d"],
        groups: Sequence[Observations],
    ) -> LogDensities:
        """Log p(z | x) at the sampled states, and the update by the same observations."""

    @abstractmethod
    def resample(self, ancestors: Int[np.ndarray, " N"]) -> None:
        """Every particle i becomes a copy of particle ancestors[i]; `lineage` has been advanced."""

    def predict(self, transition: Transition, space: LieGroup) -> "Prior":
        """Law of the increment; only a substate that drives the motion changes it."""
        from rbpf.core.proposals import Prior

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


class Resampler(ABC):
    """Chooses ancestors in proportion to the weights; E[number of descendants of i] = N W_i."""

    @abstractmethod
    def ancestors(
        self, weights: Float[np.ndarray, " N"], rng: np.random.Generator
    ) -> Int[np.ndarray, " N"] | None:
        """(N,) normalised weights → (N,) ancestors, or None for no resampling in this step."""
