"""Drives of a differential-drive robot: straights, bends, turns on the spot and rests.

Curvature and acceleration are continuous. In a bend of length L through the angle Θ the heading is Θ W(x) at the fraction x
of its length, with W = 10 x³ - 15 x⁴ + 6 x⁵: the curvature, its first derivative and those of the neighbouring straights,
which are zero, agree at both ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.validation.simulation.paths import eased

KNOTS = 257  #: Knots of the table from distance along a bend to its fraction.
#: Order of the Gauss-Legendre rule for positions along a bend: exact to rounding up to half a turn.
NODES = 24


@dataclass(frozen=True)
class Move:
    """A part of a drive: distance ahead, turn to the left, and rest before."""

    length_m: float = 0.0
    turn_rad: float = 0.0
    rest_s: float = 0.0


@dataclass(frozen=True)
class Travelled:
    """Poses of a robot at T times, elements (T, 3) of SE(2), and its distance and heading since the start (T,).

    The heading includes whole turns.
    """

    world_from_robot: np.ndarray
    way_m: np.ndarray
    heading_rad: np.ndarray


class Drive:
    """Executes moves in sequence in a given time.

    The pace is the rate of the length of (distance, arm · heading): the robot slows down in bends and turns on the
    spot at pace / arm. It stops for rests, and between driving and turning on the spot.

    Attributes:
        waypoints: (M + 1, 3) poses before each move and after the last.
    """

    def __init__(self, start: np.ndarray, moves: Sequence[Move], seconds: float, arm_m: float, ramp_s: float) -> None:
        """Plans the drive from a pose (3,) world_from_robot.

        `seconds` must suffice for all moves, rests, starts and stops, else an InputError is raised; turning by one radian
        counts as driving `arm_m`; the pace is reached in `ramp_s`.
        """
        self._length = np.array([move.length_m for move in moves])
        self._turn = np.array([move.turn_rad for move in moves])
        self._fractions = [_fraction_by_way(move, arm_m) for move in moves]
        self._ends = np.cumsum([float(fraction.x[-1]) for fraction in self._fractions])
        self.waypoints = np.concatenate([np.asarray(start, float)[None], np.zeros((len(moves), 3))])
        for k in range(len(moves)):
            self.waypoints[k + 1] = SE2.compose(self.waypoints[k], self._within(k, np.ones(1))[0])
        # Legs between two stops: start times, lengths, and the common pace.
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
        """The robot's poses at times (T,) between 0 and the end."""
        # Distance in units of the pace: a leg ends as it starts.
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
        """Poses (T, 3) at fractions (T,) of move k, relative to its start."""
        node, weight = np.polynomial.legendre.leggauss(NODES)
        at = 0.5 * fraction[:, None] * (node + 1.0)
        heading = self._turn[k] * _bent(at)
        step = 0.5 * self._length[k] * fraction[:, None] * weight
        turned = self._turned(np.full(len(fraction), k), fraction)
        return np.stack([turned, (step * np.cos(heading)).sum(axis=1), (step * np.sin(heading)).sum(axis=1)], axis=-1)


def along_corners(corners: Sequence[Sequence[float]], bend_m: float) -> tuple[np.ndarray, list[Move]]:
    """Start pose (3,) and moves along a polyline (K, 2) [m] with rounded corners.

    A bend begins `bend_m` before its corner and ends as far after it. Raises InputError: a side is too short.
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
    """W: the fraction of a bend's turn at a fraction of its length."""
    return np.asarray(fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2))


def _fraction_by_way(move: Move, arm_m: float) -> Any:
    """The fraction of a move as a spline of its distance, turning included."""
    from scipy.interpolate import CubicSpline

    fraction = np.linspace(0.0, 1.0, KNOTS)
    if move.length_m == 0.0:
        return CubicSpline(arm_m * abs(move.turn_rad) * fraction, fraction)
    node, weight = np.polynomial.legendre.leggauss(NODES)
    middle = fraction[:-1, None] + 0.5 * (node + 1.0) / (KNOTS - 1)
    turning = arm_m * move.turn_rad * 30.0 * (middle * (1.0 - middle)) ** 2
    pieces = np.hypot(move.length_m, turning) @ weight * 0.5 / (KNOTS - 1)
    return CubicSpline(np.concatenate([[0.0], np.cumsum(pieces)]), fraction)
