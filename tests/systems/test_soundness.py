"""A good run of each system gives no sign of failure, where every sign has had the steps that it needs."""

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rbpf.runs.recordings import filter_features, filter_opened, open_robot_log
from rbpf.runs.run import Run
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.simulation.robot import RobotWorld, simulated_log
from tests.systems.laser_worlds import laser, scans
from tests.systems.mono_logs import SMALL, desk
from tests.systems.test_stereo_features import filtered, simulated

pytestmark = pytest.mark.slow


def robot(kind: Any, noise: float = 1.0) -> Run:
    log = simulated_log(RobotWorld(steps=100), 0)
    log = replace(log, frames=[replace(frame, cov_z=noise**2 * frame.cov_z) for frame in log.frames])
    return filter_opened(open_robot_log(log, RangeBearingConfig(map=kind)))


def scanner() -> Any:
    slam = laser(distance_m=0.2)
    values = [slam.take(scan).values for scan in scans(60)]
    return SimpleNamespace(system=slam, log={name: np.array([one[name] for one in values]) for name in values[0]})


MAKE: dict[str, Callable[[], Any]] = {
    "robot": lambda: robot("particles"),
    "joint": lambda: robot("joint"),
    "mono": lambda: filter_features(desk(1, frames=60), SMALL),
    "stereo": lambda: filtered(simulated(60)),
    "laser": scanner,
}


@pytest.mark.parametrize("name", MAKE)
def test_a_good_run_is_not_suspected(name):
    done = MAKE[name]()
    system, log = done.system, done.log
    assert system.filter.health.findings == {}
    # Weights, copies; innovations and evidence where there are some; ancestors where particles are resampled.
    assert system.filter.steps >= 50
    if name != "laser":
        assert np.isfinite(log["nis"]).sum() >= 40 and np.isfinite(log["log_evidence"]).sum() >= 44
    if name != "joint":
        assert log["resampled"].sum() >= 20


def test_what_a_filter_is_suspected_of_names_the_frame_once():
    assert re.match(r"step \d+: squared innovations are", robot("joint", noise=0.1).messages[0])
