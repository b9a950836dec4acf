"""The most probable path and structure of a camera's first frames, found all at once, and paths drawn around it.

A feature is a direction d, a unit vector, and an inverse distance q, both from the first camera, which is the origin:
the camera (R, t) sees it in the direction c = Rᵀ(d − q t), however far it is. Minimised is, Mathematics (start-cost),

    Σ ρ(|z − h(c)|/σ) + ½ Σ ((q − q̄)/σ_q)² + ½ Σ |(v_k − v_{k−1})/σ_v|² + ½ ((s − 1)/σ_s)²,

with Cauchy's loss ρ, the prior of an inverse distance, velocities v between frames that walk as in E06 (4), and the
scale s = Σ q / (F q̄), which no image tells: it is held. Levenberg's and Marquardt's method finds the minimum.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_triangular

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import clamp_depth
from rbpf.systems.mono.consensus import SCALE

SCALE_STD = 1e-4
"""Standard deviation to which the scale is held."""

ROUNDS, GAIN = 30, 1e-4
"""Steps at most, and the fraction of the cost that ends it."""

DAMPING, FACTOR, STUCK = 1e-3, 5.0, 1e8
"""Of Levenberg's and Marquardt's method: at first, its change after a step, and where there is no way down."""


@dataclass(frozen=True)
class Window:
    """What T frames saw of F features, K sightings in all.

    Attributes:
        camera: of the images.
        stamps_ns: (T,) of the frames.
        frame: (K,) in which of them.
        feature: (K,) which one; no feature twice in a frame.
        px: (K, 2) where.
        noise_px: standard deviation, per axis.
    """

    camera: Pinhole
    stamps_ns: np.ndarray
    frame: np.ndarray
    feature: np.ndarray
    px: np.ndarray
    noise_px: float


@dataclass(frozen=True)
class Expected:
    """What is expected before anything is seen.

    Attributes:
        rho: mean and standard deviation of an inverse distance, 1/m.
        std_start: (6,) of the velocity at first, rad/s, m/s.
        std_walk: (6,) of its walk in one second, (rad/s, m/s)/√s.
    """

    rho: tuple[float, float]
    std_start: np.ndarray
    std_walk: np.ndarray


@final
@dataclass(frozen=True)
class Structure:
    """Paths and features.

    Attributes:
        path: (T, 7) world_from_camera; the first one is the identity.
        direction: (F, 3) unit vectors.
        inverse: (F,) 1/m.
    """

    path: np.ndarray
    direction: np.ndarray
    inverse: np.ndarray

    def moved(self, step: np.ndarray) -> "Structure":
        """By a step (6 (T − 1) + 3 F,) in the right charts of the poses, the tangent planes and 1/m."""
        free = 6 * (self.path.shape[0] - 1)
        path, of_features = self.path.copy(), step[free:].reshape(-1, 3)
        path[1:] = SE3.retract(path[1:], step[:free].reshape(-1, 6))
        direction = self.direction + (tangents(self.direction) @ of_features[:, :2, None])[..., 0]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return Structure(path, direction, self.inverse + of_features[:, 2])


@final
@dataclass(frozen=True)
class Optimum:
    """A minimum.

    Attributes:
        structure: there.
        cost: the sum above.
        information: (6 (T − 1) + 3 F, …) of the step from it, by Gauss and Newton with the losses' weights.
    """

    structure: Structure
    cost: float
    information: np.ndarray

    @cached_property
    def _factor(self) -> np.ndarray:
        return np.asarray(cholesky(self.information, lower=True))

    def paths(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Paths (n, T, 7) drawn from the Gaussian about the minimum (P. Laplace's approximation)."""
        whitened = rng.standard_normal((self.information.shape[0], n))
        step = solve_triangular(self._factor.T, whitened, lower=False).T
        path = self.structure.path
        out = np.broadcast_to(path, (n, *path.shape)).copy()
        out[:, 1:] = SE3.retract(path[1:], step[:, : 6 * (path.shape[0] - 1)].reshape(n, -1, 6))
        return out

    def std_inverse(self) -> np.ndarray:
        """Standard deviations (F,) of the inverse distances, 1/m."""
        count = self.structure.inverse.size
        rows = np.arange(count) * 3 + 2 + self.information.shape[0] - 3 * count
        picked = np.zeros((self.information.shape[0], count))
        picked[rows, np.arange(count)] = 1.0
        half = solve_triangular(self._factor, picked, lower=True)
        return np.asarray(np.sqrt(np.square(half).sum(axis=0)))


def optimum(seen: Window, expected: Expected, start: Structure) -> Optimum:
    """The minimum that lies downhill from a start."""
    now, damping = Linearised(seen, expected, start), DAMPING
    for _ in range(ROUNDS):
        information, vector = now.normal_equations()
        while True:
            step = _solved(information, vector, damping)
            ahead = None if step is None else Linearised(seen, expected, now.at.moved(step))
            if ahead is not None and ahead.cost < now.cost:
                break
            damping *= FACTOR
            if damping > STUCK:
                return Optimum(now.at, now.cost, information)
        damping /= FACTOR
        gain, now = now.cost - ahead.cost, ahead
        if gain < GAIN * (1.0 + now.cost):
            break
    return Optimum(now.at, now.cost, now.normal_equations()[0])


def _solved(information: np.ndarray, vector: np.ndarray, damping: float) -> np.ndarray | None:
    damped = information + damping * np.diag(np.diag(information))
    try:
        return np.asarray(cho_solve(cho_factor(damped), vector))
    except LinAlgError:
        return None


