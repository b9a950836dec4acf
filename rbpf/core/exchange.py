"""What the classes of `rbpf.core.models` hand to one another.

Shapes: N particles, K observations, E state storage, d its tangent, m linear substate, D landmark, A its constants,
C components, p measurement, r noise rank.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbpf.arrays import Bool, Float, Int

if TYPE_CHECKING:
    from rbpf.core.models import Landmark, Likelihood, ObservationModel

NULL = -1
"""An observation that a particle takes as clutter."""
NEW = -2
"""An observation that a particle takes as the first sighting of a landmark."""


class Part(Enum):
    """What an observation can depend on."""

    STATE = "sampled state"
    LANDMARK = "landmark"
    SUBSTATE = "linear substate"

    __hash__ = object.__hash__
    """Members are single objects; Enum's own hash, asked for at every use of a set of parts, is run by Python."""


@dataclass(frozen=True)
class Transition:
    """p(x_t, s_t | x_{t-1}, s_{t-1}, u_t): ε = B s + w₁ in the right chart at `mean`; s_t = A s + b + w₂.

    Mathematics (substate).

    Arrays may have a first axis of length 1 where they do not differ between particles.

    Attributes:
        mean: (N, E) chart's origin, x_t = mean · Exp(ε).
        noise_factor: (N or 1, joint = d+m, r) L with cov(w₁, w₂) = L Lᵀ; may be singular.
        coupling: B, (N or 1, d, m); None where there is no substate.
        dynamics: A, (N or 1, m, m).
        drift: b, (N or 1, m).
    """

    mean: Float[np.ndarray, "N E"]
    noise_factor: Float[np.ndarray, "#N joint r"]
    coupling: Float[np.ndarray, "#N d m"] | None = None
    dynamics: Float[np.ndarray, "#N m m"] | None = None
    drift: Float[np.ndarray, "#N m"] | None = None


class Jacobians(NamedTuple):
    """Derivatives of a predicted measurement: (…, p, d), (…, p, D), (…, p, m); None where it is not read."""

    state: Float[np.ndarray, "... p d"] | None = None
    landmark: Float[np.ndarray, "... p D"] | None = None
    substate: Float[np.ndarray, "... p m"] | None = None


class FusedKernel(NamedTuple):
    """A compiled `rbpf.kernels.signature.observation_kernel` and the constants (P,) it is called with."""

    function: Any
    params: Float[np.ndarray, " P"]


@dataclass(frozen=True)
class Records:
    """Estimates of K landmarks in N particles, or of their components.

    Attributes:
        mean: (N, K, D), or (N, K, C, D) where the parametrisation has C > 1 components.
        cov: (N, K, D, D) or (N, K, C, D, D).
        const: (N, K, A), what stays fixed, as an anchor pose; None where A = 0.
        log_weights: (N, K, C) log-weights of the components; None where C = 1.
    """

    mean: Float[np.ndarray, "N K *C D"]
    cov: Float[np.ndarray, "N K *C D D"]
    const: Float[np.ndarray, "#N K A"] | None = None
    log_weights: Float[np.ndarray, "N K C"] | None = None


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
        updates: STATE: it refines and weighs the particles; LANDMARK: it updates the landmark. Two groups may fraction
            a measurement, one for each (E06 §5.2: the epipolar part for the state, all of it for the depth).
    """

    z: Float[np.ndarray, "K p"]
    cov: Float[np.ndarray, "K p p"]
    model: "ObservationModel"
    likelihood: "Likelihood | None" = None
    ids: Int[np.ndarray, "... K"] | None = None
    log_new: float = 0.0
    log_clutter: float = 0.0
    updates: frozenset[Part] = frozenset({Part.STATE, Part.LANDMARK})


@dataclass(frozen=True)
class NewLandmarks:
    """First sightings that start landmarks, after the update.

    Attributes:
        z: (K, p) measurements;  cov: (K, p, p) their covariance.
        model: whose `initialise` gives the records.
        landmark: the parametrisation.
        mask: (N, K) which particles take them as new; None is all.
        ids: (K,) numbers from 0 up by which the sensor knows them, none of them in use; None lets the map number them.
        facts: per landmark, what the catalogue remembers of it (a descriptor, the log's own name).
    """

    z: Float[np.ndarray, "K p"]
    cov: Float[np.ndarray, "K p p"]
    model: "ObservationModel"
    landmark: "Landmark"
    mask: Bool[np.ndarray, "N K"] | None = None
    facts: Sequence[Any] = field(default_factory=tuple)
    ids: Int[np.ndarray, " K"] | None = None


class LogDensities(NamedTuple):
    """log p(z | x) (N,) of all observations, and of those that took no part in the refinement."""

    all: Float[np.ndarray, " N"]
    late: Float[np.ndarray, " N"]
