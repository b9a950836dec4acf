"""A path from visual odometry alone: increments chained, and what is assumed where a frame gives none."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_geometry import StereoCamera
from rbpf.motion.stereo_motions import Known, camera_motion
from rbpf.motion.stereo_vo import MotionEstimate, VoConfig, estimate_motion, no_motion

ROUNDING = 1e-14
"""Variances below this fraction of the largest are rounding."""


@final
@dataclass(frozen=True)
class Prediction:
    """The motion that is expected before anything is seen: the last velocity, or standing still.

    Attributes:
        std_turn: standard deviation of the angular velocity about the expected one, rad/s.
        std_speed: of the velocity, m/s. Both defaults are a hand-held camera's or an indoor robot's.
        keep_velocity: whether the last velocity that was seen is expected to go on.
    """

    std_turn: float = 1.0
    std_speed: float = 1.0
    keep_velocity: bool = True

    def __post_init__(self) -> None:
        """Checks that the numbers make sense."""
        if not (self.std_turn > 0.0 and self.std_speed > 0.0):
            raise InputError(
                f"std_turn and std_speed must be positive, got {self.std_turn} and {self.std_speed}"
            )

    def law(self, velocity: Array, dt: float) -> Odometry:
        """The increment expected after `dt` seconds at a velocity (6,) [ω, v]."""
        std = dt * np.repeat([self.std_turn, self.std_speed], 3)
        return Odometry(SE3.exp(dt * velocity), np.diag(std**2))


class OdometerStep(NamedTuple):
    """One increment.

    Attributes:
        odometry: previous_camera_from_camera and its covariance, to hand to a filter.
        estimate: what the matches said.
        note: in words, where the increment is not simply that; empty else.
        moving: (K,) matches that agree on another motion than the camera's: they are of things that move.
    """

    odometry: Odometry
    estimate: MotionEstimate
    note: str
    moving: np.ndarray


class SeenFrame(Protocol):
    """What `odometry_path` reads of a frame: `rbpf.sensors.feature_log.FeatureFrame` is one."""

    @property
    def stamp_ns(self) -> int:
        """Time, integer nanoseconds."""

    @property
    def landmarks(self) -> np.ndarray:
        """(K,) names, each once."""

    @property
    def z(self) -> np.ndarray:
        """(K, 3) pixels (u_left, v, u_right)."""

    @property
    def cov_z(self) -> np.ndarray:
        """(K, 3, 3) [px²]."""


@final
class StereoOdometer:
    """Estimates one increment after the other, each started from the last one's velocity.

    Where no motion is found the prediction takes its place; where the matches tell less than the prediction in some
    direction (nothing but far points: how far did the camera go?) both are joined. Either way the step says so.

    Args:
        camera: of all frames.
        rng: of the consensus.
        config: of the estimate.
        prediction: what is expected before anything is seen.
    """

    def __init__(
        self,
        camera: StereoCamera,
        rng: np.random.Generator,
        config: VoConfig | None = None,
        prediction: Prediction | None = None,
    ) -> None:
        self.camera, self.rng = camera, rng
        self.config, self.prediction = config or VoConfig(), prediction or Prediction()
        self.velocity = np.zeros(6)

    def step(
        self,
        z_prev: Array,
        z_now: Array,
        cov_prev: Array,
        cov_now: Array,
        dt: float,
        known: Known | None = None,
    ) -> OdometerStep:
        """The increment over `dt` seconds from matched pixels; see `rbpf.motion.stereo_vo.estimate_motion`.

        Args:
            z_prev: (K, 3) pixels in the earlier frame.
            z_now: (K, 3) in the later one.
            cov_prev: (K, 3, 3) of the earlier pixels.
            cov_now: (K, 3, 3) of the later ones.
            dt: seconds between the frames.
            known: besides the matches: asked where these agree on several motions, or those that stood still do not.

        Raises:
            InputError: as `estimate_motion`, or dt is not positive.
        """
        if not dt > 0.0:
            raise InputError(f"visual odometry needs time between its frames, got {dt} s")
        expected = self.prediction.law(self.velocity, dt)
        found = estimate_motion(
            self.camera, z_prev, z_now, cov_prev, cov_now, self.rng, expected.delta, self.config
        )
        moving, several = np.zeros(found.inliers.size, dtype=bool), ""
        known = known or Known()
        if found.others or (found.found and known.contradicts(found.inliers)):
            found, moving = self._of_camera(found, expected, known)
            several = _several_motions(found, moving) if moving.any() else ""
        if not found.found:
            what = "the last velocity" if self.velocity.any() else "a camera at rest"
            return OdometerStep(expected, found, f"{found.failure}; {what} is assumed, widely", moving)
        odometry, note = _joined(found, expected)
        if self.prediction.keep_velocity:
            self.velocity = SE3.log(odometry.delta) / dt
        return OdometerStep(odometry, found, "; ".join(filter(None, (note, several))), moving)

    def _of_camera(
        self, found: MotionEstimate, expected: Odometry, known: Known
    ) -> tuple[MotionEstimate, np.ndarray]:
        """The camera's motion of several, and which matches agree on the others."""
        motions = [found, *found.others]
        groups = np.array([one.inliers for one in motions])
        laws = [_joined(one, expected)[0] for one in motions]
        chosen = camera_motion(groups, laws, known, expected, bool(self.velocity.any()))
        moving = np.any([group for row, group in enumerate(groups) if row != chosen], axis=0)
        if chosen >= 0:
            return motions[chosen], moving
        many = " and ".join(map(str, groups.sum(axis=1)))
        why = f"{many} of {found.inliers.size} matches agree on a motion, but not the map and what stood still before"
        return no_motion(found, why), moving


