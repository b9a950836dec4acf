"""The verdict on simulated runs: trusted where nothing is wrong, and not where something is, one fault at a time."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.verdict import bias_odometry, scale_odometry_noise, scale_sensor_noise, swap_names
from rbpf.core.diagnostics import motion_correction
from rbpf.core.filter import Filter
from rbpf.core.models import MotionModel, ObservationModel, Observations, Part, Sensor, Transition
from rbpf.lie import Euclidean
from rbpf.runs.recordings import filter_robot_log as run
from rbpf.runs.truth import truth_at
from rbpf.sensors.range_bearing import RangeBearing
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.against_groundtruth import pose_statistics
from rbpf.validation.consistency.comparison import innovation_statistics
from rbpf.validation.consistency.statistic import coverage, variance_ratio, whitened_errors
from rbpf.validation.consistency.verdict import Verdict, judge
from rbpf.validation.simulation.robot import RobotWorld, simulated_log

pytestmark = pytest.mark.slow

LONG, SHORT = RobotWorld(steps=200, landmarks=80), RobotWorld(steps=120, landmarks=80)
CONFIG = RangeBearingConfig(particles=300)


def verdicts(log, given, config=CONFIG) -> tuple[Verdict, Verdict]:
    """Without the truth, and with it."""
    done = run(given, config).log
    own = innovation_statistics(done["nis"], done["nis_dof"], done["correction"], done["cov_correction"])
    truth = truth_at(log.space, log.truth, done.stamps_ns, "first frame")
    poses = pose_statistics(whitened_errors(log.space, done.poses, done.covs, truth.poses))
    return judge("", own), judge("", [*poses, *own], [statistic.name for statistic in poses])


def test_a_good_range_bearing_run_is_trusted():
    log = simulated_log(LONG, 1)
    alone, beside = verdicts(log, log)
    assert beside.trust == "trust"
    assert alone.trust == "cannot tell"
    assert "compare it" in alone.sentences[1]


@pytest.mark.slow
def test_good_range_bearing_runs_are_hardly_ever_too_short_and_never_distrusted():
    logs = [simulated_log(LONG, seed) for seed in range(6)]
    found = [verdicts(log, log)[1].trust for log in logs]
    assert found.count("do not trust") == 0
    assert found.count("trust") >= 4


FAULTS = {
    "sensor noise times 3": lambda log: scale_sensor_noise(log, 3.0),
    "sensor noise over 3": lambda log: scale_sensor_noise(log, 1 / 3),
    "odometry noise times 3": lambda log: scale_odometry_noise(log, 3.0),
    "odometry noise over 3": lambda log: scale_odometry_noise(log, 1 / 3),
    "odometer bias": lambda log: bias_odometry(log, 1.0),
    "wrong names": lambda log: swap_names(log, 0.2, np.random.default_rng(7)),
}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_not_trusted_with_or_without_truth(fault, seed):
    log = simulated_log(SHORT, seed)
    for verdict in verdicts(log, FAULTS[fault](log), replace(CONFIG, particles=100)):
        assert verdict.trust == "do not trust"
        assert verdict.sentences[1].startswith("Do not trust its uncertainty: ")


@pytest.mark.slow
@pytest.mark.parametrize("part", ["landmark", "state"])
def test_a_wrong_jacobian_is_not_trusted(part, monkeypatch):
    """The derivative of the angle has the wrong sign."""
    log = simulated_log(SHORT, 0)
    right = RangeBearing.jacobians

    def wrong(self, *args, **named):
        jacobians = right(self, *args, **named)
        block = getattr(jacobians, part).copy()
        block[..., 1:, :] *= -1.0
        return jacobians._replace(**{part: block})

    monkeypatch.setattr(RangeBearing, "jacobians", wrong)
    for verdict in verdicts(log, log, replace(CONFIG, particles=100, compiled=False)):
        assert verdict.trust == "do not trust"


class Walk(MotionModel):
    """A random walk of 1 m per step."""

    space = Euclidean(2)

    def transition(self, state, control, dt):
        return Transition(state, np.eye(2)[None])


class Position(ObservationModel):
    """A position fix."""

    dim, reads = 2, frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state


class Receiver(Sensor):
    """Fixes with a claimed standard deviation."""

    def __init__(self, std):
        self.std = std

    def observe(self, frame, belief):
        return [Observations(frame[None], self.std**2 * np.eye(2)[None], Position())]


def linear_gaussian(claimed: float, seed: int = 0, steps: int = 300) -> Verdict:
    """Fixes of 1 m, and what the filter is told of them."""
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.normal(size=(steps, 2)), axis=0)
    filter_ = Filter(Walk(), Receiver(claimed), n=300, rng=rng)
    reports = [filter_.step(fix) for fix in truth + rng.normal(size=(steps, 2))]
    found = [motion_correction(report.mixture) for report in reports]
    own = innovation_statistics(
        np.array([report.nis for report in reports]),
        np.array([report.rows for report in reports], dtype=float),
        np.array([correction.mean for correction in found]),
        np.array([correction.cov for correction in found]),
    )
    mean, cov = (np.array([getattr(r.estimate, name) for r in reports]) for name in ("mean", "cov"))
    poses = pose_statistics(whitened_errors(Walk.space, mean, cov, truth))
    return judge("", [*poses, *own], [statistic.name for statistic in poses])


@pytest.mark.parametrize("seed", range(4))
def test_a_linear_gaussian_run_is_trusted(seed):
    assert linear_gaussian(1.0, seed).trust == "trust"


@pytest.mark.parametrize("claimed", [3.0, 1 / 3])
def test_a_linear_gaussian_run_with_wrong_noise_is_not(claimed):
    verdict = linear_gaussian(claimed)
    assert verdict.trust == "do not trust"
    assert ("too large" if claimed > 1.0 else "too small") in verdict.reason
    assert verdict.leaning == ("cautious" if claimed > 1.0 else "over-confident")
    assert verdict.leaning in verdict.sentences[1]


def test_one_that_claims_too_much_outweighs_all_that_are_cautious():
    """A wide innovation must not hide a pose that is further off than it says."""
    cautious = variance_ratio("innovations", 0.01, 5000.0, 1.1)
    daring = variance_ratio("poses", 20.0, 50.0, 2.0)
    few_inside = coverage(np.full(200, 30.0), 6, 200.0, (0.5,))
    many_inside = coverage(np.full(5000, 0.1), 6, 5000.0, (0.5,))
    assert judge("", [cautious]).leaning == judge("", many_inside).leaning == "cautious"
    assert judge("", [cautious, daring]).leaning == "over-confident"
    assert judge("", [cautious, daring]).reason.startswith("poses: ")
    assert judge("", [cautious, *few_inside]).leaning == "over-confident"
    assert judge("", [variance_ratio("poses", 1.0, 2.0, 2.0)]).leaning == ""


def test_the_reason_is_told_in_standard_deviations():
    """A table may have squares; who reads one sentence wants to know how many times further off the run is."""
    reason = judge("", [variance_ratio("poses", 225.0, 500.0, 2.0)]).reason
    assert reason.startswith("poses: errors are 15 times as large as it claims (14 to 16, where 1 is right)")
    assert reason.endswith("its standard deviations are too small")
    assert "0.1 times as large" in judge("", [variance_ratio("poses", 0.01, 500.0, 2.0)]).reason
    open_ = judge("", [variance_ratio("poses", 1.0, 2.0, 2.0)], ["poses"]).reason
    assert "right within a tenth" in open_ and "within 0.5 to 2," in open_


def test_a_run_of_few_independent_samples_cannot_be_told():
    statistic = variance_ratio("poses", 1.0, 2.0, 2.0)
    verdict = judge("The path is good.", [statistic], ["poses"])
    assert verdict.trust == "cannot tell"
    assert verdict.sentences[0] == "The path is good."
    assert "2 independent samples" in verdict.sentences[1]


def test_without_any_statistic_nothing_is_claimed():
    assert judge("", []).trust == "cannot tell"
