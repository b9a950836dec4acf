"""A robot with a laser scanner in the simulated corridor."""

import itertools
from functools import cache

import numpy as np

from rbpf.lie import SE2
from rbpf.sensors.laser import Scan, Scanner
from rbpf.systems.laser.config import LaserConfig
from rbpf.systems.laser.slam import LaserSlam
from rbpf.validation.simulation.laser import cast, floor_plan

SCANNER = Scanner(np.radians(np.arange(-90.0, 91.0, 2.0)), 0.0, 20.0, np.array([0.0, 0.2, 0.0]))


def laser(**options: object) -> LaserSlam:
    return LaserSlam(SCANNER, LaserConfig(**{"particles": 10, "distance_m": 0.3, **options}))


@cache
def driven(count: int) -> tuple[np.ndarray, list[Scan]]:
    """World_from_robot (T, 3) from the first pose on, along the corridor and round its corner, and the scans, one a second."""
    rng, poses = np.random.default_rng(3), [np.array([0.0, 11.0, 1.0])]
    for t in range(1, count):
        turn = 0.2 if 10 <= t < 18 else 0.0
        poses.append(SE2.compose(poses[-1], np.array([turn, 0.25, 0.0])))
    truth = np.array(poses)
    odometry, frames = [SE2.identity()], []
    for before, now in itertools.pairwise(truth):
        delta = SE2.between(before, now)
        odometry.append(SE2.compose(odometry[-1], SE2.retract(delta, rng.normal(size=3) * [0.02, 0.015, 0.005])))
    for t, (pose, told) in enumerate(zip(truth, odometry, strict=True)):
        ranges = cast(floor_plan(), SE2.compose(pose, SCANNER.robot_from_sensor), SCANNER.angles)
        ranges = ranges + 0.01 * rng.normal(size=ranges.size)
        frames.append(Scan(t * 1_000_000_000, np.where(ranges < SCANNER.max_range_m, ranges, np.inf), told))
    return SE2.between(truth[0], truth), frames


def scans(count: int) -> list[Scan]:
    return driven(count)[1]