@final
class Linearised:
    """All residuals at a structure, whitened; their derivatives where they are asked for."""

    def __init__(self, seen: Window, expected: Expected, at: Structure) -> None:
        self.seen, self.expected, self.at = seen, expected, at
        pose, feature = at.path[seen.frame], seen.feature
        position = SE3.translation(pose)
        place = at.direction[feature] + (1.0 - at.inverse[feature, None]) * position
        self._direction = clamp_depth(SE3.inverse_transform(pose, place))
        self.misfit = (seen.px - seen.camera.project(self._direction)) / seen.noise_px
        squared = np.square(self.misfit).sum(axis=1) / SCALE**2
        self.weight = 1.0 / (1.0 + squared)
        self._interval = np.diff(seen.stamps_ns) * 1e-9
        self._relative = SE3.between(at.path[:-1], at.path[1:])
        walked = expected.std_walk * np.sqrt(self._interval[1:, None])
        self._std_velocity = np.concatenate([expected.std_start[None], walked])
        self.velocity = self._differences(SE3.log(self._relative) / self._interval[:, None])
        self.prior = (at.inverse - expected.rho[0]) / expected.rho[1]
        self._by_scale = 1.0 / (at.inverse.size * expected.rho[0] * SCALE_STD)
        self.scale = float(self._by_scale * at.inverse.sum() - 1.0 / SCALE_STD)
        quadratic = sum(np.square(part).sum() for part in (self.velocity, self.prior, self.scale))
        self.cost = float(0.5 * SCALE**2 * np.log1p(squared).sum() + 0.5 * quadratic)

    def _differences(self, velocity: np.ndarray) -> np.ndarray:
        """The first of T − 1 rows, and from row to row, in standard deviations."""
        moved = np.concatenate([velocity[:1], np.diff(velocity, axis=0)])
        return np.asarray(moved / self._std_velocity.reshape(-1, 6, *[1] * (velocity.ndim - 2)))

    def normal_equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Gauss and Newton's: information of the step, and the vector that it is solved with."""
        seen, frames, features = self.seen, self.at.path.shape[0], self.at.inverse.size
        free = 6 * frames
        by_pose, by_feature = self._slopes()
        weighted_pose, weighted_feature = (self.weight[:, None, None] * j for j in (by_pose, by_feature))
        h, b = np.zeros((free + 3 * features,) * 2), np.zeros(free + 3 * features)
        turned_pose, turned_feature = (np.swapaxes(j, 1, 2) for j in (weighted_pose, weighted_feature))
        of_poses = h[:free, :free].reshape(frames, 6, frames, 6)
        of_features = h[free:, free:].reshape(features, 3, features, 3)
        across = h[:free, free:].reshape(frames, 6, features, 3)
        each = np.arange(frames), np.arange(features)
        of_poses[each[0], :, each[0]] = _summed(turned_pose @ by_pose, seen.frame, frames)
        of_features[each[1], :, each[1]] = _summed(turned_feature @ by_feature, seen.feature, features)
        across[seen.frame, :, seen.feature] = turned_pose @ by_feature
        h[free:, :free] = h[:free, free:].T
        misfit = self.misfit[..., None]
        b[:free] = _summed((turned_pose @ misfit)[..., 0], seen.frame, frames).ravel()
        b[free:] = _summed((turned_feature @ misfit)[..., 0], seen.feature, features).ravel()
        self._add_motion(h[:free, :free], b[:free])
        q = free + 2 + 3 * np.arange(features)
        h[q, q] += self.expected.rho[1] ** -2
        h[np.ix_(q, q)] += self._by_scale**2
        b[q] -= self.prior / self.expected.rho[1] + self.scale * self._by_scale
        return h[6:, 6:], b[6:]

    def _slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of what should be seen by the pose (K, 2, 6) and the feature (K, 2, 3)."""
        seen, at, direction = self.seen, self.at, self._direction
        pose, inverse = at.path[seen.frame], at.inverse[seen.feature, None, None]
        slope = seen.camera.jacobian(direction) / seen.noise_px
        by_pose = np.concatenate([np.cross(slope, direction[:, None, :]), -inverse * slope], axis=2)
        turned = slope @ np.swapaxes(SE3.rotation(pose), 1, 2)
        along = turned @ tangents(at.direction)[seen.feature]
        return by_pose, np.concatenate([along, -turned @ SE3.translation(pose)[:, :, None]], axis=2)

    def _add_motion(self, h: np.ndarray, b: np.ndarray) -> None:
        """Of the velocities between frames; their logarithms' derivatives by the poses to first order in a step."""
        steps = self._interval.size
        by_pose, k = np.zeros((steps, 6, steps + 1, 6)), np.arange(steps)
        by_pose[k, :, k + 1] = np.eye(6) / self._interval[:, None, None]
        by_pose[k, :, k] = -SE3.adjoint(SE3.inverse(self._relative)) / self._interval[:, None, None]
        slope = self._differences(by_pose.reshape(steps, 6, -1)).reshape(6 * steps, -1)
        h += slope.T @ slope
        b -= slope.T @ self.velocity.ravel()


def tangents(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors (F, 3, 2) across each unit vector (F, 3) and one another."""
    helper = np.where(np.abs(direction[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=-1)


def _summed(parts: np.ndarray, row: np.ndarray, count: int) -> np.ndarray:
    """Sums (count, …) of parts (K, …) by their rows (K,)."""
    out = np.zeros((count, *parts.shape[1:]))
    np.add.at(out, row, parts)
    return out
