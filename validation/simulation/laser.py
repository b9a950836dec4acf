"""Simulates a robot with a laser scanner that drives round a corridor, and writes the log that `rbpf run laser` reads.

The folder holds `robot.clf`, a CARMEN log; `truth.tum`, the true path; and `robot.relations`, true relations between poses
near in time and between poses at one place in different rounds (`rbpf.validation.metrics.relations`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np

from rbpf.lie import SE2, Array
from rbpf.ranges import MOST, NotNegative, Positive, Range, Ranged, Rate
from rbpf.runs.files import write_text
from rbpf.runs.trajectory import Trajectory, write_tum
from rbpf.validation.simulation.paths import Drive, WheelOdometer, along_corners, dead_reckoning

#: Corners of the walls around the corridor, counterclockwise [m].
OUTER = ((0.0, 0.0), (16.0, 0.0), (16.0, 12.0), (0.0, 12.0))
#: Corners of the block that it leads round, clockwise: the corridor is on the left of both.
INNER = ((2.0, 2.0), (2.0, 10.0), (14.0, 10.0), (14.0, 2.0))
#: Along each wall, of the outer ones first: where a door begins, how wide and how deep it is [m]; below zero it juts
#: out.
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
NO_RETURN_M = 81.83  #: What SICK's scanners write.
START_S, READINGS = 1_000_000_000, 10


@dataclass(frozen=True)
class LaserWorld(Ranged):
    """A robot with a scanner over 180° in a corridor of 16 m by 12 m."""

    scans: Annotated[int, Range(ge=2, le=MOST)] = 400  #: how many, at equal times.
    laps: Annotated[int, Range(ge=1, le=1000)] = 2  #: how many times round.
    std_range_m: NotNegative = 0.01  #: noise of the ranges.
    dropouts: Rate = 0.01  #: fraction of the readings without a return.
    max_range_m: Positive = 20.0  #: farther walls give no return.
    scanner_ahead_m: float = 0.2  #: of the robot's middle.
    odometer: WheelOdometer = field(default_factory=WheelOdometer)  #: of the robot's wheels.


def floor_plan() -> Array:
    """(S, 2, 2) both ends of each piece of wall [m]."""
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
    """(B,) distance to the nearest of the walls (S, 2, 2) along beams at angles (B,), inf where there is none."""
    heading = world_from_sensor[0] + angles
    beam = np.stack([np.cos(heading), np.sin(heading)], axis=-1)[:, None]
    start, along = walls[:, 0] - world_from_sensor[1:], walls[:, 1] - walls[:, 0]

    def cross(a: Array, b: Array) -> Array:
        return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

    # Eye + distance · beam = start + fraction · along.
    with np.errstate(divide="ignore", invalid="ignore"):
        slant = cross(beam, along)
        distance, fraction = cross(start, along) / slant, cross(start, beam) / slant
    met = (distance > 0.0) & (fraction >= 0.0) & (fraction <= 1.0)
    return np.asarray(np.where(met, distance, np.inf).min(axis=1))


def simulate_laser(world: LaserWorld, folder: Path, seed: int) -> None:
    """Writes a log into a folder, created where it does not exist; files of that name are replaced."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    # Round the middle of the corridor, from the middle of its first side.
    (left, low), (right, high) = np.array(OUTER[0]) + LANE_M, np.array(OUTER[2]) - LANE_M
    middle = (0.5 * (left + right), low)
    lap = [(right, low), (right, high), (left, high), (left, low)]
    start, moves = along_corners([middle, *lap * world.laps, middle], BEND_M)
    seconds = sum(move.length_m for move in moves) / SPEED_M_S
    # The wheels are read more often than the scanner.
    times = np.linspace(0.0, seconds, READINGS * (world.scans - 1) + 1)
    driven = Drive(start, moves, seconds, BEND_M, RAMP_S)(times)
    stamps_ns = START_S * 10**9 + np.rint(times * 1e6).astype(np.int64) * 1000
    odometry = dead_reckoning(world.odometer.measure(driven, rng)[0])[::READINGS]
    truth, way_m, stamps_ns = driven.world_from_robot[::READINGS], driven.way_m[::READINGS], stamps_ns[::READINGS]
    # Scans: noise, then what gives no return.
    mount, angles, walls = np.array([0.0, world.scanner_ahead_m, 0.0]), np.radians(np.arange(-90.0, 91.0)), floor_plan()
    ranges = np.stack([cast(walls, SE2.compose(pose, mount), angles) for pose in truth])
    ranges = np.maximum(ranges + world.std_range_m * rng.standard_normal(ranges.shape), 0.0)
    lost = (ranges > world.max_range_m) | (rng.random(ranges.shape) < world.dropouts)
    ranges[lost] = NO_RETURN_M
    lines = ["# FLASER n [range] x y theta odom_x odom_y odom_theta time host time"]
    lines += [f"PARAM robot_frontlaser_offset {world.scanner_ahead_m}"]
    for stamp_ns, pose, scan in zip(stamps_ns.tolist(), odometry, ranges, strict=True):
        sensor = _words(np.roll(SE2.compose(pose, mount), -1), 6)
        time = f"{stamp_ns // 10**9}.{stamp_ns % 10**9 // 1000:06d}"
        robot = _words(np.roll(pose, -1), 6)
        lines.append(f"FLASER {len(scan)} {_words(scan, 3)} {sensor} {robot} {time} simulated {time}")
    write_text(folder / "robot.clf", "\n".join(lines) + "\n")
    write_tum(folder / "truth.tum", Trajectory.from_planar(stamps_ns, truth))
    # Relations: every tenth scan and the next tenth, and the one nearest to it of another round.
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
