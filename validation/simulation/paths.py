"""Smooth paths: of a camera in a hand, and of a robot on two wheels, with what its wheels say.

In a hand: sums of sinusoids, a start from rest, and poses that look at something; infinitely differentiable but for the
start, where the jerk is continuous.

On wheels: straights, bends, turns on the spot and rests of a robot that goes where it faces. Curvature and acceleration
are continuous. In a bend of length L through the angle Θ the heading is Θ W(x) at the fraction x of its length, with
W = 10 x³ - 15 x⁴ + 6 x⁵: the curvature, its first derivative and those of the neighbouring straights, which are zero,
agree at both ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.ranges import NotNegative, Positive, Range, Ranged, check_ranges

UP = np.array([0.0, 0.0, 1.0])
TERMS = 3


@dataclass(frozen=True)
class Wave:
    """C smooth random signals around zero, sums of sinusoids Σ a_k sin(2π f_k t + φ_k), |.| ≤ Σ a_k; parameters are (C, K)."""

    amplitude: np.ndarray
    frequency_hz: np.ndarray
    phase: np.ndarray

    @classmethod
    def random(cls, bound: np.ndarray, band_hz: tuple[float, float], rng: np.random.Generator) -> Self:
        """Signals within bounds (C,); frequencies log-uniform in the band; all terms have the same speed."""
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
    """Time (T,) of a camera that is held still at first and reaches its pace after `start_s`.

    The pace rises as the polynomial 6 x⁵ - 15 x⁴ + 10 x³, whose first two derivatives vanish at both ends.
    """
    if start_s == 0.0:
        return seconds
    x = np.minimum(seconds / start_s, 1.0)
    return start_s * (x**6 - 3.0 * x**5 + 2.5 * x**4) + np.maximum(seconds - start_s, 0.0)


def looking(eye: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Poses world_from_camera (T, 7) of an upright camera at (T, 3) [m] that looks along directions (T, 3), not vertical."""
    forward = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    columns = np.stack([right, np.cross(forward, right), forward, eye], axis=-1)
    return SE3.from_matrix(columns)


ARM_HZ = 0.2, 0.8
WRIST_HZ = 0.8, 2.0  #: Before the path is slowed down to the speed of a hand, to about a third.
TREMOR_HZ = 1.0, 3.0
#: Greatest turn about the point looked at to either side; up and down it is this fraction of that.
SWEEP_DEG, RISE = 40.0, 0.25
#: Greatest rotation by the wrist, and rotation and displacement by the hand's tremor, per axis.
WRIST_DEG, TREMOR_DEG, TREMOR_M = 10.0, 0.3, 0.002