def match_names(before: np.ndarray, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the names (K,), (L,) that are in both frames, two (M,) arrays of indices."""
    _, first, second = np.intersect1d(before, now, assume_unique=True, return_indices=True)
    return first, second


def odometry_path(odometer: StereoOdometer, frames: Sequence[SeenFrame]) -> tuple[Array, list[OdometerStep]]:
    """The path of a camera by visual odometry alone.

    Args:
        odometer: that goes along it.
        frames: in order of time, with named landmarks.

    Returns:
        (T, 7) poses relative to the first, world_from_camera where the first camera is the world, and the T−1 steps.
    """
    steps = []
    for before, now in pairwise(frames):
        first, second = match_names(before.landmarks, now.landmarks)
        dt = 1e-9 * (now.stamp_ns - before.stamp_ns)
        steps.append(
            odometer.step(before.z[first], now.z[second], before.cov_z[first], now.cov_z[second], dt)
        )
    return chain([step.odometry.delta for step in steps]), steps


def chain(increments: Sequence[Array]) -> Array:
    """Poses (T, 7) relative to the first, of T−1 increments previous_camera_from_camera (7,)."""
    path = [SE3.identity()]
    for delta in increments:
        path.append(SE3.compose(path[-1], delta))
    return np.array(path)


def _several_motions(found: MotionEstimate, moving: np.ndarray) -> str:
    """In words, that part of what is seen moves."""
    return (
        f"{found.inliers.sum()} of {found.inliers.size} matches agree on a motion and {moving.sum()} on another: "
        f"something in the view moves, and the camera's motion is taken to be that of the {found.inliers.sum()}"
    )


def _joined(found: MotionEstimate, expected: Odometry) -> tuple[Odometry, str]:
    """The estimate, or in case it is the weaker one anywhere, the product of its Gaussian and the expected one."""
    measured = Odometry(found.previous_camera_from_camera, found.cov)
    # In units of the expected standard deviations the expected covariance is I.
    std = np.sqrt(np.diagonal(expected.cov))
    values, axes = np.linalg.eigh(found.cov / np.outer(std, std))
    if values[-1] <= 1.0:
        return measured, ""
    values = np.maximum(values, ROUNDING * values[-1])
    off = axes.T @ (SE3.local(expected.delta, measured.delta) / std)
    half = std[:, None] * axes * np.sqrt(values / (1.0 + values))
    joined = SE3.retract(expected.delta, std * (axes @ (off / (1.0 + values))))
    worst = f"a standard deviation {np.sqrt(values[-1]):.1f} times the expected one"
    note = f"the matches leave the motion open ({worst}); it is joined with the expected one"
    return Odometry(joined, half @ half.T), note
