"""Visual odometry beside GTSAM's adjustment of the same two views."""

import gtsam
import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.motion.least_squares import Rule
from rbpf.motion.stereo_vo import VoConfig, fit
from tests.motion.stereo_pairs import LEAP, ROAD, ROOM, correlated

STRICT = VoConfig(rule=Rule(offset=1e-7, iterations=100))
all_worlds = pytest.mark.parametrize("world", [ROAD, ROOM, LEAP], ids=["road", "room", "leap"])


@all_worlds
def test_the_motion_and_its_covariance_are_gtsams(world):
    """A factor graph of two poses and all points, the first pose held."""
    matches, delta = correlated(world, 40, np.random.default_rng(0))
    camera, one = matches.camera, matches.camera.camera
    pair = gtsam.Cal3_S2Stereo(one.fx, one.fy, 0.0, one.cx, one.cy, camera.baseline_m)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3()))
    values.insert(0, gtsam.Pose3())
    values.insert(1, gtsam.Pose3(SE3.matrix(delta)))
    order = [0, 2, 1]
    for row, point in enumerate(camera.triangulate(matches.z_prev)):
        values.insert(100 + row, point)
        both = (0, matches.z_prev, matches.cov_prev), (1, matches.z_now, matches.cov_now)
        for pose, z, cov in both:
            noise = gtsam.noiseModel.Gaussian.Covariance(cov[row][np.ix_(order, order)])
            seen = gtsam.StereoPoint2(*z[row][order])
            graph.push_back(gtsam.GenericStereoFactor3D(seen, noise, pose, 100 + row, pair))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-14)
    params.setAbsoluteErrorTol(1e-12)
    best = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    theirs = SE3.from_matrix(best.atPose3(1).matrix())
    cov = gtsam.Marginals(graph, best).marginalCovariance(1)
    ours = fit(matches, SE3.identity(), STRICT)
    std = np.sqrt(np.diagonal(cov))
    np.testing.assert_allclose(SE3.local(theirs, ours.x) / std, 0.0, atol=1e-3)
    np.testing.assert_allclose(0.5 * ours.squared, graph.error(best), rtol=1e-8)
    np.testing.assert_allclose(ours.cov / np.outer(std, std), cov / np.outer(std, std), atol=2e-3)
