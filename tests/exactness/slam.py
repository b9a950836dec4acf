"""A linear SLAM world (known orientation, landmarks relative to the position) and its joint Kalman filter."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import NewLandmarks, ObservationModel, Observations
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry
from tests.exactness.models import SEEDS, Frame, Kalman, LinearMotion

NOISE = np.array([[0.25, 0.08], [0.08, 0.2]])
STEP, Q = np.array([0.8, 0.3]), np.array([[0.2, 0.05], [0.05, 0.1]])
"""Of a robot that goes by known steps, with such noise."""
ALONG = Odometry(np.append(0.0, STEP), block_diag(0.0, Q))
"""The same as odometry in the plane: the noise has no component along the heading."""
TURNED = np.array([0.7, 1.0, -2.0])
"""Where a robot starts whose heading is known."""
DRIFTING = LinearMotion(
    np.eye(2),
    np.array([[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.1, 0.0, 0.2], [0.0, 0.05, 0.2]]),
    0.7 * np.eye(2),
    0.9 * np.eye(2),
    np.array([0.1, 0.0]),
)
"""A position driven by a velocity that is correlated with it through the noise."""
VISIBLE = [(0, 1), (0, 1), (1, 2), (0, 1, 2)]
"""Landmarks seen in each step; the first sighting of one starts it."""


@dataclass
class LinearSlam:
    """p' = F p + drift + w of the position, and of a velocity behind it where F is larger.

    What a robot turned by `rotation` sees of a landmark is z = rotationᵀ (landmark − position) + v.

    Attributes:
        kalman: of (position[, velocity], landmarks), at the end; its log-evidence leaves first sightings out.
        measured: per step, ids of the landmarks and what was measured.
    """

    F: np.ndarray
    Q: np.ndarray
    drift: np.ndarray
    start: Kalman
    rotation: np.ndarray
    seed: int

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        landmarks = rng.normal(scale=4.0, size=(3, 2))
        truth = rng.multivariate_normal(self.start.mean, self.start.cov)
        self.kalman = Kalman(self.start.mean, self.start.cov)
        self.measured: list[tuple[tuple[int, ...], np.ndarray]] = []
        for seen in VISIBLE:
            truth = self.F @ truth + self.drift + rng.multivariate_normal(np.zeros(len(truth)), self.Q)
            z = (landmarks[list(seen)] - truth[:2]) @ self.rotation
            z = z + rng.multivariate_normal(np.zeros(2), NOISE, size=len(seen))
            self.measured.append((seen, z))
            self._filter(seen, z)

    def frames(self, model: ObservationModel) -> list[Frame]:
        """What a scripted sensor says; landmarks are numbered in the order of their new_landmarks."""
        known: set[int] = set()
        frames = []
        for seen, z in self.measured:
            old, new = ([k for k, i in enumerate(seen) if (i in known) == held] for held in (True, False))
            known.update(seen)
            groups = [Observations(z[old], self._noise(old), model, ids=np.array(seen)[old])] if old else []
            new_landmarks = [NewLandmarks(z[new], self._noise(new), model, Point(2))] if new else []
            frames.append(Frame(groups, new_landmarks))
        return frames

    def _noise(self, rows: Sequence[int]) -> np.ndarray:
        return np.repeat(NOISE[None], len(rows), axis=0)

    def _filter(self, seen: tuple[int, ...], z: np.ndarray) -> None:
        kalman, moving = self.kalman, len(self.start.mean)
        still = len(kalman.mean) - moving
        padding = np.zeros(still)
        kalman.predict(
            block_diag(self.F, np.eye(still)),
            block_diag(self.Q, np.zeros((still, still))),
            np.append(self.drift, padding),
        )
        for landmark, measured in zip(seen, z, strict=True):
            at = moving + 2 * landmark
            pick = np.eye(len(kalman.mean))
            if at < len(kalman.mean):
                kalman.update(measured, self.rotation.T @ (pick[at : at + 2] - pick[:2]), NOISE)
            else:
                kalman.augment(self.rotation @ measured, pick[:2], self.rotation @ NOISE @ self.rotation.T)


class Walk(LinearMotion):
    """Position alone, by known steps."""

    def __init__(self):
        super().__init__(np.eye(2), np.linalg.cholesky(Q))

    def transition(self, state, control, dt):
        return super().transition(state, STEP, dt)


def walked() -> LinearSlam:
    """The world of a `Walk`."""
    return LinearSlam(np.eye(2), Q, STEP, Kalman(np.zeros(2), np.zeros((2, 2))), np.eye(2), seed=31)


def turned() -> LinearSlam:
    """The world of a robot that starts at `TURNED` and goes `ALONG`."""
    turn = SE2.rotation(TURNED)
    return LinearSlam(np.eye(2), turn @ Q @ turn.T, turn @ STEP, Kalman(TURNED[1:], np.zeros((2, 2))), turn, seed=32)


def velocity() -> Kalman:
    """Of the position and the velocity of `DRIFTING` at the start."""
    return Kalman(np.array([0.0, 0.0, 0.6, 0.2]), np.diag([0.0, 0.0, 0.3, 0.2]))


def moments(filter_: Filter) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance, within and between particles, of (position[, velocity], landmarks)."""
    weights = filter_.particles.weights
    means, within = [filter_.particles.state[:, -2:]], [np.zeros((2, 2))]
    for part in filter_.marginals.parts.values():
        if isinstance(part, KalmanSubstate):
            means.append(part.mean)
            within.append(np.einsum("n,nab->ab", weights, part.cov))
        elif isinstance(part, LandmarkMap):
            records = part.read(part.ids)
            means.extend(np.moveaxis(records.mean, 1, 0))
            within.extend(np.einsum("n,nkab->kab", weights, records.cov))
    mean = np.concatenate(means, axis=1)
    centre = weights @ mean
    spread = mean - centre
    return centre, block_diag(*within) + np.einsum("n,na,nb->ab", weights, spread, spread)


def unnormalised_errors(
    build: Callable[[np.random.Generator], Filter],
    frames: Sequence[Frame],
    exact: Kalman,
    stream: int,
    control: object = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per seed: log Ẑ/Z, and Ẑ/Z times the errors of first and second moments about the exact mean.
    The errors have the expectation zero: Ẑ Σ W f(x) is unbiased for Z E[f | z], as Ẑ is for Z."""
    logs, first, second = [], [], []
    for seed in range(SEEDS):
        filter_ = build(np.random.default_rng([stream, seed]))
        for frame in frames:
            filter_.step(frame, control)
        logs.append(filter_.log_evidence - exact.log_evidence)
        ratio = np.exp(logs[-1])
        mean, cov = moments(filter_)
        error = mean - exact.mean
        first.append(ratio * error)
        second.append(ratio * (cov + np.outer(error, error) - exact.cov))
    return np.array(logs), np.array(first), np.array(second)
