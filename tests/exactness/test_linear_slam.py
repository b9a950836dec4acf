"""FastSLAM on a linear world against the joint Kalman filter: evidence and moments are unbiased."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import MotionModel
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Residual, Systematic
from rbpf.lie import SE2, Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.range_bearing import RelativePosition
from tests.exactness.models import Kalman, LinearMotion, Relative, Scripted, assert_unbiased, deviation
from tests.exactness.slam import LinearSlam, unnormalised_errors

pytestmark = pytest.mark.slow

STEP = np.array([0.8, 0.3])
Q = np.array([[0.2, 0.05], [0.05, 0.1]])


def agree(logs: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    """The largest errors of some forty moments at once may reach four standard errors."""
    assert_unbiased(logs)
    assert deviation(first, 0.0) <= 4.0
    upper = np.triu_indices(first.shape[1])
    assert deviation(second[:, upper[0], upper[1]], 0.0) <= 4.0


@pytest.fixture(scope="module")
def world() -> LinearSlam:
    return LinearSlam(np.eye(2), Q, STEP, Kalman(np.zeros(2), np.zeros((2, 2))), np.eye(2), seed=31)


class Walk(LinearMotion):
    """Position alone, by known steps."""

    def __init__(self):
        super().__init__(np.eye(2), np.linalg.cholesky(Q))

    def transition(self, state, control, dt):
        return super().transition(state, STEP, dt)


def position_filter(proposal, resampler, n, rng) -> Filter:
    return Filter(Walk(), Scripted(), LandmarkMap(Euclidean(2)), proposal, resampler, n, rng)


@pytest.mark.parametrize(
    ("proposal", "resampler"),
    [(PriorProposal(), Residual()), (EkfProposal(), EssTriggered(Systematic(), 0.9))],
    ids=["prior", "ekf"],
)
def test_fastslam_agrees_with_the_joint_kalman_filter(world, proposal, resampler, stream):
    frames = world.frames(Relative())
    agree(*unnormalised_errors(lambda rng: position_filter(proposal, resampler, 60, rng), frames, world.kalman, stream))


def test_a_turned_robot_with_singular_noise_and_the_compiled_kernel(stream):
    """SE(2) with a heading that is known: the noise has no component along it."""
    c, s = np.cos(0.7), np.sin(0.7)
    turned = np.array([[c, -s], [s, c]])
    start = Kalman(np.array([1.0, -2.0]), np.zeros((2, 2)))
    world = LinearSlam(np.eye(2), turned @ Q @ turned.T, turned @ STEP, start, turned, seed=32)
    cov = np.zeros((3, 3))
    cov[1:, 1:] = Q

    class Straight(MotionModel):
        space = SE2

        def transition(self, state, control, dt):
            return OdometryMotion(SE2).transition(state, Odometry(np.append(0.0, STEP), cov), dt)

    def build(rng: np.random.Generator) -> Filter:
        origin = np.array([0.7, 1.0, -2.0])
        return Filter(Straight(), Scripted(), LandmarkMap(SE2), n=60, rng=rng, start=origin)

    agree(*unnormalised_errors(build, world.frames(RelativePosition(SE2)), world.kalman, stream))


@pytest.fixture(scope="module")
def drifting() -> LinearMotion:
    """Position driven by a velocity that is correlated with it through the noise."""
    factor = np.array([[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.1, 0.0, 0.2], [0.0, 0.05, 0.2]])
    return LinearMotion(np.eye(2), factor, 0.7 * np.eye(2), 0.9 * np.eye(2), np.array([0.1, 0.0]))


def test_a_velocity_beside_a_map_agrees_with_the_joint_kalman_filter(drifting, stream):
    velocity = Kalman(np.array([0.0, 0.0, 0.6, 0.2]), np.diag([0.0, 0.0, 0.3, 0.2]))
    F, noise, drift = drifting.joint()
    world = LinearSlam(F, noise, drift, velocity, np.eye(2), seed=33)

    def build(rng: np.random.Generator) -> Filter:
        substate = KalmanSubstate(drifting.space, velocity.mean[2:], velocity.cov[2:, 2:])
        return Filter(drifting, Scripted(), [substate, LandmarkMap(drifting.space)], n=80, rng=rng)

    agree(*unnormalised_errors(build, world.frames(Relative()), world.kalman, stream))
