"""Batch adjustment (bundle adjustment) of a run's first frames: path, features and, for self-calibration, the camera.

A feature is a direction d, a unit vector, and an inverse distance q, both relative to the first camera, the origin: the
camera (R, t) observes it in the direction c = Rᵀ(d − q t), at any distance. The cost is Mathematics (start-cost).
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

MIN_VIEWS = 3  #: Least observations of a feature.
MIN_FRAMES = 3
#: Features that consecutive frames must share: three determine a pose, and half of them may be wrong.
MIN_SHARED = 6
SCALE_STD = 1e-4  #: Standard deviation of the scale constraint.
MAX_STEPS, MIN_GAIN = 30, 1e-4  #: Maximum steps, and the relative decrease of the cost that ends the adjustment.
SAME_COST = 10.0 * MIN_GAIN  #: Minima whose costs differ by less than this fraction are identical.
#: Graduated non-convexity: residuals over noise at which it starts, and factor by which the noise is reduced.
FAR, NEARER = 1.5, 3.0
_HALF = CAUCHY_SCALE**2 / 2.0
_BEYOND = float(np.exp(_HALF) * exp1(_HALF))
LOSS_INFORMATION = (1.0 - _HALF * _BEYOND) ** 2 / ((_BEYOND + _HALF * _BEYOND - 1.0) * _HALF * _BEYOND)
"""Correction factor of the Gauss-Newton information with the loss's weights w, for Gaussian noise: 1.27.

