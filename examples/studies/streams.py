"""Endless streams of measurements in worlds whose points are replaced, generated frame by frame.

A `FeatureLog` or a `RobotLog` stores a whole recording; a stream of any length stores only its world. The camera and the
robot move in laps forever, and every point is replaced by another one, with a new name and elsewhere, after a random time.
A filter's input is the first frame as a log, and then one frame after the other.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbpf.lie import SE2, SE3
from rbpf.ranges import Count, Ranged, Rate
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.sensors.readers import Frame, RobotLog
from rbpf.validation.simulation.paths import looking

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
KNOWN = 5
"""Number of known, permanent points of the camera's world, which fix its scale and frame."""

KNOWN_STD_M, LEAST_M = 0.001, 0.1
MARGIN_PX = 6.0
CAMERA_HZ, ROBOT_HZ = 30.0, 10.0


@dataclass(frozen=True)
class Turnover(Ranged):
    """Number of points, and their rate of replacement.

    Attributes:
        points: number of points at any time.
        measurements: maximum number of points measured in a frame; the oldest points first.
        renewal: probability per frame that a point is replaced.
    """

    points: Count = 60
    measurements: Count = 12
    renewal: Rate = 0.0005


class Seen(NamedTuple):
    """A frame of a stream, and the true pose."""

    frame: FeatureFrame | Frame
    pose: np.ndarray


class _Points:
    """Points (P, D) with unique names; the first `lasting` ones are permanent."""

    def __init__(self, places: np.ndarray, lasting: int, turnover: Turnover) -> None:
        self.places = places
        self.names = np.arange(len(places))
        self._lasting, self._turnover, self._next = lasting, turnover, len(places)

    def renew(self, fresh: np.ndarray, rng: np.random.Generator) -> None:
        """Replaces some of the points by new ones (P, D)."""
        gone = rng.random(len(self.places)) < self._turnover.renewal
        gone[: self._lasting] = False
        count = int(gone.sum())
        self.places[gone] = fresh[gone]
        self.names[gone] = np.arange(self._next, self._next + count)
        self._next += count

    def oldest(self, visible: np.ndarray) -> np.ndarray:
        """Rows (K,) of the visible points (P,) that are measured."""
        rows = np.flatnonzero(visible)
        return rows[np.argsort(self.names[rows], kind="stable")][: self._turnover.measurements]


class _Stream(ABC):
    """An endless stream among points that are replaced."""

    _rng: np.random.Generator
    _points: _Points
    _first: Seen

    def frames(self) -> Iterator[Seen]:
        """Frame after frame, the first one included."""
        t = 0
        while True:
            yield self._first if t == 0 else self._measure(t)
            self._points.renew(self._draw(len(self._points.places)), self._rng)
            t += 1

    @abstractmethod
    def _draw(self, count: int) -> np.ndarray:
        """New points (count, D)."""

    @abstractmethod
    def _measure(self, t: int) -> Seen:
        """Frame t."""


