"""A run that does not live in the truth's world: its NEES, its figures and its pictures are those of one world."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.runs import plots
from rbpf.runs.folder import write_map, write_run, write_trajectory
from rbpf.runs.recordings import filter_opened, open_robot_log
from rbpf.runs.results import load
from rbpf.runs.trajectory import Similarity, read_tum, write_tum
from rbpf.runs.truth import RunTruth, write_truth
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.against_groundtruth import LANDMARKS, NEES, compare_with_truth, truth_errors
from rbpf.validation.simulation.robot import RobotWorld, simulated_log

STEPS = 200
AWAY = Similarity(2.5, SE3.rotation(SE3.exp(np.array([[0.4, -0.7, 1.1, 0, 0, 0]])))[0], np.array([3.0, -1.0, 7.0]))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gauge") / "run"
    log = simulated_log(RobotWorld(steps=30, landmarks=30, spatial=True), 0)
    write_run(filter_opened(open_robot_log(log, RangeBearingConfig(particles=60))), folder, {"recording": "here"})
    return folder


@pytest.fixture
def folder(finished, tmp_path):
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
def test_nees_is_told_of_a_run_in_a_world_and_scale_of_its_own(folder, alignment, claimed, outcome):
    """3 % of the poses of a run without known points lay in the 95 % region, and nothing was said of it."""
    rng = np.random.default_rng(3)
    truth, mean, cov = drawn(rng, 0.01)
    points = rng.uniform(-1.0, 3.0, size=(300, 3))
    noise = 0.02 * rng.normal(size=points.shape)
    there = AWAY if alignment == "similarity" else replace(AWAY, scale=1.0)
    moved = {name: there.transform(point) for name, point in enumerate(points)}
    write_truth(folder, RunTruth(np.arange(STEPS), there.transform_poses(truth), moved, alignment))
    write_trajectory(folder, np.arange(STEPS), mean, claimed**2 * cov)
    map_cov = np.tile((claimed * 0.02) ** 2 * np.eye(3), (len(points), 1, 1))
    write_map(folder, MapEstimate(np.arange(len(points)), points + noise, map_cov))
    record = load(folder)
    errors = truth_errors(record)
    found = {s.name: s for s in compare_with_truth(record, errors).statistics}
    for name in (NEES, LANDMARKS):
        assert found[name].value == pytest.approx(claimed**-2, rel=0.25)
        assert found[name].outcome == outcome
    inside = found["poses inside the 95 % region"].value
    assert inside > 0.9 if claimed == 1.0 else inside < 0.3
    assert errors.landmarks.truth == pytest.approx(there.transform(points))
    assert np.abs(errors.landmarks.map.mean - errors.landmarks.truth).max() < 0.1 * there.scale


def in_another_world(folder):
    """The truth turned and moved away, as of a recording whose first frame has none."""
    record, away = load(folder), replace(AWAY, scale=1.0)
    truth = record.truth
    landmarks = {name: away.transform(point) for name, point in truth.landmarks.items()}
    write_truth(folder, RunTruth(truth.rows, away.transform_poses(truth.poses), landmarks, "rigid"))


def test_the_batch_is_moved_as_the_filter_is(folder):
    """The truth was moved onto the filter and the batch was not, so that the wrong one looked right."""
    record, truth = load(folder), load(folder).truth
    off = replace(AWAY, scale=1.0)
    batch = record.trajectory.at(truth.rows)
    batch = replace(batch, world_from_body=off.transform_poses(truth.poses))
    write_tum(folder / "batch.tum", batch)
    in_another_world(folder)
    figure = plots.path_figure(load(folder))
    lines = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    assert lines["batch optimum"] == pytest.approx(lines["truth"], abs=1e-6)
    assert np.abs(lines["filter"][truth.rows] - lines["truth"]).max() < 1.0
    assert "truth's world" in figure.get_suptitle()
    assert len(read_tum(folder / "batch.tum")) == truth.rows.size
