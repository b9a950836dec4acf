"""Small linear worlds, the Kalman filter that solves them, and the statistics of unbiased estimates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from rbpf.core.filter import Filter
from rbpf.core.models import (
    Jacobians,
    MotionModel,
    NewLandmarks,
    ObservationModel,
    Observations,
    Part,
    Sensor,
    Transition,
)
from rbpf.lie import Euclidean

SEEDS = 250


class LinearMotion(MotionModel):
    """x' = F x + B s + u + w₁ and s' = A s + b + w₂, with cov(w₁, w₂) = L Lᵀ; the substate may be absent."""

    def __init__(self, F, L, B=None, A=None, b=None):
        self.F, self.L, self.B, self.A, self.b = F, L, B, A, b
        self.space = Euclidean(F.shape[0])

    def transition(self, state, control, dt):
        mean = state @ self.F.T + (0.0 if control is None else control)
        if self.B is None:
            return Transition(mean, self.L[None])
        return Transition(mean, self.L[None], self.B[None], self.A[None], self.b[None])

    def joint(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Transition matrix, noise covariance and drift of (x, s) together."""
        cov = self.L @ self.L.T
        if self.B is None:
            return self.F, cov, np.zeros(len(self.F))
        d, m = self.B.shape
        matrix = np.block([[self.F, self.B], [np.zeros((m, d)), self.A]])
        return matrix, cov, np.concatenate([np.zeros(d), self.b])


class LinearObservation(ObservationModel):
    """z = G x + C s + v; a part whose matrix is None is not read."""

    def __init__(self, by_state=None, by_substate=None):
        matrices = {Part.STATE: by_state, Part.SUBSTATE: by_substate}
        self.matrices = {part: np.atleast_2d(matrix) for part, matrix in matrices.items() if matrix is not None}
        self.reads = frozenset(self.matrices)
        self.dim = next(iter(self.matrices.values())).shape[0]

    def predict(self, state, landmark=None, const=None, substate=None):
        values = {Part.STATE: state, Part.SUBSTATE: substate}
        return sum(values[part] @ matrix.T for part, matrix in self.matrices.items())

    def joint_matrix(self, motion: LinearMotion) -> np.ndarray:
        """H of (x, s) together."""
        sizes = {Part.STATE: motion.space.dim, Part.SUBSTATE: len(motion.joint()[0]) - motion.space.dim}
        return np.hstack([self.matrices.get(part, np.zeros((self.dim, size))) for part, size in sizes.items()])

    def jacobians(self, state, landmark=None, const=None, substate=None):
        return Jacobians(state=self.matrices.get(Part.STATE), substate=self.matrices.get(Part.SUBSTATE))


class Curved(ObservationModel):
    """z = h(x) + v; its Jacobian is numeric."""

    reads = frozenset({Part.STATE})

    def __init__(self, h: Callable[[np.ndarray], np.ndarray], dim: int = 1):
        self.h, self.dim = h, dim

    def predict(self, state, landmark=None, const=None, substate=None):
        return self.h(state)


class Relative(ObservationModel):
    """z = landmark − position + v, for a body of known orientation."""

    dim = 2

    def predict(self, state, landmark=None, const=None, substate=None):
        return landmark - state

    def invert(self, state, z):
        return state + z


@dataclass(frozen=True)
class Frame:
    """What a sensor is told to say: groups of observations, then new_landmarks."""

    groups: Sequence[Observations] = ()
    new_landmarks: Sequence[NewLandmarks] = ()


class Scripted(Sensor):
    """Hands out a frame's groups and new_landmarks as they are."""

    def observe(self, frame, belief):
        return frame.groups

    def new_landmarks(self, frame, belief, observed):
        return frame.new_landmarks


def single(z: np.ndarray, cov: np.ndarray | float, model: ObservationModel, **options: Any) -> Observations:
    """A group of one measurement."""
    return Observations(np.atleast_1d(z)[None], np.atleast_2d(cov)[None], model, **options)


Known = TypeVar("Known")


def known(value: Known | None) -> Known:
    """What is there in this test, though not in every record or group."""
    assert value is not None
    return value


@dataclass
class Kalman:
    """Kalman filter in Joseph form, with the log-evidence of what it was told."""

    mean: np.ndarray
    cov: np.ndarray
    log_evidence: float = 0.0
    path: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def predict(self, F: np.ndarray, Q: np.ndarray, drift: np.ndarray | float = 0.0) -> None:
        self.mean = F @ self.mean + drift
        self.cov = F @ self.cov @ F.T + Q

    def update(self, z: np.ndarray, H: np.ndarray, R: np.ndarray) -> None:
        nu, S = z - H @ self.mean, H @ self.cov @ H.T + R
        solved = np.linalg.solve(S, nu)
        self.log_evidence -= 0.5 * float(nu @ solved + np.linalg.slogdet(2 * np.pi * S)[1])
        gain = self.cov @ H.T @ np.linalg.inv(S)
        closed = np.eye(len(self.mean)) - gain @ H
        self.mean = self.mean + gain @ nu
        self.cov = closed @ self.cov @ closed.T + gain @ R @ gain.T

    def augment(self, z: np.ndarray, J: np.ndarray, R: np.ndarray) -> None:
        """Appends y = J x + z + v, a landmark on its first sighting."""
        self.mean = np.concatenate([self.mean, J @ self.mean + z])
        self.cov = np.block([[self.cov, self.cov @ J.T], [J @ self.cov, J @ self.cov @ J.T + R]])

    def record(self) -> None:
        self.path.append((self.mean, self.cov))


Moments = tuple[np.ndarray, np.ndarray]


def smooth(path: Sequence[Moments], F: np.ndarray, Q: np.ndarray, inputs: np.ndarray) -> list[Moments]:
    """Rauch-Tung-Striebel smoother of filtered moments; inputs[t] was added on the way from t−1 to t."""
    smoothed = [path[-1]]
    for t in range(len(path) - 2, -1, -1):
        mean, cov = path[t]
        later_mean, later_cov = smoothed[0]
        predicted = F @ cov @ F.T + Q
        gain = cov @ F.T @ np.linalg.inv(predicted)
        moved = mean + gain @ (later_mean - F @ mean - inputs[t + 1])
        smoothed.insert(0, (moved, cov + gain @ (later_cov - predicted) @ gain.T))
    return smoothed


def log_ratios(
    build: Callable[[np.random.Generator], Filter], frames: Sequence[Any], exact: float, stream: int, seeds: int = SEEDS
) -> np.ndarray:
    """Log-evidence of one run per seed over the exact one; `stream` keeps tests' random numbers apart."""

    def run(seed: int) -> float:
        filter_ = build(np.random.default_rng([stream, seed]))
        for frame in frames:
            filter_.step(frame)
        return filter_.log_evidence - exact

    return np.array([run(seed) for seed in range(seeds)])


def deviation(samples: np.ndarray, expected: np.ndarray | float) -> float:
    """Largest distance of a mean over the first axis from what is expected, in standard errors."""
    error = np.abs(samples.mean(axis=0) - expected)
    return float((error / (samples.std(axis=0, ddof=1) / np.sqrt(len(samples)))).max())


def assert_unbiased(log_ratio: np.ndarray) -> None:
    """The mean of Ẑ/Z is one within three standard errors; a spread of log Ẑ ≤ 0.5 gives that a meaning."""
    assert 1e-4 < log_ratio.std(ddof=1) <= 0.5
    assert deviation(np.exp(log_ratio), 1.0) <= 3.0
