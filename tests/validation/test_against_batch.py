"""A run beside its batch optimum: where both must agree, the gauge, and what a folder must hold."""

import json
from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.checkpoint import save_arrays
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.folder import write_run, write_trajectory
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.recordings import filter_features, filter_opened, open_robot_log
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency import against_batch
from rbpf.validation.consistency.against_batch import (
    DRAWS,
    LANDMARKS,
    POSES,
    SAME,
    SCALED,
    compare,
    compare_folder,
    compare_run,
    compare_with_batch,
)
from rbpf.validation.gtsam.batch_problem import solve_problem
from rbpf.validation.metrics.gaussian_differences import compare_last_pose
from tests.validation.camera_scenes import scene
from tests.validation.linear_worlds import linear_log


@pytest.fixture(scope="module")
def linear_run():
    return filter_opened(open_robot_log(linear_log(), RangeBearingConfig(particles=2000, anchor_every=0)))


@pytest.fixture
def folder(linear_run, tmp_path):
    write_run(linear_run, tmp_path / "run", {"recording": str(tmp_path / "log")})
    return tmp_path / "run"


def test_in_a_linear_world_the_filter_is_the_batch_within_monte_carlo_error(linear_run):
    found = compare_run(linear_run)
    for gaussians, count in ((found.landmarks, 5), (found.poses, 1)):
        assert len(gaussians) == count
        assert gaussians.sigmas.max() < 0.25
        assert gaussians.sigma_ratio == pytest.approx(np.ones(count), abs=0.06)
        assert gaussians.kullback_leibler.max() < 0.05
        assert gaussians.bhattacharyya.max() < 0.0125
    assert found.poses.keys.tolist() == [11]
    assert found.scale == 1.0 and found.gauge == SAME
    assert found.fit_batch["sightings"] == found.fit_filter["sightings"] == len(found.optimum.problem.z)


def test_a_posterior_that_is_not_gaussian_is_no_witness(folder, monkeypatch):
    found, _ = compare_with_batch(RunFolder.open(folder))
    assert {POSES, LANDMARKS} < {statistic.name for statistic in found.statistics}
    assert found.figures["posterior_draws_ess"] > 0.99 * DRAWS and "no witness" not in found.accuracy
    monkeypatch.setattr(against_batch, "LEAST_COUNT", 1.1)
    found, _ = compare_with_batch(RunFolder.open(folder))
    assert not {POSES, LANDMARKS} & {statistic.name for statistic in found.statistics}
    assert "so that it is no witness of the uncertainty." in found.accuracy


def test_a_folder_tells_the_same_as_the_run(linear_run, folder):
    direct, stored = compare_run(linear_run), compare_folder(folder)
    assert stored.path.rmse == pytest.approx(direct.path.rmse)
    for name in ("keys", "sigmas", "kullback_leibler"):
        assert getattr(stored.landmarks, name) == pytest.approx(getattr(direct.landmarks, name))
    log = linear_run.log
    write_trajectory(folder, log.stamps_ns, log.poses, log.covs)
    with_poses = compare_folder(folder)
    assert with_poses.poses.sigmas == pytest.approx(compare_run(linear_run).poses.sigmas)
    text = json.dumps(with_poses.as_dict(), allow_nan=False)
    assert json.loads(text)["landmarks"]["count"] == 5


def test_known_points_make_one_world_of_filter_and_batch():
    log = scene(frames=8, points=20, known=6, noise_px=1.0)
    isotropic = [replace(f, cov_z=np.tile(np.eye(2), (len(f.z), 1, 1))) for f in log.frames]
    done = filter_features(replace(log, frames=isotropic), MonoConfig(particles=200))
    found = compare_run(done)
    assert found.gauge == SAME and found.scale == 1.0
    assert found.poses.dims == 6 and found.landmarks.dims == 3
    assert len(found.poses) == 1
    assert found.poses.sigmas.max() < 5.0
    assert found.path.rmse < 0.1


def camera_problem():
    """A log without known points, and its optimum as if a filter had found it, in another scale."""
    log = replace(scene(frames=7, points=18, known=0, seed=3), known=None)
    optimum = solve_problem(log, log.truth.poses)
    return log, optimum.estimate


