"""Smooth paths of a camera in a hand: sums of sinusoids, a start from rest, and poses that look at something.

Every path is infinitely differentiable but for the start, where the jerk is continuous.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from rbpf.lie import SE3

UP = np.array([0.0, 0.0, 1.0])
TERMS = 3


@dataclass(frozen=True)
class Wave:
    """C smooth random signals around zero, each a sum of sinusoids: Σ a_k sin(2π f_k t + φ_k).

    Attributes:
        amplitude: (C, K), a_k; their sum bounds the signal.
        frequency_hz: (C, K), f_k.
        phase: (C, K), φ_k [rad].
    """

    amplitude: np.ndarray
    frequency_hz: np.ndarray
    phase: np.ndarray

    @classmethod
    def random(cls, bound: np.ndarray, band_hz: tuple[float, float], rng: np.random.Generator) -> Self:
        """Frequencies log-uniform in the band; all terms have the same speed.

        Args:
            bound: (C,) that the signals never pass.
            band_hz: lowest and highest frequency.
            rng: generator.
        """
        shape = (len(bound), TERMS)
        frequency = np.exp(rng.uniform(np.log(band_hz[0]), np.log(band_hz[1]), shape))
        fraction = 1.0 / frequency
        amplitude = bound[:, None] * fraction / fraction.sum(axis=1, keepdims=True)
        return cls(amplitude, frequency, rng.uniform(0.0, 2.0 * np.pi, shape))

    def __call__(self, seconds: np.ndarray) -> np.ndarray:
        """Signals (T, C) at times (T,)."""
        angle = 2.0 * np.pi * self.frequency_hz * seconds[:, None, None] + self.phase
        return (self.amplitude * np.sin(angle)).sum(axis=-1)


def frame_seconds(frames: int, rate_hz: float) -> np.ndarray:
    """(T,) times of the frames, the first at 0 [s]."""
    return np.arange(frames) / rate_hz


def eased(seconds: np.ndarray, start_s: float) -> np.ndarray:
    """Time (T,) of a camera that is held still at first and reaches its pace after `start_s`.

    The pace rises as the polynomial 6 x⁵ - 15 x⁴ + 10 x³, whose first two derivatives vanish at both ends.
    """
    if start_s == 0.0:
        return seconds
    x = np.minimum(seconds / start_s, 1.0)
    return start_s * (x**6 - 3.0 * x**5 + 2.5 * x**4) + np.maximum(seconds - start_s, 0.0)


def looking(eye: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Poses world_from_camera (T, 7) of an upright camera.

    Args:
        eye: (T, 3) position, m.
        direction: (T, 3) of the optical axis in the world, not vertical, of any length.
    """
    forward = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    columns = np.stack([right, np.cross(forward, right), forward, eye], axis=-1)
    return SE3.from_matrix(columns)


def speeds(world_from_camera: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rates of turn (T - 1,) [rad/s] and speeds (T - 1,) [m/s] between poses (T, 7) at times (T,)."""
    step = SE3.local(world_from_camera[:-1], world_from_camera[1:]) / np.diff(seconds)[:, None]
    return np.linalg.norm(step[:, :3], axis=1), np.linalg.norm(step[:, 3:], axis=1)


def slowed(
    path: Callable[[np.ndarray], np.ndarray], seconds: np.ndarray, speed_m_s: float, turn_rad_s: float
) -> Callable[[np.ndarray], np.ndarray]:
    """The path, as slow as it takes that neither limit is passed.

    Args:
        path: poses (T, 7) at times (T,).
        seconds: (T,) times at which it will be read, at least two.
        speed_m_s: highest speed.
        turn_rad_s: highest rate of turn.
    """
    turn, speed = speeds(path(seconds), seconds)
    pace = min(1.0, 1.0 / max(float(turn.max()) / turn_rad_s, float(speed.max()) / speed_m_s))
    return lambda time: path(pace * time)


def shaken(world_from_camera: np.ndarray, wave: Wave, seconds: np.ndarray) -> np.ndarray:
    """Poses (T, 7) moved by a wave of six channels, [rotation, translation] in the camera's frame."""
    return SE3.retract(world_from_camera, wave(seconds))
