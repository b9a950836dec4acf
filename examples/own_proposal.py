"""A custom proposal: FastSLAM 2.0's refined Gaussian, widened.

S05 §V finds the measurement-conditioned proposal overconfident and injects noise into it. Here samples are
drawn from a wider Gaussian, and the exact importance ratio corrects for the widening: the estimate remains
correct, and the effective sample size shows the cost of the widening.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rbpf import EkfProposal, Filter, LandmarkMap, Point, Proposal
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from rbpf.sensors.readers import RobotLog, open_log
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


class WidenedProposal(Proposal):
    """The refined Gaussian with its standard deviations multiplied by `factor`."""

    exact = True

    def __init__(self, factor: float) -> None:
        self.refined = EkfProposal()
        self.factor = factor

    def propose(self, prior, linearise, rng):
        proposed = self.refined.propose(prior, linearise, rng)
        return replace(proposed, root=self.factor * proposed.root)


def filtered(log: RobotLog, proposal: Proposal) -> tuple[float, float]:
    """Mean position error [m] over a log, and the mean effective sample size."""
    assert log.truth is not None
    sensor = NamedLandmarkSensor(RangeBearing(log.space, log.robot_from_sensor), Point(2))
    filter_ = Filter(
        OdometryMotion(log.space), sensor, LandmarkMap(log.space), proposal, n=100, rng=np.random.default_rng(0)
    )
    errors, sizes = [], []
    for frame, true_pose in zip(log.frames, log.truth.poses, strict=True):
        control = None if frame.delta is None else Odometry(frame.delta, frame.cov_delta)
        report = filter_.step(frame, control, frame.stamp_ns)
        errors.append(np.linalg.norm((report.estimate.mean - true_pose)[1:]))
        sizes.append(report.ess)
    return float(np.mean(errors)), float(np.mean(sizes))


def main() -> dict[float, tuple[float, float]]:
    """Prints error and effective sample size for several widenings."""
    with TemporaryDirectory() as folder:
        simulate_robot(RobotWorld(steps=100, landmarks=40), Path(folder), seed=0)
        log = open_log(folder)
    figures = {}
    for factor in (1.0, 1.5, 3.0):
        figures[factor] = filtered(log, WidenedProposal(factor))
        error, size = figures[factor]
        print(f"widened {factor:.1f} times: error {error:.3f} m, effective sample size {size:4.1f} of 100")
    return figures


if __name__ == "__main__":
    main()