@dataclass(frozen=True)
class HandHeld:
    """A camera in a hand moves over a desk and looks at the things on it; it is held still at first.

    The point looked at, the middle of the things' box at first, wanders over the desk, and the camera about that point.
    The path is slowed down until neither `speed_m_s` nor `turn_rad_s` is passed; the hand's tremor comes on top.
    """

    nearest_m: Positive = 1.0  #: least distance of the camera from the point that it looks at.
    farthest_m: Positive = 1.5  #: greatest distance.
    #: the camera looks down at this angle, on the average, and never along the vertical.
    elevation_deg: Annotated[float, Range(gt=-80.0, lt=80.0)] = 55.0
    wander: NotNegative = 0.3  #: greatest shift of the point looked at, as a fraction of the box's size.
    speed_m_s: Positive = 0.3  #: highest speed.
    turn_rad_s: Positive = 0.5  #: highest rate of turn.
    start_s: NotNegative = 1.0  #: the camera reaches its pace after this time.

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.nearest_m < self.farthest_m:
            raise InputError(f"nearest_m = {self.nearest_m} must be less than farthest_m = {self.farthest_m}")

    def poses(self, seconds: np.ndarray, size_m: Sequence[float], rng: np.random.Generator) -> np.ndarray:
        """(T, 7) at times (T,), over a box of a size (x, y, z) with its base on z = 0 and its middle over the origin."""
        turn = np.deg2rad(SWEEP_DEG) * np.array([1.0, RISE])
        reach = 0.5 * (self.farthest_m - self.nearest_m)
        arm = Wave.random(np.array([*(0.5 * self.wander * np.array(size_m)), *turn, reach]), ARM_HZ, rng)
        start = arm(np.zeros(1))[:, :3] - [0.0, 0.0, 0.5 * size_m[2]]
        wrist = Wave.random(np.deg2rad([WRIST_DEG] * 3 + [0.0] * 3), WRIST_HZ, rng)
        bound = [np.deg2rad(TREMOR_DEG)] * 3 + [TREMOR_M] * 3
        tremor = Wave.random(np.array(bound), TREMOR_HZ, rng)

        def sweep(time: np.ndarray) -> np.ndarray:
            """Faster than a hand."""
            wave = arm(time)
            side, rise = wave[:, 3], np.deg2rad(self.elevation_deg) + wave[:, 4]
            away = np.stack([np.sin(side) * np.cos(rise), -np.cos(side) * np.cos(rise), np.sin(rise)], axis=-1)
            distance = 0.5 * (self.nearest_m + self.farthest_m) + wave[:, 5:]
            target = wave[:, :3] - start
            return SE3.retract(looking(target + distance * away, -away), wrist(time))

        # As slow as it takes that neither limit is passed.
        poses, time = sweep(seconds), eased(seconds, self.start_s)
        step = SE3.local(poses[:-1], poses[1:]) / np.diff(seconds)[:, None]
        turn_rad_s, speed_m_s = (float(np.linalg.norm(part, axis=1).max()) for part in (step[:, :3], step[:, 3:]))
        pace = min(1.0, 1.0 / max(turn_rad_s / self.turn_rad_s, speed_m_s / self.speed_m_s))
        return SE3.retract(sweep(pace * time), tremor(time))


KNOTS = 257  #: Of the table that gives the fraction of a bend for the way along it.
#: Of the Gauss-Legendre rule that integrates a position along a bend: exact to the last digits up to half a turn.
NODES = 24


@dataclass(frozen=True)
class Move:
    """A part of a drive: forwards so far, turning to the left by so much, after standing still for so long."""

    length_m: float = 0.0
    turn_rad: float = 0.0
    rest_s: float = 0.0


@dataclass(frozen=True)
class Travelled:
    """Where a robot is at T times, elements (T, 3) of SE(2), and how far it drove and turned since the start (T,).

    The heading includes whole turns.
    """

    world_from_robot: np.ndarray
    way_m: np.ndarray
    heading_rad: np.ndarray


