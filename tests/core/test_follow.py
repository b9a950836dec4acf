"""Following given states, looking ahead, and a single step of another proposal."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import NewLandmarks, Observations
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.errors import InputError
from rbpf.lie import SE2, Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.worlds import STEP_NS, content, planar_world, same
from tests.exactness.models import Frame, Kalman, LinearMotion, Relative, Scripted

NOISE = np.diag([0.3, 0.5])
PATH = np.array([[0.0, 0.0], [1.0, 0.5], [1.5, 2.0]])
STEP = 1_000_000_000


def frames(rng: np.random.Generator) -> list[Frame]:
    """A landmark at (4, 1), seen three times."""
    z = np.array([4.0, 1.0]) - PATH + rng.multivariate_normal(np.zeros(2), NOISE, size=3)
    start = Frame(new_landmarks=[NewLandmarks(z[:1], NOISE[None], Relative(), Point(2))])
    again = [Frame([Observations(z[t : t + 1], NOISE[None], Relative(), ids=np.array([0]))]) for t in (1, 2)]
    return [start, *again]


def followed(states: np.ndarray, seen: list[Frame]) -> tuple[Filter, np.ndarray]:
    """A filter that has followed states (T, N, 2), and the log-likelihoods (T, N) of what was seen."""
    motion = LinearMotion(np.eye(2), 0.1 * np.eye(2))
    filter_ = Filter(motion, Scripted(), LandmarkMap(Euclidean(2)), n=states.shape[1], rng=np.random.default_rng(0))
    return filter_, np.array([filter_.follow(state, frame) for state, frame in zip(states, seen, strict=True)])


def test_states_history_clock_and_map_are_those_of_each_given_path():
    rng = np.random.default_rng(1)
    seen, offset = frames(rng), rng.normal(size=(3, 4, 2))
    states = PATH[:, None] + offset
    filter_, log_densities = followed(states, seen)
    np.testing.assert_array_equal(filter_.history.paths(), states)
    np.testing.assert_array_equal(filter_.particles.state, states[-1])
    np.testing.assert_allclose(filter_.particles.log_weights, -np.log(4))
    assert (filter_.steps, filter_.stamp_ns, filter_.log_evidence) == (3, 2 * STEP, 0.0)
    records = filter_.belief().read([0])
    for i in range(4):
        first = seen[0].new_landmarks[0].z[0] + states[0, i]
        kalman = Kalman(first, NOISE)
        for t in (1, 2):
            before = kalman.log_evidence
            kalman.update(seen[t].groups[0].z[0] + states[t, i], np.eye(2), NOISE)
            assert log_densities[t, i] == pytest.approx(kalman.log_evidence - before, abs=1e-9)
        np.testing.assert_allclose(records.mean[i, 0], kalman.mean, atol=1e-9)
        np.testing.assert_allclose(records.cov[i, 0], kalman.cov, atol=1e-9)


def test_one_state_serves_all_particles_and_steps_go_on_from_it():
    filter_, _ = followed(np.repeat(PATH[:, None], 3, axis=1), frames(np.random.default_rng(3))[:3])
    filter_.follow(np.array([9.0, 9.0]), Frame())
    assert (filter_.particles.state == 9.0).all() and filter_.step(Frame()).stamp_ns == 4 * STEP
    assert np.abs(filter_.particles.state - 9.0).max() < 1.0


def test_a_substate_is_conditioned_on_the_way_that_was_gone():
    """A velocity of which nothing is known is, after a step of 2 m in a second, about 2 m/s."""
    motion = LinearMotion(np.eye(1), np.array([[0.01, 0.0], [0.0, 0.01]]), np.eye(1), np.eye(1), np.zeros(1))
    velocity = KalmanSubstate(Euclidean(1), np.zeros(1), 100.0 * np.eye(1))
    filter_ = Filter(motion, Scripted(), velocity, n=2, rng=np.random.default_rng(0))
    filter_.follow(np.array([[2.0], [-3.0]]), Frame())
    np.testing.assert_allclose(velocity.mean[:, 0], [2.0, -3.0], atol=1e-3)


@pytest.mark.parametrize(
    ("state", "stamp_ns", "says"),
    [
        (np.zeros((4, 2)), None, r"\(2,\) or \(3, 2\)"),
        (np.full(2, np.nan), None, "finite"),
        (np.zeros(2), -1, "time runs backwards"),
    ],
)
def test_what_cannot_be_followed(state, stamp_ns, says):
    filter_, _ = followed(np.repeat(PATH[:1, None], 3, axis=1), frames(np.random.default_rng(4))[:1])
    with pytest.raises(InputError, match=says):
        filter_.follow(state, Frame(), stamp_ns=stamp_ns)


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
    assert np.isnan(ours.step(*last, proposal=PriorProposal()).nis)
    theirs.step(*last)
    np.testing.assert_array_equal(ours.particles.state, theirs.particles.state)
    np.testing.assert_array_equal(ours.particles.log_weights, theirs.particles.log_weights)
    assert np.isfinite(ours.step(WORLD.frames[5], WORLD.controls[5], 6 * STEP_NS).nis)
