"""The batch adjustment of camera features: factors, optimum and covariance against SciPy, gauge, and consistency."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.feature_log import KnownPoints
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.validation.gtsam.camera import CameraProblem, adjust, begin, solve_features
from rbpf.validation.gtsam.observations import known_by_name, observation_table
from rbpf.validation.gtsam.solvers import marginals_by_schur
from tests.validation.camera_scenes import BENT, FISHEYE, PLAIN, STEREO, WHOLE, scene, solve_by_scipy
from tests.validation.worlds import assert_same

CAMERAS = [PLAIN, BENT, WHOLE, FISHEYE, STEREO]


def estimate(log, seed=5, scale=0.02):
    """The truth, disturbed."""
    rng = np.random.default_rng(seed)
    path = log.truth.poses
    moved = SE3.retract(path, scale * rng.normal(size=(len(path), 6)))
    return InitialEstimate(moved, {n: p + scale * rng.normal(size=3) for n, p in log.truth.landmarks.items()})


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_optimum_and_its_covariance_are_scipys(camera):
    log = scene(camera)
    found = solve_features(log, estimate(log))
    assert_same(found, solve_by_scipy(log), SE3, error=1e-8, path=1e-6, points=2e-6, cov=1e-4)
    assert found.undetermined == []


@pytest.mark.parametrize("camera", [PLAIN, STEREO])
def test_without_known_points_the_first_pose_and_the_scale_are_held(camera):
    log = scene(camera, known=0)
    start = estimate(log)
    found = solve_features(log, start)
    np.testing.assert_allclose(SE3.local(start.world_from_body[0], found.world_from_body[0]), 0, atol=1e-9)
    np.testing.assert_array_equal(found.cov_poses[0], np.zeros((6, 6)))
    far = int(np.argmax(_distances(start.world_from_body)))
    held, kept = _distances(found.world_from_body)[far], _distances(start.world_from_body)[far]
    other = solve_features(log, estimate(log, seed=9))
    assert other.error == pytest.approx(found.error, rel=1e-9)
    scale = _distances(other.world_from_body)[1:] / _distances(found.world_from_body)[1:]
    np.testing.assert_allclose(scale, scale[0], rtol=1e-5)
    if camera is STEREO:
        assert scale[0] == pytest.approx(1.0, abs=1e-5)
    else:
        assert held == pytest.approx(kept, rel=1e-7)
        along = found.world_from_body[far, 4:] - found.world_from_body[0, 4:]
        cov = SE3.rotation(found.world_from_body[far]) @ found.cov_poses[far, 3:, 3:]
        cov = cov @ SE3.rotation(found.world_from_body[far]).T
        assert along @ cov @ along < 1e-9 * np.trace(cov) * along @ along


def _distances(path):
    return np.linalg.norm(path[:, 4:] - path[0, 4:], axis=1)


def test_points_known_exactly_stay_where_they_are():
    log = scene()
    exact = replace(log, known=KnownPoints(log.known.names, log.known.positions, np.zeros_like(log.known.cov)))
    found = solve_features(exact, InitialEstimate(log.truth.poses, {}))
    tight = replace(log, known=KnownPoints(log.known.names, log.known.positions, 1e-6 * log.known.cov))
    near = solve_features(tight, estimate(log))
    for name, position in zip(log.known.names.tolist(), log.known.positions, strict=True):
        np.testing.assert_allclose(found.landmarks[name], position, atol=1e-12)
        assert np.abs(found.cov_landmarks[name]).max() < 1e-20
    assert np.abs(SE3.local(near.world_from_body, found.world_from_body)).max() < 1e-4


def test_a_robust_loss_is_opt_in_and_is_hubers():
    log = scene(points=20)
    bad = replace(log, frames=list(log.frames))
    for step in (1, 3, 4):
        z = log.frames[step].z.copy()
        z[-step] += [60.0, -40.0]
        bad.frames[step] = replace(log.frames[step], z=z)
    plain, robust, clean = (
        solve_features(one, estimate(log), robust=loss, marginals=False)
        for one, loss in ((bad, None), (bad, 1.345), (log, None))
    )
    expected = solve_by_scipy(bad, robust=1.345)
    assert robust.error == pytest.approx(expected.error, rel=1e-6)
    off = [np.abs(SE3.local(clean.world_from_body, s.world_from_body)).max() for s in (plain, robust)]
    assert off[0] > 3 * off[1]
    assert np.abs(SE3.local(expected.world_from_body, robust.world_from_body)).max() < 1e-3


def adjusted(camera, known: str):
    """The optimum of a small scene, with known points as they are, exact ones, or none."""
    log = scene(camera)
    if known == "exact":
        log = replace(log, known=replace(log.known, cov=np.zeros_like(log.known.cov)))
    if known == "none":
        log = replace(log, known=None)
    table, names = observation_table(log), {}
    if log.known is not None:
        names = known_by_name(log.known, table.names)
    problem = CameraProblem(log.name, len(log.frames), table, names)
    start = begin(problem, InitialEstimate(log.truth.poses, {}))
    return adjust(problem, start)


def test_a_landmark_that_nothing_determines_is_refused():
    """A single camera's only sighting of a point leaves its distance open."""
    found = adjusted(STEREO, "none")
    problem, graph = found.problem, gtsam.NonlinearFactorGraph()
    last = problem.point_keys[-1]
    for index in range(found.graph.size()):
        keys = list(found.graph.at(index).keys())
        if last not in keys:
            graph.push_back(found.graph.at(index))
    values = gtsam.Values(found.values)
    weak = gtsam.noiseModel.Diagonal.Sigmas(np.array([1.0, 1.0, np.inf]))
    graph.push_back(gtsam.PriorFactorPoint3(last, values.atPoint3(last), weak))
    with pytest.raises(InputError, match="do not determine all poses and landmarks"):
        marginals_by_schur(graph, values, problem.pose_keys, problem.point_keys, problem.held_keys, problem.name)
