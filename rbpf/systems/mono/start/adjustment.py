"""The first frames of a run, and their adjustment in one piece: path, features and, where it is not known, the camera.

A feature is a direction d, a unit vector, and an inverse distance q, both from the first camera, which is the origin: the
camera (R, t) sees it in the direction c = Rᵀ(d − q t), however far it is. What is minimised is Mathematics (start-cost).
"""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_triangular
from scipy.special import exp1

from rbpf.core.checkpoint import integers, numbers, poses, read, split
from rbpf.core.filter import Filter
from rbpf.core.models import Belief
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import clamp_depth
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.systems.mono.active_search import CAUCHY_SCALE
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.feature_table import directions
from rbpf.systems.system import Revision

MIN_VIEWS = 3  #: Frames that must see a feature for it to take part.
MIN_FRAMES = 3
#: Features that two frames in a row must have in common: three determine a pose, and half of them may be wrong.
MIN_SHARED = 6
SCALE_STD = 1e-4  #: Standard deviation to which the scale is held.
MAX_STEPS, MIN_GAIN = 30, 1e-4  #: Steps of the adjustment at most, and the fraction of the cost that ends it.
SAME_COST = 10.0 * MIN_GAIN  #: Two minima whose costs differ by less than this fraction are one.
#: Times the noise: residuals that a minimum is far from, and by how much less each time on the way to it.
FAR, NEARER = 1.5, 3.0
_HALF = CAUCHY_SCALE**2 / 2.0
_BEYOND = float(np.exp(_HALF) * exp1(_HALF))
LOSS_INFORMATION = (1.0 - _HALF * _BEYOND) ** 2 / ((_BEYOND + _HALF * _BEYOND - 1.0) * _HALF * _BEYOND)
"""How many times Gauss's and Newton's information with the loss's weights w is known where noise is Gaussian: 1.27.

The estimate's is (E ψ′)²/E ψ² of a least-squares fit's (P. Huber, 1981), the weights' is E w of it. In two dimensions, with
a = c²/2 of Cauchy's scale c and G = eᵃ E₁(a): E ψ′ = a − a²G, E ψ² = a²(G + aG − 1), E w = aG.
"""

FARTHEST = 0.2  #: Times the mean inverse distance: no feature is farther away after a reversal.
CHI2_MEDIAN = float(2.0 * np.log(2.0))  #: Of χ² with two degrees of freedom.
#: A velocity that cannot change has no density: at least so much it walks in a second, rad/s, m/s.
MIN_STD_VELOCITY = 1e-6
#: Of Levenberg's and Marquardt's method: at first, its change after a step, and where there is no way down.
DAMPING, DAMPING_FACTOR, MAX_DAMPING = 1e-3, 5.0, 1e8
_PREFIX = "start/frames/"
_FRAMES = {
    "all_ns": integers("all"),
    "stamps_ns": integers("frames"),
    "counts": integers("frames", least=0),
    "names": integers("seen", least=0),
    "px": numbers("seen", 2),
    "cov_px": numbers("seen", 2, 2),
    "path": poses("frames"),
    "last": poses(),
}