class Drive:
    """Carries out moves one after the other in a given time.

    The pace is the length per second of (driven way, arm · heading): the robot slows down in bends and turns on the
    spot at pace / arm. It stops where it rests, and between driving and turning on the spot.

    Attributes:
        waypoints: (M + 1, 3) poses before each move and after the last.
    """

    def __init__(self, start: np.ndarray, moves: Sequence[Move], seconds: float, arm_m: float, ramp_s: float) -> None:
        """Plans the drive from a pose (3,) world_from_robot.

        `seconds` are for all moves, rests, starts and stops, else an InputError; turning by one radian counts as driving
        `arm_m`; the pace is reached in `ramp_s`.
        """
        self._length = np.array([move.length_m for move in moves])
        self._turn = np.array([move.turn_rad for move in moves])
        self._fractions = [_fraction_by_way(move, arm_m) for move in moves]
        self._ends = np.cumsum([float(fraction.x[-1]) for fraction in self._fractions])
        self.waypoints = np.concatenate([np.asarray(start, float)[None], np.zeros((len(moves), 3))])
        for k in range(len(moves)):
            self.waypoints[k + 1] = SE2.compose(self.waypoints[k], self._within(k, np.ones(1))[0])
        # Legs between two stops: when they start, how far they are, the pace of all.
        spot, rest = self._length == 0.0, np.array([move.rest_s for move in moves])
        first = np.flatnonzero(np.concatenate([[True], (spot[1:] != spot[:-1]) | (rest[1:] > 0.0)]))
        edges = np.concatenate([[0.0], self._ends])[np.append(first, len(moves))]
        driving = seconds - rest.sum() - ramp_s * len(first)
        self._pace = edges[-1] / driving if driving > 0.0 else np.inf
        if np.diff(edges).min() < self._pace * ramp_s:
            raise InputError(
                f"{seconds:g} s are too few for {len(first)} starts of {ramp_s:g} s and rests of {rest.sum():g} s: give more"
            )
        self._lasts, self._edges, self._ramp_s = np.diff(edges) / self._pace + ramp_s, edges, ramp_s
        self._begins = np.cumsum(rest[first] + np.concatenate([[0.0], self._lasts[:-1]]))

    def __call__(self, seconds: np.ndarray) -> Travelled:
        """Where the robot is at times (T,), which lie between 0 and the end."""
        # Way in units of the pace: a leg ends as it began.
        seconds = np.asarray(seconds, float)
        leg = np.maximum(np.searchsorted(self._begins, seconds, side="right") - 1, 0)
        time = np.clip(seconds - self._begins[leg], 0.0, self._lasts[leg])
        early = time < 0.5 * self._lasts[leg]
        done = self._pace * eased(np.where(early, time, self._lasts[leg] - time), self._ramp_s)
        progress = np.where(early, self._edges[leg] + done, self._edges[leg + 1] - done)
        move = np.minimum(np.searchsorted(self._ends, progress, side="right"), len(self._ends) - 1)
        fraction, poses = np.empty_like(progress), np.empty((len(progress), 3))
        before = np.concatenate([[0.0], self._ends])
        for k in np.unique(move).tolist():
            rows = move == k
            fraction[rows] = np.clip(self._fractions[k](progress[rows] - before[k]), 0.0, 1.0)
            poses[rows] = SE2.compose(self.waypoints[k], self._within(k, fraction[rows]))
        way = np.concatenate([[0.0], np.cumsum(self._length)])[move] + self._length[move] * fraction
        turned = np.concatenate([[0.0], np.cumsum(self._turn)])[move] + self._turned(move, fraction)
        return Travelled(poses, way, turned)

    def _turned(self, move: np.ndarray, fraction: np.ndarray) -> np.ndarray:
        """Change of heading (T,) since the start of a move."""
        return self._turn[move] * np.where(self._length[move] > 0.0, _bent(fraction), fraction)

    def _within(self, k: int, fraction: np.ndarray) -> np.ndarray:
        """Poses (T, 3) at fractions (T,) of move k, seen from its start."""
        node, weight = np.polynomial.legendre.leggauss(NODES)
        at = 0.5 * fraction[:, None] * (node + 1.0)
        heading = self._turn[k] * _bent(at)
        step = 0.5 * self._length[k] * fraction[:, None] * weight
        turned = self._turned(np.full(len(fraction), k), fraction)
        return np.stack([turned, (step * np.cos(heading)).sum(axis=1), (step * np.sin(heading)).sum(axis=1)], axis=-1)


def along_corners(corners: Sequence[Sequence[float]], bend_m: float) -> tuple[np.ndarray, list[Move]]:
    """Pose (3,) at the start and moves along a polyline (K, 2) [m] with rounded corners.

    A bend begins `bend_m` before its corner and ends as far behind it: an InputError where a side is too short for that.
    """
    sides = np.diff(np.asarray(corners, float), axis=0)
    length = np.linalg.norm(sides, axis=1)
    heading = np.arctan2(sides[:, 1], sides[:, 0])
    turn = np.mod(np.diff(heading) + np.pi, 2.0 * np.pi) - np.pi
    bends = np.where(turn != 0.0, bend_m, 0.0)
    straight = length - np.append(0.0, bends) - np.append(bends, 0.0)
    if (straight < 0.0).any() or (np.abs(turn) > 0.9 * np.pi).any():
        raise InputError(f"the corners {corners} are too near to each other or too sharp for bends of {bend_m} m")
    node, weight = np.polynomial.legendre.leggauss(NODES)
    moves = [Move(straight[0])]
    for k, angle in enumerate(turn.tolist()):
        if angle:  # Its ends are bend_m from the corner that it rounds.
            chord = 0.5 * weight @ np.cos(angle * (_bent(0.5 * (node + 1.0)) - 0.5))
            moves.append(Move(bend_m / float(chord / (2.0 * np.cos(0.5 * angle))), angle))
        moves.append(Move(straight[k + 1]))
    start = np.array([heading[0], *corners[0]])
    return start, [move for move in moves if move.length_m > 0.0]


