"""FastSLAM on a linear world against the joint Kalman filter: evidence and moments are unbiased."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Residual, Systematic
from rbpf.lie import SE2, Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.range_bearing import RelativePosition
from tests.exactness import slam
from tests.exactness.models import Relative, Scripted, assert_unbiased, deviation

pytestmark = pytest.mark.slow


def agree(logs: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    """The largest errors of some forty moments at once may reach four standard errors."""
    assert_unbiased(logs)
    assert deviation(first, 0.0) <= 4.0
    upper = np.triu_indices(first.shape[1])
    assert deviation(second[:, upper[0], upper[1]], 0.0) <= 4.0


@pytest.mark.parametrize(
    ("proposal", "resampler"),
    [(PriorProposal(), Residual()), (EkfProposal(), EssTriggered(Systematic(), 0.9))],
    ids=["prior", "ekf"],
)
def test_fastslam_agrees_with_the_joint_kalman_filter(proposal, resampler, stream):
    world = slam.walked()

    def build(rng: np.random.Generator) -> Filter:
        return Filter(slam.Walk(), Scripted(), LandmarkMap(Euclidean(2)), proposal, resampler, 60, rng)

    agree(*slam.unnormalised_errors(build, world.frames(Relative()), world.kalman, stream))


def test_a_turned_robot_with_singular_noise_and_the_compiled_kernel(stream):
    """SE(2) with a heading that is known: the noise has no component along it."""
    world = slam.turned()

    def build(rng: np.random.Generator) -> Filter:
        return Filter(OdometryMotion(SE2), Scripted(), LandmarkMap(SE2), n=60, rng=rng, start=slam.TURNED)

    agree(*slam.unnormalised_errors(build, world.frames(RelativePosition(SE2)), world.kalman, stream, slam.ALONG))


def test_a_velocity_beside_a_map_agrees_with_the_joint_kalman_filter(stream):
    start, space = slam.velocity(), slam.DRIFTING.space
    world = slam.LinearSlam(*slam.DRIFTING.joint(), start, np.eye(2), seed=33)

    def build(rng: np.random.Generator) -> Filter:
        substate = KalmanSubstate(space, start.mean[2:], start.cov[2:, 2:])
        return Filter(slam.DRIFTING, Scripted(), [substate, LandmarkMap(space)], n=80, rng=rng)

    agree(*slam.unnormalised_errors(build, world.frames(Relative()), world.kalman, stream))