def scaled_by(estimate, scale):
    first = estimate.world_from_body[0, 4:]
    poses = estimate.world_from_body.copy()
    poses[:, 4:] = first + scale * (poses[:, 4:] - first)
    by = np.repeat([1.0, scale], 3)
    points = estimate.landmarks
    moved = MapEstimate(points.ids, first + scale * (points.mean - first), scale**2 * points.cov)
    return PathAndMap(estimate.stamps_ns, poses, estimate.cov_poses * np.outer(by, by), moved)


@pytest.mark.parametrize("std_scale", [0.0, 0.3])
def test_without_known_points_neither_the_scale_nor_its_uncertainty_matters(std_scale):
    log, estimate = camera_problem()
    first = estimate.world_from_body[0, 4:]
    out = estimate.landmarks.mean - first
    points = replace(estimate.landmarks, cov=estimate.landmarks.cov + std_scale**2 * out[:, :, None] * out[:, None])
    along = SE3.rotation(estimate.world_from_body).mT @ (estimate.world_from_body[:, 4:] - first)[..., None]
    covs = estimate.cov_poses.copy()
    covs[:, 3:, 3:] += std_scale**2 * along @ along.mT
    ours = scaled_by(replace(estimate, landmarks=points, cov_poses=covs), 2.5)
    found = compare(ours, log)
    assert found.gauge == SCALED
    assert found.scale == pytest.approx(1.0, rel=1e-4)
    assert found.path.rmse < 1e-4
    size = [np.ptp(one.world_from_body[:, 4:], axis=0).max() for one in (found.optimum.estimate, estimate)]
    assert size[0] == pytest.approx(2.5 * size[1], rel=1e-3)
    assert (found.landmarks.dims, found.poses.dims) == (2, 5)
    assert found.landmarks.sigmas.max() < 1e-2
    assert found.poses.sigmas[-1] < 1e-2
    assert found.landmarks.sigma_ratio == pytest.approx(np.ones(len(found.landmarks)), rel=1e-3)
    assert found.poses.sigma_ratio[-1] == pytest.approx(1.0, rel=1e-3)


def test_a_covariance_is_carried_to_the_chart_at_the_other_pose():
    _, estimate = camera_problem()
    far = np.array([0.4, -0.3, 0.5, 0.2, 0.1, -0.3])
    there = SE3.retract(estimate.world_from_body[-1:], far)
    cov = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + 0.5
    estimate = replace(estimate, cov_poses=np.repeat(cov[None], 7, axis=0))
    other = replace(estimate, world_from_body=np.concatenate([estimate.world_from_body[:-1], there]))
    found = compare_last_pose(estimate, other, 6, across=False)
    rng, mean = np.random.default_rng(0), estimate.world_from_body[-1]
    factor = 1e-3 * np.linalg.cholesky(cov)
    samples = SE3.local(there[0], SE3.retract(mean, rng.normal(size=(20_000, 6)) @ factor.T))
    delta = SE3.local(there[0], mean)
    spread = 1e6 * np.einsum("ki,kj->ij", samples - delta, samples - delta) / len(samples)
    assert np.abs(spread - cov).max() > 0.3, "the two charts must differ for this to be a test"
    assert found.sigmas[0] == pytest.approx(np.sqrt(delta @ np.linalg.solve(spread, delta)), rel=0.03)
    assert found.distances_m[0] == pytest.approx(np.linalg.norm(there[0, 4:] - mean[4:]))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda f: (f / "config.yaml").unlink(), "has no config.yaml"),
        (lambda f: save_arrays(f / "map.npz", {"id": np.arange(2)}), "array mean is missing"),
    ],
)
def test_a_folder_that_is_no_finished_run_is_refused(folder, spoil, says):
    spoil(folder)
    with pytest.raises(InputError, match=says):
        compare_folder(folder)


def test_path_and_measurements_of_different_runs_are_refused(linear_run):
    filtered = PathAndMap.of_run(linear_run)
    problem = linear_run.system.measurements(linear_run.name, linear_run.log)
    later = replace(filtered, stamps_ns=filtered.stamps_ns + 1)
    with pytest.raises(InputError, match="do not share their time stamps"):
        compare(later, problem)
    rows = {name: getattr(problem, name)[problem.steps < 2] for name in ("steps", "landmarks", "z", "cov_z")}
    moves = {"deltas": problem.deltas[:1], "covs": problem.covs[:1]}
    short = replace(problem, stamps_ns=problem.stamps_ns[:2], **moves, **rows)
    with pytest.raises(InputError, match="2 steps, expected 3"):
        compare(filtered.at(np.arange(2)), short)
