"""A good run of each system gives no sign of failure, where every sign has had the steps that it needs."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rbpf.runs.recordings import filter_features, filter_opened, open_robot_log
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.system import System
from rbpf.validation.simulation.robot import RobotWorld, simulated_log
from tests.systems.laser_worlds import laser, scans
from tests.systems.mono_logs import SMALL, desk
from tests.systems.test_stereo_features import filtered, simulated

pytestmark = pytest.mark.slow


def robot(kind: Any) -> tuple[System, Any]:
    done = filter_opened(open_robot_log(simulated_log(RobotWorld(steps=100), 0), RangeBearingConfig(map=kind)))
    return done.system, done.log


def mono() -> tuple[System, Any]:
    done = filter_features(desk(1, frames=60), SMALL)
    return done.system, done.log


def stereo() -> tuple[System, Any]:
    done = filtered(simulated(60))
    return done.system, done.log


def scanner() -> tuple[System, Any]:
    slam = laser(distance_m=0.2)
    values = [slam.take(scan).values for scan in scans(60)]
    return slam, {name: np.array([one[name] for one in values]) for name in values[0]}


MAKE: dict[str, Callable[[], tuple[System, Any]]] = {
    "robot": lambda: robot("particles"),
    "joint": lambda: robot("joint"),
    "mono": mono,
    "stereo": stereo,
    "laser": scanner,
}


@pytest.mark.parametrize("name", MAKE)
def test_a_good_run_is_not_suspected(name):
    system, log = MAKE[name]()
    assert system.filter.health.findings == {}
    # Weights, copies; innovations and evidence where there are some; ancestors where particles are resampled.
    assert system.filter.steps >= 50
    if name != "laser":
        assert np.isfinite(log["nis"]).sum() >= 40 and np.isfinite(log["log_evidence"]).sum() >= 44
    if name != "joint":
        assert log["resampled"].sum() >= 20
