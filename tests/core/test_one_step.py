"""What may be asked of a filter before a step, and for a single one."""

import numpy as np

from rbpf.core.filter import Filter
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.worlds import STEP_NS, content, planar_world, same

WORLD = planar_world(6)


class Listening(NamedLandmarkSensor):  # type: ignore[misc]
    """Keeps the belief it is told."""

    def observe(self, frame, belief):
        self.told = belief
        return super().observe(frame, belief)


def started(proposal) -> tuple[Filter, Listening]:
    """A filter after all frames but the last."""
    sensor = Listening(RangeBearing(SE2), Point(2))
    filter_ = Filter(OdometryMotion(SE2), sensor, LandmarkMap(SE2), proposal, n=20, rng=np.random.default_rng(0))
    for t in range(5):
        filter_.step(WORLD.frames[t], WORLD.controls[t], t * STEP_NS)
    return filter_, sensor


def test_what_is_expected_is_what_the_sensors_are_told():
    filter_, sensor = started(None)
    before = content(filter_)
    belief = filter_.expect(WORLD.controls[5], 5 * STEP_NS)
    assert same(content(filter_), before)
    filter_.step(WORLD.frames[5], WORLD.controls[5], 5 * STEP_NS)
    np.testing.assert_array_equal(belief.state, sensor.told.state)
    np.testing.assert_array_equal(belief.prior.factor, sensor.told.prior.factor)
    np.testing.assert_array_equal(belief.log_weights, sensor.told.log_weights)


def test_another_proposal_for_one_step():
    """The same bytes as of a filter that has it always, and the filter's own afterwards."""
    ours, _ = started(EkfProposal())
    theirs, _ = started(EkfProposal())
    theirs.proposal = PriorProposal()
    last = WORLD.frames[5], WORLD.controls[5], 5 * STEP_NS
    report = ours.step(*last, proposal=PriorProposal())
    assert np.isnan(report.nis)
    theirs.step(*last)
    np.testing.assert_array_equal(ours.particles.state, theirs.particles.state)
    np.testing.assert_array_equal(ours.particles.log_weights, theirs.particles.log_weights)
    assert np.isfinite(ours.step(WORLD.frames[5], WORLD.controls[5], 6 * STEP_NS).nis)