The estimate's is (E ψ′)²/E ψ² of that of least squares (P. Huber, 1981), Gauss-Newton's E w of it. In two dimensions, with
a = c²/2 of Cauchy's scale c and G = eᵃ E₁(a): E ψ′ = a − a²G, E ψ² = a²(G + aG − 1), E w = aG.
"""

FARTHEST = 0.2  #: Least inverse distance after a reversal, relative to the mean.
CHI2_MEDIAN = float(2.0 * np.log(2.0))  #: Median of χ² with two degrees of freedom.
#: Least random walk of the velocity in one second, rad/s, m/s, so that its density exists.
MIN_STD_VELOCITY = 1e-6
#: Levenberg-Marquardt damping: initial value, its factor per step, and the value that ends the iteration.
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
    """Observations of the first frames, and approximate poses (7,) in the particles' world.

    Attributes:
        stamps_ns: (T,) of all frames.
        seen: the frames.
        path: their poses, initial values of an adjustment.
        last: the last camera pose in the particles' world, reference of the next increment.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        self.stamps_ns: list[int] = []
        self.seen: list[FeatureFrame] = []
        self.path: list[np.ndarray] = []
        self.last = SE3.identity()

    def note(self, seen: FeatureFrame, pose: np.ndarray) -> None:
        """Adds a frame; of its pose only the increment from the last one is used."""
        self.stamps_ns.append(seen.stamp_ns)
        self.seen.append(seen)
        self.path.append(SE3.compose(self.path[-1], SE3.between(self.last, pose)) if self.path else pose)
        self.last = pose

    def thin(self, most: int) -> None:
        """Reduces them to `most` frames, dropping those closest together relative to their age: older ones become sparser."""
        while len(self.seen) > most:
            at = np.array([frame.stamp_ns for frame in self.seen])
            dropped = 1 + int(np.argmin((at[2:] - at[:-2]) / np.maximum(at[-1] - at[1:-1], 1)))
            del self.seen[dropped], self.path[dropped]

    def seen_first(self, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Names (F,) of all features, and the pose (F, 7) of their first observation on the path (T, 7) of all frames."""
        names, first = np.unique(np.concatenate([frame.landmarks for frame in self.seen]), return_index=True)
        stamps = np.repeat([frame.stamp_ns for frame in self.seen], [frame.landmarks.size for frame in self.seen])
        return names, path[np.searchsorted(self.stamps_ns, stamps[first])]

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint; empty without frames."""
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
    """The result of an adjustment of the first T frames."""

    filter: Filter  #: the filter that replaces the previous one.
    revision: Revision  #: of all poses so far.
    seen_first: tuple[np.ndarray, np.ndarray]  #: names (F,) of features, and poses (F, 7) of their first observation.


def between(times: np.ndarray, paths: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Poses (W, n, 7) of paths (n, T, 7) at other times (W,), interpolated, or the first or the last."""
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
    """K observations of F features in T frames."""

    camera: Pinhole  #: of the images.
    stamps_ns: np.ndarray  #: (T,) of the frames.
    frame: np.ndarray  #: (K,) frame of each observation.
    feature: np.ndarray  #: (K,) feature of each; no feature twice in a frame.
    px: np.ndarray  #: (K, 2) pixel of each.
    noise_px: float  #: standard deviation, per axis.
    known: Known | None = None  #: features of known position.
    tuning: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  #: (k, k) information of the camera's `tuned`.

    def is_connected(self) -> bool:
        """Whether consecutive frames share enough features."""
        sees = np.zeros((self.stamps_ns.size, self.feature.max(initial=-1) + 1), dtype=bool)
        sees[self.frame, self.feature] = True
        return bool(((sees[1:] & sees[:-1]).sum(axis=1) >= MIN_SHARED).all())


def gathered(
    first: FirstFrames, features: FeatureSensor, belief: Belief, most: int, min_views: int = MIN_VIEWS
) -> tuple[np.ndarray, np.ndarray, Window, "Structure"] | None:
    """Frames (T,), at most `most`, features (F,) in the map with enough observations, these, and the particles' estimate.

    The frames have observations and distinct stamps, and include the first and the last one. Returns None with too few
    frames.
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
    """The parameters of an adjustment."""

    path: np.ndarray  #: (T, 7) world_from_camera; the first one is the identity.
    direction: np.ndarray  #: (F, 3) unit vectors.
    inverse: np.ndarray  #: (F,) 1/m.
    tuned: np.ndarray = field(default_factory=lambda: np.zeros(0))  #: (k,) of the camera's self-calibration.
    frame: np.ndarray | None = None  #: (7,) first camera_from_known of the known points' frame, or None.

    def moved(self, step: np.ndarray) -> "Structure":
        """Moved by a step (6 (T − 1) + 3 F + k + 6,) in the right charts of the poses, the tangent planes and 1/m."""
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
        """Depth reversal: near and far exchanged, along the same path.

        With little parallax both solutions fit, with rotation instead of translation (L. Necker's reversal).
        """
        middle = float(self.inverse.mean())
        return replace(self, inverse=np.maximum(2.0 * middle - self.inverse, FARTHEST * middle))


@final
@dataclass(frozen=True)
class Optimum:
    """A minimum of the cost."""

    structure: Structure  #: its parameters.
    cost: float  #: its cost.
    #: (6 (T − 1) + 3 F + k + 6, …) information of a step from it; its inverse is the covariance of the minimum.
    information: np.ndarray

    @cached_property
    def _factor(self) -> np.ndarray:
        return np.asarray(cholesky(self.information, lower=True))

    @cached_property
    def log_weight(self) -> float:
        """Log posterior mass around this minimum by Laplace's approximation, up to a common constant."""
        return -self.cost - float(np.log(np.diag(self._factor)).sum())

    def paths(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Paths (n, T, 7) drawn from the Gaussian at the minimum (Laplace's approximation)."""
        whitened = rng.standard_normal((self.information.shape[0], n))
        step = solve_triangular(self._factor.T, whitened, lower=False).T
        path = self.structure.path
        out = np.broadcast_to(path, (n, *path.shape)).copy()
        out[:, 1:] = SE3.retract(path[1:], step[:, : 6 * (path.shape[0] - 1)].reshape(n, -1, 6))
        return out

    def depth_std_ratio(self, features: np.ndarray) -> float:
        """Median standard deviation of the inverse distances of some features, relative to each; infinite without any."""
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
    """The local minimum reached from a start; None if there is none.

    The priors of inverse distances and velocities are those of the settings. If residuals are far beyond the noise, where the
    loss is nearly flat, it goes through minima with larger noise (graduated non-convexity: A. Blake and A. Zisserman 1987).
    """
    now = Linearised(seen, config, start)
    noise_px = min(now.spread_px(), float(seen.camera.width))
    while noise_px > FAR * seen.noise_px:
        nearer = _levenberg_marquardt(Linearised(replace(seen, noise_px=noise_px), config, now.at))
        if nearer is None:
            return None
        now, noise_px = Linearised(seen, config, nearer.structure), noise_px / NEARER
    return _levenberg_marquardt(now)


def minima(seen: Window, config: MonoConfig, start: Structure, reverse: bool) -> list[Optimum]:
    """The most probable first: `optimum`, and with `reverse` that from its depth reversal, if it is different."""
    best = optimum(seen, config, start)
    other = optimum(seen, config, best.structure.reversed()) if reverse and best is not None else None
    found = [each for each in (best, other) if each is not None]
    if len(found) == 2 and abs(found[1].cost - found[0].cost) < SAME_COST * (1.0 + found[0].cost):
        del found[1]
    return sorted(found, key=lambda each: -each.log_weight)


def _levenberg_marquardt(now: "Linearised") -> Optimum | None:
    """Levenberg-Marquardt on the normal equations."""
    damping = DAMPING
    for _ in range(MAX_STEPS):
        information, vector = now.normal_equations()
        while True:
            ahead = None
            with suppress(LinAlgError, ValueError):  # ValueError for non-finite values
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
    """Standard deviation per axis, px, of the observations, from the median residual of a minimum."""
    count = 2 * seen.frame.size
    free = count - best.information.shape[0]
    return Linearised(seen, config, best.structure).spread_px() * float(np.sqrt(count / free)) if free > 0 else 0.0


@final
class Linearised:
    """All residuals at a structure, whitened; derivatives are computed on request."""

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
        # Residuals of the first mean velocity and of differences of mean velocities: the mean over an interval δ is v + w₁/δ
        # with the noise of E06 (5), so the difference from the previous one has the variance (δ + δ′)/3 of the walk's in one
        # second, and the covariance δ/6 with the next difference.
        interval, before = self._interval, np.concatenate([[0.0], self._interval[:-1]])
        walk = np.diag((before + interval) / 3.0) + np.diag(interval[:-1] / 6.0, 1) + np.diag(interval[:-1] / 6.0, -1)
        cov = np.square(np.maximum(config.velocity.walk_std(), MIN_STD_VELOCITY))[:, None, None] * walk
        cov[:, 0, 0] += np.square(np.maximum(config.velocity.start_std(), MIN_STD_VELOCITY))
        self._whitener = np.linalg.inv(np.linalg.cholesky(cov))
        self.velocity = self._differences(SE3.log(self._relative) / self._interval[:, None])
        self.prior = (at.inverse - self.rho.mean_per_m) / self.rho.std_per_m
        # The scale is fixed by known points, or by a constraint.
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
        """The first of T − 1 rows, and differences of consecutive rows, whitened."""
        moved = np.concatenate([velocity[:1], np.diff(velocity, axis=0)])
        return np.einsum("ktj,jk...->tk...", self._whitener, moved)

    def spread_px(self) -> float:
        """Standard deviation per axis, px, of the residuals, by their median."""
        squared = np.square(self.misfit).sum(axis=1)
        return self.seen.noise_px * float(np.sqrt(np.median(squared) / CHI2_MEDIAN))

    def optimum(self) -> Optimum | None:
        """This structure as a minimum; None where it is not finite or its information is singular."""
        found = Optimum(self.at, self.cost, self.normal_equations(LOSS_INFORMATION)[0])
        with suppress(LinAlgError, ValueError):  # ValueError for non-finite values
            return found if np.isfinite(found.log_weight) else None
        return None

    def normal_equations(self, loss_information: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton information, the observations' part times `loss_information`, and right-hand side."""
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

        # Derivatives of the predictions by the pose (K, 2, 6) and by the feature (K, 2, 3).
        pose, inverse = at.path[seen.frame], at.inverse[seen.feature, None, None]
        slope = self.camera.jacobian(direction) / seen.noise_px
        by_pose = np.concatenate([np.cross(slope, direction[:, None, :]), -inverse * slope], axis=2)
        turned = slope @ np.swapaxes(SE3.rotation(pose), 1, 2)
        along = turned @ tangents(at.direction)[seen.feature]
        by_feature = np.concatenate([along, -turned @ SE3.translation(pose)[:, :, None]], axis=2)

        # The observations, with the weights of the loss.
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

        # Velocities between frames; derivatives of their logarithms by the poses, to first order in a step.
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
    """Two orthonormal tangent vectors (F, 3, 2) of each unit vector (F, 3)."""
    helper = np.where(np.abs(direction[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=-1)


def _summed(parts: np.ndarray, row: np.ndarray, count: int) -> np.ndarray:
    """Sums (count, …) of parts (K, …) by their rows (K,)."""
    out = np.zeros((count, *parts.shape[1:]))
    np.add.at(out, row, parts)
    return out