@final
class FirstFrames:
    """What was seen in the first frames, and from where (7,) as far as is known, in the particles' world.

    Attributes:
        stamps_ns: of all frames.
        seen: those that are kept.
        path: as many poses, from which an adjustment may start.
        last: where the last camera is in the particles' world, from which the next pose is counted on.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        self.stamps_ns: list[int] = []
        self.seen: list[FeatureFrame] = []
        self.path: list[np.ndarray] = []
        self.last = SE3.identity()

    def note(self, seen: FeatureFrame, pose: np.ndarray) -> None:
        """The next frame; of its pose counts how far it is from the last one."""
        self.stamps_ns.append(seen.stamp_ns)
        self.seen.append(seen)
        self.path.append(SE3.compose(self.path[-1], SE3.between(self.last, pose)) if self.path else pose)
        self.last = pose

    def thin(self, most: int) -> None:
        """Of more than `most` those are dropped that lie closest for their age: the longer ago, the fewer are left."""
        while len(self.seen) > most:
            at = np.array([frame.stamp_ns for frame in self.seen])
            dropped = 1 + int(np.argmin((at[2:] - at[:-2]) / np.maximum(at[-1] - at[1:-1], 1)))
            del self.seen[dropped], self.path[dropped]

    def seen_first(self, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Names (F,) of all features, and from where (F, 7) on the path (T, 7) of all frames each of them was seen first."""
        names, first = np.unique(np.concatenate([frame.landmarks for frame in self.seen]), return_index=True)
        stamps = np.repeat([frame.stamp_ns for frame in self.seen], [frame.landmarks.size for frame in self.seen])
        return names, path[np.searchsorted(self.stamps_ns, stamps[first])]

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint; nothing where there are none."""
        if not self.seen:
            return {}
        found = {
            "all_ns": np.array(self.stamps_ns, dtype=np.int64),
            "stamps_ns": np.array([frame.stamp_ns for frame in self.seen], dtype=np.int64),
            "counts": np.array([frame.landmarks.size for frame in self.seen], dtype=np.int64),
            "names": np.concatenate([frame.landmarks for frame in self.seen]),
            "px": np.concatenate([frame.z for frame in self.seen]),
            "cov_px": np.concatenate([frame.cov_z for frame in self.seen]),
            "path": np.array(self.path),
            "last": self.last,
        }
        return {f"{_PREFIX}{name}": array for name, array in found.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`; errors as `rbpf.core.checkpoint.read`."""
        self.clear()
        if f"{_PREFIX}stamps_ns" in arrays:
            held = read(arrays, _FRAMES, _PREFIX)
            columns = held["names"], held["px"], held["cov_px"]
            parts = zip(*(split(column, held["counts"].tolist(), _PREFIX[:-1]) for column in columns), strict=True)
            self.stamps_ns = held["all_ns"].tolist()
            self.seen = [FeatureFrame(t, *part) for t, part in zip(held["stamps_ns"].tolist(), parts, strict=True)]
            self.path, self.last = list(held["path"]), held["last"]


@dataclass(frozen=True)
class Adjusted:
    """What an adjustment of the first T frames leaves."""

    filter: Filter  #: that goes on, in place of the one so far.
    revision: Revision  #: of all poses so far.
    seen_first: tuple[np.ndarray, np.ndarray]  #: names (F,) of all features, and from where (F, 7) they were.