class CameraStream(_Stream):
    """A camera that circles over a desk forever and faces it.

    Args:
        turnover: of the points.
        seed: of the only random generator.
        noise_px: standard deviation of the pixels.
    """

    def __init__(self, turnover: Turnover, seed: int, noise_px: float = 0.7) -> None:
        self.noise_px = noise_px
        self._rng = np.random.default_rng(seed)
        self._points = _Points(self._draw(turnover.points), KNOWN, turnover)
        around = 2.0 * np.pi * np.arange(KNOWN) / KNOWN
        self._points.places[:KNOWN] = np.stack([0.2 * np.cos(around), 0.2 * np.sin(around), 0.0 * around], 1)
        self._points.places[0, 2] = 0.05
        self._first = self._measure(0)

    def first(self) -> FeatureLog:
        """The first frame alone, with the known points."""
        cov = np.tile(KNOWN_STD_M**2 * np.eye(3), (KNOWN, 1, 1))
        known = KnownPoints(np.arange(KNOWN), self._points.places[:KNOWN].copy(), cov)
        assert isinstance(self._first.frame, FeatureFrame)
        return FeatureLog("a stream of features", CAMERA, [self._first.frame], known)

    def _draw(self, count: int) -> np.ndarray:
        return self._rng.uniform([-0.7, -0.7, 0.0], [0.7, 0.7, 0.3], (count, 3))

    def _measure(self, t: int) -> Seen:
        """The camera's frame t: a lap takes 20 s, at varying distance."""
        s = t / CAMERA_HZ
        turn = 2.0 * np.pi * s / 20.0
        eye = np.array([0.45 * np.sin(turn), -0.8 + 0.2 * np.cos(0.7 * turn), 1.0 + 0.15 * np.sin(1.3 * turn)])
        at = np.array([0.15 * np.sin(0.9 * turn), 0.1 * np.sin(0.6 * turn), 0.0])
        pose = looking(eye[None], (at - eye)[None])[0]
        local = SE3.inverse_transform(pose, self._points.places)
        rows = self._points.oldest(CAMERA.visible(local, MARGIN_PX) & (local[:, 2] > LEAST_M))
        z = CAMERA.project(local[rows]) + self.noise_px * self._rng.standard_normal((rows.size, 2))
        keep = CAMERA.inside(z)
        cov = np.tile(self.noise_px**2 * np.eye(2), (int(keep.sum()), 1, 1))
        names = self._points.names[rows[keep]]
        return Seen(FeatureFrame(round(s * 1e9), names, z[keep], cov), pose)


class RobotStream(_Stream):
    """A robot that drives in a circle forever, with noisy odometry, and observes landmarks ahead.

    Args:
        turnover: of the landmarks; a fifth of them are permanent.
        seed: of the only random generator.
        std_odometry: standard deviations of a step: heading [rad], forward and sideways [m].
        std_z: of range [m] and bearing [rad].
        radius_m: of the circle.
    """

    def __init__(
        self,
        turnover: Turnover,
        seed: int,
        std_odometry: tuple[float, float, float] = (0.01, 0.02, 0.005),
        std_z: tuple[float, float] = (0.05, 0.01),
        radius_m: float = 5.0,
    ) -> None:
        self.radius_m = radius_m
        self._std_odometry, self._std_z = np.array(std_odometry), np.array(std_z)
        self._rng = np.random.default_rng(seed)
        self._points = _Points(self._draw(turnover.points), turnover.points // 5, turnover)
        self._first = self._measure(0)

    def first(self) -> RobotLog:
        """The first frame alone."""
        assert isinstance(self._first.frame, Frame)
        return RobotLog("a stream of ranges", SE2, "range_bearing", SE2.identity(), [self._first.frame])

    def _draw(self, count: int) -> np.ndarray:
        reach = self.radius_m + 3.0
        return self._rng.uniform([-reach, -3.0], [reach, self.radius_m * 2.0 + 3.0], (count, 2))

    def _pose(self, t: int) -> np.ndarray:
        """(heading, x, y), starting at the origin; a lap takes 300 steps."""
        turn = 2.0 * np.pi * t / 300.0
        return np.array([turn, self.radius_m * np.sin(turn), self.radius_m * (1.0 - np.cos(turn))])

    def _measure(self, t: int) -> Seen:
        pose, rng = self._pose(t), self._rng
        x, y = SE2.inverse_transform(pose, self._points.places).T
        z = np.stack([np.hypot(x, y), np.arctan2(y, x)], axis=-1)
        rows = self._points.oldest((z[:, 0] > 0.5) & (z[:, 0] < 6.0) & (np.abs(z[:, 1]) < 1.2))
        noisy = z[rows] + self._std_z * rng.standard_normal((rows.size, 2))
        delta = cov_delta = None
        if t:
            cov_delta = np.diag(self._std_odometry**2)
            delta = SE2.between(self._pose(t - 1), pose)
            delta = SE2.retract(delta, self._std_odometry * rng.standard_normal(3))
        cov = np.tile(np.diag(self._std_z**2), (rows.size, 1, 1))
        names, stamp = self._points.names[rows], round(t / ROBOT_HZ * 1e9)
        return Seen(Frame(stamp, delta, cov_delta, names, noisy, cov), pose)