def _bent(fraction: np.ndarray) -> np.ndarray:
    """W: the part of a bend's turn that is done at a fraction of its length."""
    return np.asarray(fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2))


def _fraction_by_way(move: Move, arm_m: float) -> Any:
    """The fraction of a move that is done, as a spline of the way, turning included."""
    from scipy.interpolate import CubicSpline

    fraction = np.linspace(0.0, 1.0, KNOTS)
    if move.length_m == 0.0:
        return CubicSpline(arm_m * abs(move.turn_rad) * fraction, fraction)
    node, weight = np.polynomial.legendre.leggauss(NODES)
    middle = fraction[:-1, None] + 0.5 * (node + 1.0) / (KNOTS - 1)
    turning = arm_m * move.turn_rad * 30.0 * (middle * (1.0 - middle)) ** 2
    pieces = np.hypot(move.length_m, turning) @ weight * 0.5 / (KNOTS - 1)
    return CubicSpline(np.concatenate([[0.0], np.cumsum(pieces)]), fraction)


Error = Annotated[float, Range(gt=-0.5, lt=0.5)]  #: As a fraction of what is right.


@dataclass(frozen=True)
class WheelOdometer(Ranged):
    """Two driven wheels side by side, whose turns are counted.

    Wrong diameters and a wrong distance between the wheels err the same way all the time (J. Borenstein, L. Feng,
    Measurement and correction of systematic odometry errors in mobile robots, 1996); slip is a random walk whose
    variance grows with the way of each wheel (K. S. Chong, L. Kleeman, Accurate odometry and error modelling for a
    mobile robot, 1997).
    """

    wheelbase_m: Positive = 0.4  #: true distance between the wheels.
    scale: Error = 0.01  #: both wheels report so much more than they went, as a fraction.
    #: the right one reports so much more than the left one, as a fraction: a drift of the heading.
    inequality: Error = 0.002
    #: the robot takes the distance between its wheels for so much greater, as a fraction.
    wheelbase_error: Error = 0.02
    #: standard deviation of a wheel's error after 1 m, in m; it grows with the root of the way.
    slip_m: NotNegative = 0.004

    def measure(self, travelled: Travelled, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Readings of a drive at T times; more times leave the first readings as they are.

        Returns:
            Motions (T - 1, 3) from each time to the next, elements of SE(2), and standard deviations (T - 1, 3) of what is
            random in their theta [rad], x and y [m].
        """
        side = 0.5 * self.wheelbase_m * np.array([-1.0, 1.0])
        way = np.diff(travelled.way_m[:, None] + travelled.heading_rad[:, None] * side, axis=0)
        counted = way * (1.0 + self.scale + 0.5 * self.inequality * np.array([-1.0, 1.0]))
        counted += self.slip_m * np.sqrt(np.abs(way)) * rng.standard_normal(way.shape)
        base = self.wheelbase_m * (1.0 + self.wheelbase_error)
        forward, turn = counted.mean(axis=1), (counted[:, 1] - counted[:, 0]) / base
        delta = SE2.exp(np.stack([turn, forward, np.zeros_like(turn)], axis=-1))
        spread = self.slip_m * np.sqrt(np.abs(counted).sum(axis=1))
        std = np.stack([spread / base, 0.5 * spread, 0.5 * np.abs(forward) * spread / base], axis=-1)
        return delta, std


def dead_reckoning(delta: np.ndarray) -> np.ndarray:
    """(T, 3) poses by motions (T - 1, 3), elements of SE(2); the first is the identity."""
    poses = np.zeros((len(delta) + 1, 3))
    for k, step in enumerate(delta):
        poses[k + 1] = SE2.compose(poses[k], step)
    return poses