def between(times: np.ndarray, paths: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Poses (W, n, 7) of paths (n, T, 7) at other times (W,): on the way between two, or the first or the last."""
    moved = SE3.log(SE3.between(paths[:, :-1], paths[:, 1:]))
    k = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, times.size - 2)
    fraction = np.clip((wanted - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)
    return np.swapaxes(SE3.retract(paths[:, k], fraction[:, None] * moved[:, k]), 0, 1)


@dataclass(frozen=True)
class Known:
    """Which M features (M,) are at known positions (M, 3), with whiteners (M, 3, 3) of their errors."""

    feature: np.ndarray
    positions: np.ndarray
    whitener: np.ndarray


@dataclass(frozen=True)
class Window:
    """What T frames saw of F features, K observations in all."""

    camera: Pinhole  #: of the images.
    stamps_ns: np.ndarray  #: (T,) of the frames.
    frame: np.ndarray  #: (K,) in which of them.
    feature: np.ndarray  #: (K,) which one; no feature twice in a frame.
    px: np.ndarray  #: (K, 2) where.
    noise_px: float  #: standard deviation, per axis.
    known: Known | None = None  #: those of the features whose place is known.
    tuning: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  #: (k, k) information of the camera's `tuned`.

    def is_connected(self) -> bool:
        """Whether every two frames in a row have enough features in common."""
        sees = np.zeros((self.stamps_ns.size, self.feature.max(initial=-1) + 1), dtype=bool)
        sees[self.frame, self.feature] = True
        return bool(((sees[1:] & sees[:-1]).sum(axis=1) >= MIN_SHARED).all())


def gathered(
    first: FirstFrames, features: FeatureSensor, belief: Belief, most: int, min_views: int = MIN_VIEWS
) -> tuple[np.ndarray, np.ndarray, Window, "Structure"] | None:
    """Numbers (T,) of `most` frames to adjust, names (F,) of features in the map that were seen often enough, what was seen.

    The frames see something, with a stamp of their own, the first and the last among them. Last, where path and features are
    as far as the particles know. None: too few frames.
    """
    stamps = np.array([frame.stamp_ns for frame in first.seen])
    fresh = np.append(True, np.diff(stamps) > 0) & [frame.landmarks.size > 0 for frame in first.seen]
    steps = np.flatnonzero(fresh)
    if steps.size < MIN_FRAMES:
        return None
    steps = steps[np.linspace(0, steps.size - 1, min(most, steps.size)).round().astype(np.int64)]
    chosen = [first.seen[t] for t in steps.tolist()]
    seen_by = np.concatenate([frame.landmarks for frame in chosen])
    held = belief.map.holds(seen_by) | (features.members(seen_by) >= 0)
    names, views = np.unique(seen_by[held], return_counts=True)
    names = names[views >= min_views]
    parts = [np.isin(frame.landmarks, names) for frame in chosen]
    seen = Window(
        features.camera,
        stamps[steps],
        np.repeat(np.arange(len(chosen)), [part.sum() for part in parts]),
        np.searchsorted(names, seen_by[np.concatenate(parts)]),
        np.concatenate([f.z[p] for f, p in zip(chosen, parts, strict=True)]),
        float(np.sqrt(np.mean([np.trace(cov) / 2.0 for frame in chosen for cov in frame.cov_z]))),
    )
    which, position = features.positions(belief, names)
    path, position = np.array(first.path)[steps], position[np.argsort(which)]
    direction = directions(position, path[0])
    length = np.linalg.norm(direction, axis=1)
    start = Structure(SE3.between(path[:1], path), direction / length[:, None], position[:, 3] / length)
    return steps, names, seen, start


@final
@dataclass(frozen=True)
class Structure:
    """Paths and features."""

    path: np.ndarray  #: (T, 7) world_from_camera; the first one is the identity.
    direction: np.ndarray  #: (F, 3) unit vectors.
    inverse: np.ndarray  #: (F,) 1/m.
    tuned: np.ndarray = field(default_factory=lambda: np.zeros(0))  #: (k,) of the camera, where it is not known.
    frame: np.ndarray | None = None  #: (7,) first camera_from_known of the known points' frame, where there are some.

    def moved(self, step: np.ndarray) -> "Structure":
        """By a step (6 (T − 1) + 3 F + k + 6,) in the right charts of the poses, the tangent planes and 1/m."""
        free = 6 * (self.path.shape[0] - 1)
        end = free + 3 * self.inverse.size
        path, of_features = self.path.copy(), step[free:end].reshape(-1, 3)
        tuned, left = self.tuned + step[end : end + self.tuned.size], step[end + self.tuned.size :]
        frame = None if self.frame is None else SE3.retract(self.frame, left)
        path[1:] = SE3.retract(path[1:], step[:free].reshape(-1, 6))
        direction = self.direction + (tangents(self.direction) @ of_features[:, :2, None])[..., 0]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return Structure(path, direction, self.inverse + of_features[:, 2], tuned, frame)

    def reversed(self) -> "Structure":
        """What is near is far and what is far is near, along the same path.

        From little parallax both shapes look alike, with a turn in place of a shift (L. Necker's reversal).
        """
        middle = float(self.inverse.mean())
        return replace(self, inverse=np.maximum(2.0 * middle - self.inverse, FARTHEST * middle))


@final
@dataclass(frozen=True)
class Optimum:
    """A minimum."""

    structure: Structure  #: there.
    cost: float  #: the sum above.
    #: (6 (T − 1) + 3 F + k + 6, …) of the step from it: its inverse is the covariance of the minimum's error.
    information: np.ndarray

    @cached_property
    def _factor(self) -> np.ndarray:
        return np.asarray(cholesky(self.information, lower=True))

    @cached_property
    def log_weight(self) -> float:
        """Logarithm of how much of the posterior lies about this minimum, up to what all minima share (P. Laplace)."""
        return -self.cost - float(np.log(np.diag(self._factor)).sum())

    def paths(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Paths (n, T, 7) drawn from the Gaussian about the minimum (P. Laplace's approximation)."""
        whitened = rng.standard_normal((self.information.shape[0], n))
        step = solve_triangular(self._factor.T, whitened, lower=False).T
        path = self.structure.path
        out = np.broadcast_to(path, (n, *path.shape)).copy()
        out[:, 1:] = SE3.retract(path[1:], step[:, : 6 * (path.shape[0] - 1)].reshape(n, -1, 6))
        return out

    def depth_std_ratio(self, features: np.ndarray) -> float:
        """Median standard deviation of the inverse distances of some features, as a fraction of each; infinite of none."""
        relative = (self.std_inverse() / np.maximum(self.structure.inverse, np.finfo(float).tiny))[features]
        return float(np.median(relative)) if relative.size else np.inf

    def std_inverse(self) -> np.ndarray:
        """Standard deviations (F,) of the inverse distances, 1/m."""
        count = self.structure.inverse.size
        rows = np.arange(count) * 3 + 2 + 6 * (len(self.structure.path) - 1)
        picked = np.zeros((self.information.shape[0], count))
        picked[rows, np.arange(count)] = 1.0
        half = solve_triangular(self._factor, picked, lower=True)
        return np.asarray(np.sqrt(np.square(half).sum(axis=0)))


def optimum(seen: Window, config: MonoConfig, start: Structure) -> Optimum | None:
    """The minimum that lies downhill from a start; None: none.

    What is expected before anything is seen, of inverse distances and velocities, is that of the settings. Where residuals are
    far beyond the noise the loss is all but flat: from there by way of minima with more noise (graduated non-convexity: A.
    Blake and A. Zisserman 1987).
    """
    now = Linearised(seen, config, start)
    noise_px = min(now.spread_px(), float(seen.camera.width))
    while noise_px > FAR * seen.noise_px:
        nearer = _downhill(Linearised(replace(seen, noise_px=noise_px), config, now.at))
        if nearer is None:
            return None
        now, noise_px = Linearised(seen, config, nearer.structure), noise_px / NEARER
    return _downhill(now)


def minima(seen: Window, config: MonoConfig, start: Structure, reverse: bool) -> list[Optimum]:
    """Likeliest first: `optimum`, and with `reverse` that from its result with near and far exchanged, if it is another."""
    best = optimum(seen, config, start)
    other = optimum(seen, config, best.structure.reversed()) if reverse and best is not None else None
    found = [each for each in (best, other) if each is not None]
    if len(found) == 2 and abs(found[1].cost - found[0].cost) < SAME_COST * (1.0 + found[0].cost):
        del found[1]
    return sorted(found, key=lambda each: -each.log_weight)


def _downhill(now: "Linearised") -> Optimum | None:
    """By Levenberg's and Marquardt's method on the normal equations."""
    damping = DAMPING
    for _ in range(MAX_STEPS):
        information, vector = now.normal_equations()
        while True:
            ahead = None
            with suppress(LinAlgError, ValueError):  # ValueError where it is not finite
                factor = cho_factor(information + damping * np.diag(np.diag(information)))
                ahead = Linearised(now.seen, now.config, now.at.moved(np.asarray(cho_solve(factor, vector))))
            if ahead is not None and ahead.cost < now.cost:
                break
            damping *= DAMPING_FACTOR
            if damping > MAX_DAMPING:
                return now.optimum()
        damping /= DAMPING_FACTOR
        gain, now = now.cost - ahead.cost, ahead
        if gain < MIN_GAIN * (1.0 + now.cost):
            break
    return now.optimum()


def residual_px(seen: Window, config: MonoConfig, best: Optimum) -> float:
    """Standard deviation per axis, px, of what was seen, as the residuals of a minimum say it: by their median."""
    count = 2 * seen.frame.size
    free = count - best.information.shape[0]
    return Linearised(seen, config, best.structure).spread_px() * float(np.sqrt(count / free)) if free > 0 else 0.0


@final
class Linearised:
    """All residuals at a structure, whitened; their derivatives where they are asked for."""

    def __init__(self, seen: Window, config: MonoConfig, at: Structure) -> None:
        self.seen, self.config, self.rho, self.at = seen, config, config.inverse_depth, at
        pose, feature = at.path[seen.frame], seen.feature
        position = SE3.translation(pose)
        place = at.direction[feature] + (1.0 - at.inverse[feature, None]) * position
        self._direction = clamp_depth(SE3.inverse_transform(pose, place))
        self.camera = seen.camera.tuned(at.tuned) if at.tuned.size else seen.camera
        self.misfit = (seen.px - self.camera.project(self._direction)) / seen.noise_px
        squared = np.square(self.misfit).sum(axis=1) / CAUCHY_SCALE**2
        self.weight = 1.0 / (1.0 + squared)
        self._interval = np.diff(seen.stamps_ns) * 1e-9
        self._relative = SE3.between(at.path[:-1], at.path[1:])
        # Of the first mean velocity and the differences of mean velocities: that over an interval δ is v + w₁/δ with the noise
        # of E06 (5), so that the difference from the one before has the variance (δ + δ′)/3 of the walk's in a second, and
        # shares δ/6 with the difference after it.
        interval, before = self._interval, np.concatenate([[0.0], self._interval[:-1]])
        walk = np.diag((before + interval) / 3.0) + np.diag(interval[:-1] / 6.0, 1) + np.diag(interval[:-1] / 6.0, -1)
        cov = np.square(np.maximum(config.velocity.walk_std(), MIN_STD_VELOCITY))[:, None, None] * walk
        cov[:, 0, 0] += np.square(np.maximum(config.velocity.start_std(), MIN_STD_VELOCITY))
        self._whitener = np.linalg.inv(np.linalg.cholesky(cov))
        self.velocity = self._differences(SE3.log(self._relative) / self._interval[:, None])
        self.prior = (at.inverse - self.rho.mean_per_m) / self.rho.std_per_m
        # The scale is the known points', or held.
        holding = np.bincount(feature, minlength=at.inverse.size) >= MIN_VIEWS
        self._by_scale = (
            0.0 * holding if seen.known else holding / (max(holding.sum(), 1) * self.rho.mean_per_m * SCALE_STD)
        )
        self.scale = 0.0 if seen.known else float(self._by_scale @ at.inverse - 1.0 / SCALE_STD)
        self.known = np.zeros((0, 3))
        if seen.known is not None and at.frame is not None:
            self._places = (at.direction / at.inverse[:, None])[seen.known.feature]
            self._local = SE3.inverse_transform(at.frame, self._places)
            self.known = (seen.known.whitener @ (self._local - seen.known.positions)[..., None])[..., 0]
        quadratic = sum(np.square(part).sum() for part in (self.velocity, self.prior, self.scale, self.known))
        quadratic += at.tuned @ seen.tuning @ at.tuned
        self.cost = float(0.5 * CAUCHY_SCALE**2 * np.log1p(squared).sum() + 0.5 * quadratic)

    def _differences(self, velocity: np.ndarray) -> np.ndarray:
        """The first of T − 1 rows, and from row to row, whitened."""
        moved = np.concatenate([velocity[:1], np.diff(velocity, axis=0)])
        return np.einsum("ktj,jk...->tk...", self._whitener, moved)

    def spread_px(self) -> float:
        """Standard deviation per axis, px, that the residuals have, by their median."""
        squared = np.square(self.misfit).sum(axis=1)
        return self.seen.noise_px * float(np.sqrt(np.median(squared) / CHI2_MEDIAN))

    def optimum(self) -> Optimum | None:
        """This structure as a minimum; None where it is not finite."""
        information = self.normal_equations(LOSS_INFORMATION)[0]
        is_finite = np.isfinite(self.cost) and np.isfinite(information).all()
        return Optimum(self.at, self.cost, information) if is_finite else None

    def normal_equations(self, loss_information: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Gauss and Newton's: information of the step, what was seen counting so often, and the vector it is solved with."""
        seen, at, direction = self.seen, self.at, self._direction
        frames, features = at.path.shape[0], at.inverse.size
        free = 6 * frames
        end = free + 3 * features
        frame = end + at.tuned.size
        size = frame + (0 if seen.known is None else 6)
        h, b = np.zeros((size, size)), np.zeros(size)
        of_poses = h[:free, :free].reshape(frames, 6, frames, 6)
        of_features = h[free:end, free:end].reshape(features, 3, features, 3)
        across = h[:free, free:end].reshape(frames, 6, features, 3)

        # Derivatives of what should be seen by the pose (K, 2, 6) and by the feature (K, 2, 3).
        pose, inverse = at.path[seen.frame], at.inverse[seen.feature, None, None]
        slope = self.camera.jacobian(direction) / seen.noise_px
        by_pose = np.concatenate([np.cross(slope, direction[:, None, :]), -inverse * slope], axis=2)
        turned = slope @ np.swapaxes(SE3.rotation(pose), 1, 2)
        along = turned @ tangents(at.direction)[seen.feature]
        by_feature = np.concatenate([along, -turned @ SE3.translation(pose)[:, :, None]], axis=2)

        # What was seen, each observation with its loss's weight.
        of_pose, of_feature = (np.swapaxes(self.weight[:, None, None] * by, 1, 2) for by in (by_pose, by_feature))
        each = np.arange(frames), np.arange(features)
        of_poses[each[0], :, each[0]] = _summed(of_pose @ by_pose, seen.frame, frames)
        of_features[each[1], :, each[1]] = _summed(of_feature @ by_feature, seen.feature, features)
        across[seen.frame, :, seen.feature] = of_pose @ by_feature
        misfit = self.misfit[..., None]
        b[:free] = _summed((of_pose @ misfit)[..., 0], seen.frame, frames).ravel()
        b[free:end] = _summed((of_feature @ misfit)[..., 0], seen.feature, features).ravel()
        if at.tuned.size:
            by_camera = self.camera.by_tuning(direction) / seen.noise_px
            of_camera = np.swapaxes(self.weight[:, None, None] * by_camera, 1, 2)
            h[:free, end:frame] = _summed(of_pose @ by_camera, seen.frame, frames).reshape(free, -1)
            h[free:end, end:frame] = _summed(of_feature @ by_camera, seen.feature, features).reshape(end - free, -1)
            h[end:frame, end:frame] = (of_camera @ by_camera).sum(axis=0)
            b[end:frame] = (of_camera @ misfit)[..., 0].sum(axis=0)
        h *= loss_information
        h[free:, :free], h[end:, free:end] = h[:free, free:].T, h[free:end, end:].T
        h[end:frame, end:frame] += seen.tuning
        b[end:frame] -= seen.tuning @ at.tuned

        # Velocities between frames; their logarithms' derivatives by the poses to first order in a step.
        steps = frames - 1
        by_poses, k = np.zeros((steps, 6, frames, 6)), np.arange(steps)
        by_poses[k, :, k + 1] = np.eye(6) / self._interval[:, None, None]
        by_poses[k, :, k] = -SE3.adjoint(SE3.inverse(self._relative)) / self._interval[:, None, None]
        of_velocity = self._differences(by_poses.reshape(steps, 6, -1)).reshape(6 * steps, -1)
        h[:free, :free] += of_velocity.T @ of_velocity
        b[:free] -= of_velocity.T @ self.velocity.ravel()

        # The prior of the inverse distances, and the scale.
        q = free + 2 + 3 * np.arange(features)
        h[q, q] += self.rho.std_per_m**-2
        h[np.ix_(q, q)] += np.outer(self._by_scale, self._by_scale)
        b[q] -= self.prior / self.rho.std_per_m + self.scale * self._by_scale

        # The known points, in their own frame.
        if seen.known is not None and at.frame is not None:
            rows, q = np.zeros((*self.known.shape, size)), at.inverse[seen.known.feature, None, None]
            back = np.swapaxes(SE3.rotation(at.frame), 0, 1)
            place = np.concatenate([tangents(at.direction)[seen.known.feature], -self._places[..., None]], axis=2)
            for m, feature in enumerate(seen.known.feature.tolist()):
                rows[m, :, free + 3 * feature : free + 3 * feature + 3] = back @ place[m] / q[m]
            rows[:, :, frame:] = -SE3.transform_jacobian(self._local)
            by_all = (seen.known.whitener @ rows).reshape(-1, size)
            h += by_all.T @ by_all
            b -= by_all.T @ self.known.ravel()
        return h[6:, 6:], b[6:]


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
