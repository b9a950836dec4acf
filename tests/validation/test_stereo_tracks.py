"""The recorded stereo tracks of GTSAM's examples: the reference figures, the batch solution, visual odometry alone."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.motion.stereo_vo import MotionPrior
from rbpf.sensors.readers.stereo_tracks import read_stereo_tracks
from rbpf.systems.stereo.config import MapConfig, OdometryConfig, StereoConfig
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.validation.gtsam.camera import CameraEstimate, solve_features
from rbpf.validation.gtsam.camera_graph import CameraProblem, CameraState
from rbpf.validation.gtsam.observations import observation_table

pytestmark = [pytest.mark.real_data, pytest.mark.slow]


@pytest.fixture(scope="module")
def tracks(data_dir):
    return read_stereo_tracks(data_dir / "gtsam_stereo_vo")


@pytest.fixture(scope="module")
def solved(tracks):
    start = CameraEstimate(tracks.world_from_camera, first_observations(tracks))
    return solve_features(tracks.log, start, marginals=False)


def first_observations(tracks):
    """Where each landmark was when it was first seen, on the guessed path."""
    points = {}
    for frame, pose in zip(tracks.log.frames, tracks.world_from_camera, strict=True):
        places = SE3.transform(pose, tracks.log.camera.triangulate(frame.z))
        for name, place in zip(frame.landmarks.tolist(), places, strict=True):
            points.setdefault(name, place)
    return points


def test_the_reference_figures_and_the_batch_solution(tracks, solved):
    """Half the squared error 90342.1 → 7399.0, 0.306 px per residual.

    `solve_features` adds weak priors for what has no parallax, 342 landmarks here; they change the path by less than
    a tenth of a millimetre, and the error by 0.11 %.
    """
    log, points, guess = tracks.log, first_observations(tracks), tracks.world_from_camera
    assert (len(log.frames), sum(len(frame.z) for frame in log.frames), len(points)) == (77, 52544, 15638)
    table = observation_table(log)
    problem = CameraProblem(log.name, len(log.frames), table, {})
    places = np.array([points[name] for name in table.names.tolist()])
    state = CameraState(guess, places)
    graph = problem.graph(state, np.zeros(len(places), dtype=bool), guess)
    values = problem.values(state)
    # The reference started from points in the file, which are rounded.
    assert graph.error(values) == pytest.approx(90342.1, abs=1.0)
    best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert graph.error(best) == pytest.approx(7399.0, abs=0.1)
    assert np.sqrt(2.0 * graph.error(best) / (3 * 52544)) == pytest.approx(0.306, abs=5e-4)
    assert solved.error == pytest.approx(7399.0, rel=2e-3)
    theirs = gtsam.utilities.extractPose3(best)[:, 9:]
    np.testing.assert_allclose(solved.world_from_camera[:, 4:], theirs, atol=2e-4)


def test_visual_odometry_alone(tracks, solved):
    """Over 69 m, beside the batch solution of all measurements; the guess in the file is 0.09 m off."""
    log = tracks.log
    frames = [replace(frame, stamp_ns=100_000_000 * frame.stamp_ns) for frame in log.frames]
    odometry = OdometryConfig(prior=MotionPrior(std_speed=10.0))
    slam = StereoSlam(log.camera, StereoConfig(1, odometry=odometry, map=MapConfig(used=False)))
    said = [slam.take(frame) for frame in frames]
    path = np.array([one.values["odometry"] for one in said])
    batch = SE3.between(solved.world_from_camera[0], solved.world_from_camera)
    off = np.linalg.norm(path[:, 4:] - batch[:, 4:], axis=1)
    assert not any(one.messages for one in said)
    assert np.sqrt(np.square(off).mean()) < 0.1
    assert off[-1] < 0.2
