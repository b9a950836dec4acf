"""A run beside its batch optimum and its truth: where they agree, worlds of their own, what a folder must hold."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.checkpoint import save_arrays
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs import plots
from rbpf.runs.folder import write_map, write_run, write_trajectory
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.recordings import filter_features, filter_opened, open_robot_log
from rbpf.runs.results import load
from rbpf.runs.trajectory import Similarity, read_tum, write_tum
from rbpf.runs.truth import Precision, RunTruth, write_truth
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
from rbpf.validation.consistency.against_groundtruth import LANDMARKS as IN_TRUTH
from rbpf.validation.consistency.against_groundtruth import NEES, compare_with_truth, truth_errors
from rbpf.validation.gtsam.batch_problem import solve_problem
from rbpf.validation.metrics.gaussian_differences import compare_last_pose
from rbpf.validation.simulation.robot import RobotWorld, simulated_log
from tests.validation.camera_scenes import scene
from tests.validation.worlds import linear_log


@pytest.fixture(scope="module")
def linear_run():
    return filter_opened(open_robot_log(linear_log(), RangeBearingConfig(particles=2000)))


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
    assert found.poses.keys.tolist() == [11]
    assert found.scale == 1.0 and found.gauge == SAME
    assert found.fit_batch["sightings"] == found.fit_filter["sightings"] == len(found.optimum.problem.z)


def test_a_posterior_that_is_not_gaussian_is_no_witness(folder, monkeypatch):
    found, _ = compare_with_batch(RunFolder.open(folder))
    assert {POSES, LANDMARKS} < {statistic.name for statistic in found.statistics}
    assert found.figures["posterior_draws_ess"] > 0.99 * DRAWS and "no witness" not in found.accuracy
    monkeypatch.setattr(against_batch, "LEAST_COUNT", 1.1)
    found, _ = compare_with_batch(RunFolder.open(folder))
    assert [statistic.name for statistic in found.statistics] == ["residuals of the batch optimum"]
    assert "so that it is no witness of the uncertainty." in found.accuracy
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace("likelihood:\n  kind: null", "likelihood:\n  kind: outliers"))
    assert compare_with_batch(RunFolder.open(folder))[0].statistics == []  # nor the sum of all squares of its noise


def test_a_folder_tells_the_same_as_the_run(linear_run, folder):
    direct, stored = compare_run(linear_run), compare_folder(folder)
    assert stored.path.rmse == pytest.approx(direct.path.rmse)
    for name in ("keys", "sigmas", "kullback_leibler"):
        assert getattr(stored.landmarks, name) == pytest.approx(getattr(direct.landmarks, name))
    log = linear_run.log
    write_trajectory(folder, log.stamps_ns, log.poses, log.covs)
    with_poses = compare_folder(folder)
    assert with_poses.poses.sigmas == pytest.approx(compare_run(linear_run).poses.sigmas)
    assert json.loads(json.dumps(with_poses.landmarks.as_dict(), allow_nan=False))["count"] == 5


def test_known_points_make_one_world_of_filter_and_batch():
    log = scene(frames=8, points=20, known=6, noise_px=1.0)
    isotropic = [replace(f, cov_z=np.tile(np.eye(2), (len(f.z), 1, 1))) for f in log.frames]
    done = filter_features(replace(log, frames=isotropic), MonoConfig(particles=200))
    found = compare_run(done)
    assert found.gauge == SAME and found.scale == 1.0
    assert found.poses.delta.shape[-1] == 6 and found.landmarks.delta.shape[-1] == 3
    assert len(found.poses) == 1
    assert found.poses.sigmas.max() < 5.0
    assert found.path.rmse < 0.1


def camera_problem():
    """A log without known points, and its optimum as if a filter had found it, in another scale."""
    log = replace(scene(frames=7, points=18, known=0, seed=3), known=None)
    return log, solve_problem(log, log.truth.poses).estimate


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
    assert (found.landmarks.delta.shape[-1], found.poses.delta.shape[-1]) == (2, 5)
    assert found.landmarks.sigmas.max() < 1e-2
    assert found.poses.sigmas[-1] < 1e-2
    assert found.landmarks.sigma_ratio == pytest.approx(np.ones(len(found.landmarks)), rel=1e-3)
    assert found.poses.sigma_ratio[-1] == pytest.approx(1.0, rel=1e-3)


def test_a_covariance_is_carried_to_the_chart_at_the_other_pose():
    _, estimate = camera_problem()
    there = SE3.retract(estimate.world_from_body[-1:], np.array([0.4, -0.3, 0.5, 0.2, 0.1, -0.3]))
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


STEPS = 200
AWAY = Similarity(2.5, SE3.rotation(SE3.exp(np.array([[0.4, -0.7, 1.1, 0, 0, 0]])))[0], np.array([3.0, -1.0, 7.0]))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gauge") / "run"
    log = simulated_log(RobotWorld(steps=30, landmarks=30, spatial=True), 0)
    write_run(filter_opened(open_robot_log(log, RangeBearingConfig(particles=60))), folder, {"recording": "here"})
    return folder


@pytest.fixture
def moved_run(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "run")


def drawn(rng, std):
    """T poses along a path, covariances that grow, and estimates of them that err as these say, but for the scale."""
    along = np.linspace(0.0, 3.0, STEPS)
    turn = np.column_stack([0.1 * np.sin(along), 0.3 * along, 0.2 * np.cos(2 * along)])
    truth = SE3.exp(np.column_stack([turn, np.zeros((STEPS, 3))]))
    truth[:, 4:] = np.column_stack([along, np.sin(2 * along), 0.3 * np.cos(along)])
    size = std * (0.05 + along / 3.0)
    cov = size[:, None, None] ** 2 * np.diag([0.2, 0.2, 0.2, 1.0, 1.0, 1.0]) ** 2
    mean = SE3.retract(truth, np.einsum("tab,tb->ta", np.sqrt(cov), rng.normal(size=(STEPS, 6))))
    return truth, mean, cov


@pytest.mark.parametrize("alignment", ["rigid", "similarity"])
@pytest.mark.parametrize(("claimed", "outcome"), [(1.0, "supports"), (1 / 3, "contradicts")])
def test_nees_is_told_of_a_run_in_a_world_and_scale_of_its_own(moved_run, alignment, claimed, outcome):
    """3 % of the poses of a run without known points lay in the 95 % region, and nothing was said of it."""
    rng = np.random.default_rng(3)
    truth, mean, cov = drawn(rng, 0.01)
    points = rng.uniform(-1.0, 3.0, size=(300, 3))
    noise = 0.02 * rng.normal(size=points.shape)
    there = AWAY if alignment == "similarity" else replace(AWAY, scale=1.0)
    moved = {name: there.transform(point) for name, point in enumerate(points)}
    write_truth(moved_run, RunTruth(np.arange(STEPS), there.transform_poses(truth), moved, alignment))
    write_trajectory(moved_run, np.arange(STEPS), mean, claimed**2 * cov)
    map_cov = np.tile((claimed * 0.02) ** 2 * np.eye(3), (len(points), 1, 1))
    write_map(moved_run, MapEstimate(np.arange(len(points)), points + noise, map_cov))
    record = load(moved_run)
    errors = truth_errors(record)
    found = {s.name: s for s in compare_with_truth(record, errors).statistics}
    for name in (NEES, IN_TRUTH):
        assert found[name].value == pytest.approx(claimed**-2, rel=0.25)
        assert found[name].outcome == outcome
    inside = found["poses inside the 95 % region"].value
    assert inside > 0.9 if claimed == 1.0 else inside < 0.3
    assert errors.landmarks.truth == pytest.approx(there.transform(points))
    assert np.abs(errors.landmarks.map.mean - errors.landmarks.truth).max() < 0.1 * there.scale


@pytest.mark.parametrize(
    ("std", "claimed", "outcome"), [(0.1, 1.0, "supports"), (0.1, 0.3, "contradicts"), (0.002, 0.3, "leaves open")]
)
@pytest.mark.parametrize("alignment", ["none", "rigid", "similarity"])
def test_a_truth_that_errs_tells_nothing_of_a_better_filter(moved_run, alignment, std, claimed, outcome):
    """Motion capture good to a centimetre made filters good to a millimetre look over-confident, or any claim right."""
    truth, mean, cov = drawn(rng := np.random.default_rng(5), std)
    there = {"none": Similarity(1.0, np.eye(3), np.zeros(3)), "rigid": replace(AWAY, scale=1.0)}.get(alignment, AWAY)
    seen, own = there.transform_poses(truth), Precision(0.01, 0.002)
    measured = SE3.retract(seen, rng.normal(size=(STEPS, 6)) * np.repeat([own.std_rad, own.std_m], 3))
    write_truth(moved_run, RunTruth(np.arange(STEPS), measured, {}, alignment))
    write_trajectory(moved_run, np.arange(STEPS), mean, claimed**2 * cov)
    record = load(moved_run)
    exact, known = (compare_with_truth(record, truth_errors(record, *stated)) for stated in ((), (own,)))
    assert exact.statistics[0].outcome == ("supports" if outcome == "supports" else "contradicts")
    assert [s.outcome for s in known.statistics] == [outcome]  # no regions, which are of both
    assert known.figures["truth_std_m"] == own.std_m and known.figures["truth_std_deg"] == np.degrees(own.std_rad)
    write_truth(moved_run, RunTruth(np.arange(STEPS), seen, {}, alignment))  # exact, and stated to be coarse
    for factor, told in ((1.0, ["leaves open"]), (0.0, [])):
        write_trajectory(moved_run, np.arange(STEPS), mean, factor * cov)
        errors = truth_errors(load(moved_run), Precision(5.0, 1.0))
        assert [s.outcome for s in compare_with_truth(load(moved_run), errors).statistics] == told


def in_another_world(moved_run):
    """The truth turned and moved away, as of a recording whose first frame has none."""
    record, away = load(moved_run), replace(AWAY, scale=1.0)
    truth = record.truth
    landmarks = {name: away.transform(point) for name, point in truth.landmarks.items()}
    write_truth(moved_run, RunTruth(truth.rows, away.transform_poses(truth.poses), landmarks, "rigid"))


def test_the_batch_is_moved_as_the_filter_is(moved_run):
    """The truth was moved onto the filter and the batch was not, so that the wrong one looked right."""
    record, truth = load(moved_run), load(moved_run).truth
    off = replace(AWAY, scale=1.0)
    batch = record.trajectory.take(truth.rows)
    batch = replace(batch, world_from_body=off.transform_poses(truth.poses))
    write_tum(moved_run / "batch.tum", batch)
    in_another_world(moved_run)
    figure = plots.plot_trajectory(load(moved_run))
    lines = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    assert lines["batch optimum"] == pytest.approx(lines["truth"], abs=1e-6)
    assert np.abs(lines["filter"][truth.rows] - lines["truth"]).max() < 1.0
    assert "truth's world" in figure.get_suptitle()
    assert len(read_tum(moved_run / "batch.tum")) == truth.rows.size
    for part in (batch, batch.take(np.arange(3))):  # of which the few fit anywhere
        write_tum(moved_run / "batch.tum", part)
        figures = compare_with_truth(load(moved_run), truth_errors(load(moved_run))).figures
        assert ("batch_position_rmse_m" in figures) == (part is batch)
