"""Smooth paths of a hand-held camera: sums of sinusoids, a start from rest, and poses facing a target.

They are infinitely differentiable except at the start, where the jerk is continuous.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.ranges import NotNegative, Positive, Range, check_ranges

UP = np.array([0.0, 0.0, 1.0])
TERMS = 3


@dataclass(frozen=True)
class Wave:
    """C smooth random zero-mean signals Σ a_k sin(2π f_k t + φ_k), with |.| ≤ Σ a_k; parameters are (C, K)."""

    amplitude: np.ndarray
    frequency_hz: np.ndarray
    phase: np.ndarray

    @classmethod
    def random(cls, bound: np.ndarray, band_hz: tuple[float, float], rng: np.random.Generator) -> Self:
        """Signals within bounds (C,); frequencies are log-uniform in the band; all terms have the same peak rate."""
        shape = (len(bound), TERMS)
        frequency = np.exp(rng.uniform(np.log(band_hz[0]), np.log(band_hz[1]), shape))
        fraction = 1.0 / frequency
        amplitude = bound[:, None] * fraction / fraction.sum(axis=1, keepdims=True)
        return cls(amplitude, frequency, rng.uniform(0.0, 2.0 * np.pi, shape))

    def __call__(self, seconds: np.ndarray) -> np.ndarray:
        """Signals (T, C) at times (T,)."""
        angle = 2.0 * np.pi * self.frequency_hz * seconds[:, None, None] + self.phase
        return (self.amplitude * np.sin(angle)).sum(axis=-1)


def eased(seconds: np.ndarray, start_s: float) -> np.ndarray:
    """Path time (T,) of a camera that starts from rest and reaches its pace after `start_s`.

    The pace rises as the polynomial 6 x⁵ - 15 x⁴ + 10 x³, whose first two derivatives vanish at both ends.
    """
    if start_s == 0.0:
        return seconds
    x = np.minimum(seconds / start_s, 1.0)
    return start_s * (x**6 - 3.0 * x**5 + 2.5 * x**4) + np.maximum(seconds - start_s, 0.0)


def looking(eye: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Poses world_from_camera (T, 7) of an upright camera at (T, 3) [m] facing directions (T, 3), not vertical."""
    forward = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return SE3.from_matrix(np.stack([right, np.cross(forward, right), forward, eye], axis=-1))


ARM_HZ = 0.2, 0.8
WRIST_HZ = 0.8, 2.0  #: Before the path is slowed down to a hand's speed, by a factor of about three.
TREMOR_HZ = 1.0, 3.0
#: Largest azimuth about the target to either side; elevation varies by this fraction of it.
SWEEP_DEG, RISE = 40.0, 0.25
#: Largest rotation by the wrist, and rotation and translation by tremor, per axis.
WRIST_DEG, TREMOR_DEG, TREMOR_M = 10.0, 0.3, 0.002


@dataclass(frozen=True)
class HandHeld:
    """A hand-held camera that moves over a desk and faces the objects on it; it starts at rest.

    The target, at first the centre of the objects' box, wanders over the desk, and the camera moves about it. The path
    is slowed down so that it exceeds neither `speed_m_s` nor `turn_rad_s`; tremor is added afterwards.
    """

    nearest_m: Positive = 1.0  #: least distance of the camera from its target.
    farthest_m: Positive = 1.5  #: largest distance.
    #: mean elevation of the camera above its target; never vertical.
    elevation_deg: Annotated[float, Range(gt=-80.0, lt=80.0)] = 55.0
    wander: NotNegative = 0.3  #: largest shift of the target, as a fraction of the box's size.
    speed_m_s: Positive = 0.3  #: maximum speed.
    turn_rad_s: Positive = 0.5  #: maximum turn rate.
    start_s: NotNegative = 1.0  #: time until the camera reaches its pace.

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.nearest_m < self.farthest_m:
            raise InputError(f"nearest_m = {self.nearest_m} must be less than farthest_m = {self.farthest_m}")

    def poses(self, seconds: np.ndarray, size_m: Sequence[float], rng: np.random.Generator) -> np.ndarray:
        """Poses (T, 7) at times (T,), over a box of size (x, y, z) with its base on z = 0, centred on the origin."""
        turn = np.deg2rad(SWEEP_DEG) * np.array([1.0, RISE])
        reach = 0.5 * (self.farthest_m - self.nearest_m)
        arm = Wave.random(np.array([*(0.5 * self.wander * np.array(size_m)), *turn, reach]), ARM_HZ, rng)
        start = arm(np.zeros(1))[:, :3] - [0.0, 0.0, 0.5 * size_m[2]]
        wrist = Wave.random(np.deg2rad([WRIST_DEG] * 3 + [0.0] * 3), WRIST_HZ, rng)
        tremor = Wave.random(np.array([np.deg2rad(TREMOR_DEG)] * 3 + [TREMOR_M] * 3), TREMOR_HZ, rng)

        def sweep(time: np.ndarray) -> np.ndarray:
            """The path before it is slowed down."""
            wave = arm(time)
            side, rise = wave[:, 3], np.deg2rad(self.elevation_deg) + wave[:, 4]
            away = np.stack([np.sin(side) * np.cos(rise), -np.cos(side) * np.cos(rise), np.sin(rise)], axis=-1)
            distance = 0.5 * (self.nearest_m + self.farthest_m) + wave[:, 5:]
            target = wave[:, :3] - start
            return SE3.retract(looking(target + distance * away, -away), wrist(time))

        # Slowed down to stay within both limits.
        poses, time = sweep(seconds), eased(seconds, self.start_s)
        step = SE3.local(poses[:-1], poses[1:]) / np.diff(seconds)[:, None]
        turn_rad_s, speed_m_s = (float(np.linalg.norm(part, axis=1).max()) for part in (step[:, :3], step[:, 3:]))
        pace = min(1.0, 1.0 / max(turn_rad_s / self.turn_rad_s, speed_m_s / self.speed_m_s))
        return SE3.retract(sweep(pace * time), tremor(time))
