"""Simulates a robot with a laser scanner that drives round a closed corridor, and writes a log for `rbpf run laser`.

The folder holds `robot.clf`, a CARMEN log; `truth.tum`, the true path; and `robot.relations`, true relative poses between
poses near in time, and at one place in different laps (`rbpf.validation.metrics.relations`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Annotated

import numpy as np

from rbpf.lie import SE2, Array
from rbpf.ranges import MOST, NotNegative, Positive, Range, Ranged, Rate
from rbpf.runs.files import write_text
from rbpf.runs.trajectory import Trajectory, write_tum
from rbpf.validation.simulation.paths import eased

#: Corners of the walls around the corridor, counterclockwise [m].
OUTER = ((0.0, 0.0), (16.0, 0.0), (16.0, 12.0), (0.0, 12.0))
#: Corners of the block inside, clockwise: the corridor is on the left of both.
INNER = ((2.0, 2.0), (2.0, 10.0), (14.0, 10.0), (14.0, 2.0))
#: Niches and pillars of each wall, outer walls first: start along the wall, width and depth [m]; a negative depth is a
#: pillar.
NICHES = (
    ((3.0, 1.0, 0.6), (8.5, 0.9, 0.25), (12.0, 2.0, 1.5)),
    ((2.5, 0.9, 0.3), (7.0, 1.4, 0.8)),
    ((2.0, 1.6, 1.0), (6.0, 0.4, -0.3), (10.0, 0.9, 0.25), (13.0, 0.4, -0.3)),
    ((4.0, 0.9, 0.4), (8.0, 1.8, 0.7)),
    ((1.5, 0.9, 0.25), (5.0, 1.5, 0.9)),
    ((1.0, 0.9, 0.25), (4.5, 0.5, -0.4), (8.0, 1.2, 0.6)),
    ((3.0, 0.9, 0.5),),
    ((2.0, 1.0, 0.25), (6.0, 0.5, -0.3), (9.5, 0.9, 0.25)),
)
LANE_M, BEND_M, SPEED_M_S, RAMP_S = 1.0, 0.7, 0.5, 1.0
NO_RETURN_M = 81.83  #: Reading without a return, as written by SICK scanners.
START_S, READINGS = 1_000_000_000, 10


Error = Annotated[float, Range(gt=-0.5, lt=0.5)]  #: A relative error.


@dataclass(frozen=True)
class WheelOdometer(Ranged):
    """Odometry of a differential drive.

    Wrong wheel diameters and a wrong wheelbase give systematic errors (J. Borenstein, L. Feng, Measurement and
    correction of systematic odometry errors in mobile robots, 1996); slip is a random walk whose variance grows with
    the distance driven by each wheel (K. S. Chong, L. Kleeman, Accurate odometry and error modelling for a mobile
    robot, 1997).
    """

    wheelbase_m: Positive = 0.4  #: true distance between the wheels.
    scale: Error = 0.01  #: relative scale error of both wheels: positive reports too much.
    #: relative excess of the right wheel's reports over the left's, which makes the heading drift.
    inequality: Error = 0.002
    #: relative error of the wheelbase that the robot assumes: positive is too large.
    wheelbase_error: Error = 0.02
    #: standard deviation of a wheel's error after 1 m, in m; it grows with the root of the distance.
    slip_m: NotNegative = 0.004

    def measure(self, way_m: Array, heading_rad: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Odometry from cumulative distance and heading (T,); further times leave the first readings unchanged.

        Returns:
            Motions (T - 1, 3) between consecutive times, elements of SE(2), and standard deviations (T - 1, 3) of the
            random errors of their theta [rad], x and y [m].
        """
        side = 0.5 * self.wheelbase_m * np.array([-1.0, 1.0])
        way = np.diff(way_m[:, None] + heading_rad[:, None] * side, axis=0)
        counted = way * (1.0 + self.scale + 0.5 * self.inequality * np.array([-1.0, 1.0]))
        counted += self.slip_m * np.sqrt(np.abs(way)) * rng.standard_normal(way.shape)
        base = self.wheelbase_m * (1.0 + self.wheelbase_error)
        forward, turn = counted.mean(axis=1), (counted[:, 1] - counted[:, 0]) / base
        delta = SE2.exp(np.stack([turn, forward, np.zeros_like(turn)], axis=-1))
        spread = self.slip_m * np.sqrt(np.abs(counted).sum(axis=1))
        std = np.stack([spread / base, 0.5 * spread, 0.5 * np.abs(forward) * spread / base], axis=-1)
        return delta, std


