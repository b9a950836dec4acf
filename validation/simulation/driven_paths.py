"""Smooth paths of a robot on two wheels, which goes where it faces: straights, bends, turns on the spot, rests.

Curvature and acceleration are continuous. In a bend of length L through the angle Θ the heading is Θ W(x) at the fraction
x of its length, with W = 10 x³ - 15 x⁴ + 6 x⁵: the curvature, its first derivative and those of the neighbouring
straights, which are zero, agree at both ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.validation.simulation.camera_paths import eased

KNOTS = 257
"""Of the table that gives the fraction of a bend for the way along it."""

NODES = 24
"""Of the Gauss-Legendre rule that integrates a position along a bend: exact to the last digits up to half a turn."""


@dataclass(frozen=True)
class Move:
    """A part of a drive.

    Attributes:
        length_m: way of the middle between the wheels, forwards.
        turn_rad: change of the heading, positive to the left.
        rest_s: stands still for so long before it.
    """

    length_m: float = 0.0
    turn_rad: float = 0.0
    rest_s: float = 0.0


@dataclass(frozen=True)
class Travelled:
    """Where a robot is and how far it went, at T times.

    Attributes:
        world_from_robot: (T, 3) elements of SE(2).
        way_m: (T,) length driven since the start.
        heading_rad: (T,) turned since the start, whole turns included.
    """

    world_from_robot: np.ndarray
    way_m: np.ndarray
    heading_rad: np.ndarray


class Drive:
    """Carries out moves one after the other in a given time.

    The pace is the length per second of (driven way, arm · heading): the robot slows down in bends and turns on the
    spot at pace / arm. It stops where it rests, and between driving and turning on the spot.
    """

    def __init__(
        self, start: np.ndarray, moves: Sequence[Move], seconds: float, arm_m: float, ramp_s: float
    ) -> None:
        """Plans the drive.

        Args:
            start: (3,) world_from_robot at first.
            moves: in order, at least one.
            seconds: for all of them.
            arm_m: turning by one radian counts as driving this far.
            ramp_s: time to reach the pace from rest, and to come to rest.

        Raises:
            InputError: the time does not suffice for the rests and for starting and stopping.
        """
        self._length = np.array([move.length_m for move in moves])
        self._turn = np.array([move.turn_rad for move in moves])
        fractions, ways = zip(*[_table(move, arm_m) for move in moves], strict=True)
        self._fractions, self._ways = fractions, ways
        self._ends = np.cumsum([way[-1] for way in ways])
        self._starts = np.concatenate([np.asarray(start, float)[None], np.zeros((len(moves), 3))])
        for k in range(len(moves)):
            self._starts[k + 1] = SE2.compose(self._starts[k], self._within(k, np.ones(1))[0])
        self._plan_legs(moves, seconds, ramp_s)

    def __call__(self, seconds: np.ndarray) -> Travelled:
        """Where the robot is at times (T,), which lie between 0 and the end."""
        progress = self._progress(np.asarray(seconds, float))
        move = np.minimum(np.searchsorted(self._ends, progress, side="right"), len(self._ends) - 1)
        fraction = np.empty_like(progress)
        poses = np.empty((len(progress), 3))
        before = np.concatenate([[0.0], self._ends])
        for k in np.unique(move).tolist():
            rows = move == k
            fraction[rows] = _share(self._ways[k], self._fractions[k], progress[rows] - before[k])
            poses[rows] = SE2.compose(self._starts[k], self._within(k, fraction[rows]))
        way = np.concatenate([[0.0], np.cumsum(self._length)])[move] + self._length[move] * fraction
        turned = np.concatenate([[0.0], np.cumsum(self._turn)])[move] + self._turned(move, fraction)
        return Travelled(poses, way, turned)

    @property
    def waypoints(self) -> np.ndarray:
        """(M + 1, 3) poses before each move and after the last."""
        return self._starts

    def _plan_legs(self, moves: Sequence[Move], seconds: float, ramp_s: float) -> None:
        """Legs between two stops: when they start, how far they are, the pace of all."""
        spot = self._length == 0.0
        rest = np.array([move.rest_s for move in moves])
        first = np.flatnonzero(np.concatenate([[True], (spot[1:] != spot[:-1]) | (rest[1:] > 0.0)]))
        edges = np.concatenate([[0.0], self._ends])[np.append(first, len(moves))]
        driving = seconds - rest.sum() - ramp_s * len(first)
        self._pace = edges[-1] / driving if driving > 0.0 else np.inf
        if np.diff(edges).min() < self._pace * ramp_s:
            raise InputError(
                f"{seconds:g} s do not suffice for {len(first)} starts of {ramp_s:g} s and rests of {rest.sum():g} s: "
                "give the robot more time"
            )
        lasts = np.diff(edges) / self._pace + ramp_s
        self._begins = np.cumsum(rest[first] + np.concatenate([[0.0], lasts[:-1]]))
        self._lasts, self._edges, self._ramp_s = lasts, edges, ramp_s

    def _progress(self, seconds: np.ndarray) -> np.ndarray:
        """Way (T,) in units of the pace at times (T,)."""
        leg = np.maximum(np.searchsorted(self._begins, seconds, side="right") - 1, 0)
        time = np.clip(seconds - self._begins[leg], 0.0, self._lasts[leg])
        early = time < 0.5 * self._lasts[leg]
        done = self._pace * eased(np.where(early, time, self._lasts[leg] - time), self._ramp_s)
        return np.where(early, self._edges[leg] + done, self._edges[leg + 1] - done)

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
        return np.stack(
            [turned, (step * np.cos(heading)).sum(axis=1), (step * np.sin(heading)).sum(axis=1)], axis=-1
        )


def along_corners(corners: Sequence[Sequence[float]], bend_m: float) -> tuple[np.ndarray, list[Move]]:
    """Moves along a polyline with rounded corners.

    Args:
        corners: (K, 2) of the polyline, at least two, m.
        bend_m: a bend begins this far before its corner and ends as far behind it.

    Returns:
        (3,) pose at the start, and the moves.

    Raises:
        InputError: a side is too short for its bends, or the way turns back in a corner.
    """
    sides = np.diff(np.asarray(corners, float), axis=0)
    length = np.linalg.norm(sides, axis=1)
    heading = np.arctan2(sides[:, 1], sides[:, 0])
    turn = np.mod(np.diff(heading) + np.pi, 2.0 * np.pi) - np.pi
    bends = np.where(turn != 0.0, bend_m, 0.0)
    straight = length - np.append(0.0, bends) - np.append(bends, 0.0)
    if (straight < 0.0).any() or (np.abs(turn) > 0.9 * np.pi).any():
        raise InputError(
            f"the corners {corners} are too near to each other or too sharp for bends of {bend_m} m"
        )
    moves = [Move(straight[0])]
    for k, angle in enumerate(turn.tolist()):
        moves += [Move(bend_m / _tangent(angle), angle)] if angle else []
        moves.append(Move(straight[k + 1]))
    start = np.array([heading[0], *corners[0]])
    return start, [move for move in moves if move.length_m > 0.0]


def _tangent(turn_rad: float) -> float:
    """Distance of a bend's ends from the corner that it rounds, as a fraction of its length."""
    node, weight = np.polynomial.legendre.leggauss(NODES)
    chord = 0.5 * weight @ np.cos(turn_rad * (_bent(0.5 * (node + 1.0)) - 0.5))
    return float(chord / (2.0 * np.cos(0.5 * turn_rad)))


def _bent(fraction: np.ndarray) -> np.ndarray:
    """W: the part of a bend's turn that is done at a fraction of its length."""
    return np.asarray(fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2))


def _table(move: Move, arm_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Shares (KNOTS,) of a move and the way to them, turning included."""
    fraction = np.linspace(0.0, 1.0, KNOTS)
    if move.length_m == 0.0:
        return fraction, arm_m * abs(move.turn_rad) * fraction
    node, weight = np.polynomial.legendre.leggauss(NODES)
    middle = fraction[:-1, None] + 0.5 * (node + 1.0) / (KNOTS - 1)
    turning = arm_m * move.turn_rad * 30.0 * (middle * (1.0 - middle)) ** 2
    pieces = np.hypot(move.length_m, turning) @ weight * 0.5 / (KNOTS - 1)
    return fraction, np.concatenate([[0.0], np.cumsum(pieces)])


def _share(way: np.ndarray, fraction: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Shares (T,) of a move for ways (T,) along it."""
    from scipy.interpolate import CubicSpline

    return np.clip(CubicSpline(way, fraction)(wanted), 0.0, 1.0)
