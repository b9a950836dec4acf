"""Causes of a filter's distance from the optimum: what is changed is changed, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.error_causes import AS_IT_IS, BATCH, FROM_FILTER, ONLINE, camera_causes, robot_causes
from examples.studies.error_ratios import error_of, robot_ratio, tracks_ratio
from examples.studies.point_worlds import MONO, STEREO, DeskWorld, Measuring, simulate_features
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.folder import write_trajectory
from rbpf.runs.measurement_files import write_measurements
from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import filter_features
from rbpf.runs.trajectory import Trajectory
from rbpf.runs.truth import RunTruth, write_truth
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

pytestmark = pytest.mark.slow


def test_a_robots_causes_agree_with_the_table_of_ratios(tmp_path):
    simulate_robot(RobotWorld(steps=25, landmarks=20), tmp_path / "log", seed=1)
    config = RangeBearingConfig(particles=20)
    rows = {cause.name: cause for cause in robot_causes(tmp_path / "log", config, (0, 1))}
    ratio = robot_ratio(tmp_path / "log", config, (0, 1))
    assert rows[AS_IT_IS].errors_m == pytest.approx(ratio.filter_errors_m)
    assert rows[BATCH].errors_m[0] == pytest.approx(ratio.batch_errors_m[0])
    assert rows[FROM_FILTER].errors_m[0] == pytest.approx(rows[BATCH].errors_m[0], rel=1e-3)
    assert rows[BATCH].errors_m[0] < rows[ONLINE].errors_m[0] < 2.0 * rows[AS_IT_IS].errors_m[0]
    many = rows["10× particles"]
    assert many.errors_m != rows[AS_IT_IS].errors_m
    assert many.row()[4] == pytest.approx(np.median(many.errors_m) / many.batch_m)
    assert {"one linearisation", "linearised weights, no exact ratio"} <= rows.keys()


@pytest.fixture
def folder(tmp_path):
    """What a monocular run leaves, as far as it is read here, of a simulated log."""
    log = simulate_features(DeskWorld(frames=25), Measuring(), MONO, 3)
    config = MonoConfig(particles=8)
    run = filter_features(log, config)
    write_measurements(tmp_path, log)
    write_trajectory(tmp_path, run.log.stamps_ns, run.log.poses, run.log.covs)
    write_truth(tmp_path, RunTruth(np.arange(25), log.truth.world_from_camera))
    (tmp_path / "config.yaml").write_text("rbpf: 0\nsystem: mono\nparticles: 8\n")
    (tmp_path / "summary.json").write_text("{}")
    return tmp_path


def test_a_cameras_causes(folder):
    """The measurements are those of the run: filtered again by the same seed they give the same path."""
    rows = {cause.name: cause for cause in camera_causes(folder, (0,))}
    assert rows["same measurements"].errors_m == pytest.approx(rows[AS_IT_IS].errors_m, rel=1e-6)
    assert rows["perfect associations"].errors_m == pytest.approx(rows[AS_IT_IS].errors_m, rel=0.5)
    assert rows[BATCH].row()[4] == 1.0
    assert rows[FROM_FILTER].errors_m[0] == pytest.approx(rows[BATCH].errors_m[0], rel=0.2)
    assert rows["10× particles"].errors_m != rows[AS_IT_IS].errors_m


def estimate(poses):
    nothing = MapEstimate(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    return PathAndMap(np.arange(len(poses)), poses, np.empty((0, 6, 6)), nothing)


def walk(count=20):
    rng = np.random.default_rng(4)
    return SE3.exp(np.cumsum(rng.normal(scale=0.2, size=(count, 6)), axis=0))


def test_instants_without_truth_are_passed_over_and_none_is_refused():
    truth = walk()
    some = Trajectory(np.arange(0, 20, 4), truth[::4])
    assert error_of(estimate(truth), some, "rigid") < 1e-12
    with pytest.raises(InputError, match="share 2 time stamps"):
        error_of(estimate(truth), Trajectory(np.arange(2), truth[:2]), "rigid")
    with pytest.raises(InputError, match="same clock"):
        error_of(estimate(truth), Trajectory(np.arange(20) + 100, truth), "rigid")


def test_tracks_without_truth_are_judged_by_the_optimums_own_covariance():
    """√(b² + d²): never below 1, and near it for a filter of many landmarks."""
    log = simulate_features(DeskWorld(frames=12), Measuring(), STEREO, 0)
    found = tracks_ratio(replace(log, truth=None, known=None), StereoConfig(particles=50), (0, 1))
    assert found.batch_errors_m[0] == found.batch_errors_m[1] > 0.0
    assert 1.0 < found.ratio < 10.0
    off = np.sqrt(np.square(found.filter_errors_m) - np.square(found.batch_errors_m))
    assert (off > 0.0).all() and off[0] != off[1]


@pytest.mark.real_data
@pytest.mark.parametrize(("name", "batch"), [("mrpt_kf_slam_2d", 0.0040), ("mrpt_kf_slam_6d", 0.0102)])
def test_the_filter_is_near_the_optimum_on_published_logs(data_dir, name, batch):
    found = robot_ratio(data_dir / name, RangeBearingConfig(particles=100))
    assert found.batch_errors_m[0] < batch, "after a rigid alignment no more than the reference's without"
    assert 1.0 <= found.ratio < 1.6