def dead_reckoning(delta: np.ndarray) -> np.ndarray:
    """Poses (T, 3) from motions (T - 1, 3), elements of SE(2); the first is the identity."""
    return np.array(list(accumulate(delta, SE2.compose, initial=SE2.identity())))


@dataclass(frozen=True)
class LaserWorld(Ranged):
    """A robot with a 180° scanner in a corridor of 16 m by 12 m."""

    scans: Annotated[int, Range(ge=2, le=MOST)] = 400  #: number of scans, equally spaced in time.
    laps: Annotated[int, Range(ge=1, le=1000)] = 2  #: number of laps.
    std_range_m: NotNegative = 0.01  #: standard deviation of the ranges.
    dropouts: Rate = 0.01  #: fraction of the readings without a return.
    max_range_m: Positive = 20.0  #: farther walls give no return.
    scanner_ahead_m: float = 0.2  #: position of the scanner ahead of the robot's centre.
    odometer: WheelOdometer = field(default_factory=WheelOdometer)  #: of the wheels.


def floor_plan() -> Array:
    """End points (S, 2, 2) of the wall segments [m]."""
    walls = []
    for niches, corners in ((NICHES[:4], OUTER), (NICHES[4:], INNER)):
        line: list[Array] = []
        for k, places in enumerate(niches):
            start, end = np.array(corners[k]), np.array(corners[(k + 1) % len(corners)])
            along = (end - start) / np.linalg.norm(end - start)
            away = np.array([along[1], -along[0]])
            line.append(start)
            for at, width, depth in places:
                first, last = start + at * along, start + (at + width) * along
                line += [first, first + depth * away, last + depth * away, last]
        walls.append(np.stack([line, np.roll(line, -1, axis=0)], axis=1))
    return np.concatenate(walls)


def cast(walls: Array, world_from_sensor: Array, angles: Array) -> Array:
    """Distances (B,) to the nearest wall segment (S, 2, 2) along beams at angles (B,); inf is none."""
    heading = world_from_sensor[0] + angles
    beam = np.stack([np.cos(heading), np.sin(heading)], axis=-1)[:, None]
    start, along = walls[:, 0] - world_from_sensor[1:], walls[:, 1] - walls[:, 0]

    def cross(a: Array, b: Array) -> Array:
        return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

    # Sensor position + distance · beam = start + fraction · along.
    with np.errstate(divide="ignore", invalid="ignore"):
        slant = cross(beam, along)
        distance, fraction = cross(start, along) / slant, cross(start, beam) / slant
    met = (distance > 0.0) & (fraction >= 0.0) & (fraction <= 1.0)
    return np.asarray(np.where(met, distance, np.inf).min(axis=1))


def simulate_laser(world: LaserWorld, folder: Path, seed: int) -> None:
    """Writes a log into a folder, which is created if necessary; existing files are replaced."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    # Along the centre of the corridor, from the middle of its first side: straights and quarter turns, each a constant twist.
    width, depth = np.array(OUTER[2]) - 2.0 * LANE_M
    sides = np.array([0.5 * width, *[depth, width] * (2 * world.laps - 1), depth, 0.5 * width])
    length = np.full(2 * sides.size - 1, 0.5 * np.pi * BEND_M)
    length[::2] = sides - BEND_M * np.array([1.0, *[2.0] * (sides.size - 2), 1.0])
    turn = np.where(np.arange(length.size) % 2, 0.5 * np.pi, 0.0)
    twist = np.stack([turn, length, np.zeros_like(turn)], axis=-1)
    reached, turned = np.append(0.0, np.cumsum(length)), np.append(0.0, np.cumsum(turn))
    starts = SE2.compose(np.array([0.0, 0.5 * OUTER[1][0], LANE_M]), dead_reckoning(SE2.exp(twist)))
    # The odometry's rate is higher than the scanner's.
    times = np.linspace(0.0, reached[-1] / SPEED_M_S + 0.5 * RAMP_S, READINGS * (world.scans - 1) + 1)
    way_m = SPEED_M_S * eased(times, RAMP_S)
    part = np.searchsorted(reached[1:-1], way_m, side="right")
    fraction = (way_m - reached[part]) / length[part]
    truth = SE2.compose(starts[part], SE2.exp(fraction[:, None] * twist[part]))
    stamps_ns = START_S * 10**9 + np.rint(times * 1e6).astype(np.int64) * 1000
    readings, _ = world.odometer.measure(way_m, turned[part] + fraction * turn[part], rng)
    odometry = dead_reckoning(readings)[::READINGS]
    truth, way_m, stamps_ns = truth[::READINGS], way_m[::READINGS], stamps_ns[::READINGS]
    # Scans: noise, then readings without a return.
    mount, angles, walls = np.array([0.0, world.scanner_ahead_m, 0.0]), np.radians(np.arange(-90.0, 91.0)), floor_plan()
    ranges = np.stack([cast(walls, SE2.compose(pose, mount), angles) for pose in truth])
    ranges = np.maximum(ranges + world.std_range_m * rng.standard_normal(ranges.shape), 0.0)
    ranges[(ranges > world.max_range_m) | (rng.random(ranges.shape) < world.dropouts)] = NO_RETURN_M
    lines = ["# FLASER n [range] x y theta odom_x odom_y odom_theta time host time"]
    lines += [f"PARAM robot_frontlaser_offset {world.scanner_ahead_m}"]
    for stamp_ns, pose, scan in zip(stamps_ns.tolist(), odometry, ranges, strict=True):
        sensor = _words(np.roll(SE2.compose(pose, mount), -1), 6)
        time = f"{stamp_ns // 10**9}.{stamp_ns % 10**9 // 1000:06d}"
        robot = _words(np.roll(pose, -1), 6)
        lines.append(f"FLASER {len(scan)} {_words(scan, 3)} {sensor} {robot} {time} simulated {time}")
    write_text(folder / "robot.clf", "\n".join(lines) + "\n")
    write_tum(folder / "truth.tum", Trajectory.from_planar(stamps_ns, truth))
    # Relations: every tenth scan with the next tenth, and with the nearest one of another lap.
    rows = np.arange(0, world.scans, 10)
    pairs = list(zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True))
    for row in rows.tolist():
        others = np.flatnonzero(np.abs(way_m - way_m[row]) > 0.5 * way_m[-1] / world.laps)
        if others.size and world.laps > 1:
            pairs.append((row, int(others[np.linalg.norm(truth[others, 1:] - truth[row, 1:], axis=1).argmin()])))
    lines = ["# t1 t2 x y z roll pitch yaw"]
    for first, second in pairs:
        theta, x, y = SE2.between(truth[first], truth[second]).tolist()
        ends = " ".join(f"{int(t) // 10**9}.{int(t) % 10**9:09d}" for t in stamps_ns[[first, second]])
        lines.append(f"{ends} {x:.9f} {y:.9f} 0 0 0 {theta:.9f}")
    write_text(folder / "robot.relations", "\n".join(lines) + "\n")


def _words(values: Sequence[float] | Array, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
