"""The table of filter and batch errors: its arithmetic, and the logs whose reference errors are published."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.path_and_map import PathAndMap
from rbpf.runs.trajectory import Trajectory
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.error_ratios import HEADER, ErrorRatio, error_of, robot_ratio, tracks_ratio
from rbpf.validation.simulation.features import STEREO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


def estimate(poses):
    nothing = MapEstimate(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    return PathAndMap(np.arange(len(poses)), poses, np.empty((0, 6, 6)), nothing)


def walk(count=20):
    rng = np.random.default_rng(4)
    return SE3.exp(np.cumsum(rng.normal(scale=0.2, size=(count, 6)), axis=0))


def test_the_error_is_that_after_the_alignment():
    truth = walk()
    moved = SE3.compose(SE3.exp(np.array([0.1, 0.5, 0.2, 3.0, 2.0, 1.0])), truth)
    reference = Trajectory(np.arange(20), truth)
    assert error_of(estimate(moved), reference, "rigid") < 1e-12
    assert error_of(estimate(moved), reference, "none") > 1.0
    larger = np.concatenate([truth[:, :4], 2.0 * truth[:, 4:]], axis=1)
    assert error_of(estimate(larger), reference, "similarity") < 1e-12
    assert error_of(estimate(larger), reference, "rigid") > 0.05


def test_instants_without_truth_are_passed_over_and_none_is_refused():
    truth = walk()
    some = Trajectory(np.arange(0, 20, 4), truth[::4])
    assert error_of(estimate(truth), some, "rigid") < 1e-12
    with pytest.raises(InputError, match="share 2 time stamps"):
        error_of(estimate(truth), Trajectory(np.arange(2), truth[:2]), "rigid")
    with pytest.raises(InputError, match="same clock"):
        error_of(estimate(truth), Trajectory(np.arange(20) + 100, truth), "rigid")


def test_the_ratio_is_the_median_of_the_seeds_ratios():
    found = ErrorRatio("here", 50, (0.2, 0.3, 0.9), (0.1, 0.1, 0.3), "rigid")
    assert found.ratio == pytest.approx(3.0)
    assert found.row() == pytest.approx(("here", 50, 3, 0.3, 0.2, 0.9, 0.1, 3.0))
    assert len(found.row()) == len(HEADER)
    assert found.as_dict()["ratio"] == found.ratio


def test_a_log_is_filtered_and_solved(tmp_path):
    simulate_robot(RobotWorld(steps=25, landmarks=20), tmp_path / "log", seed=1)
    found = robot_ratio(tmp_path / "log", RangeBearingConfig(particles=30), (0, 1))
    assert len(found.filter_errors_m) == 2
    assert found.batch_errors_m[0] == found.batch_errors_m[1]
    assert 0.8 < found.ratio < 10.0


def test_tracks_without_truth_are_judged_by_the_optimums_own_covariance():
    """√(b² + d²): never below 1, and near it for a filter of many landmarks."""
    log = simulate_features(DeskWorld(frames=12), Measuring(), STEREO, 0)
    found = tracks_ratio(replace(log, truth=None, known=None), StereoConfig(particles=50), (0, 1))
    assert found.batch_errors_m[0] == found.batch_errors_m[1] > 0.0
    assert 1.0 < found.ratio < 10.0
    off = np.sqrt(np.square(found.filter_errors_m) - np.square(found.batch_errors_m))
    assert (off > 0.0).all() and off[0] != off[1]


def test_a_log_without_truth_is_refused(tmp_path):
    simulate_robot(RobotWorld(steps=10, landmarks=10), tmp_path / "log", seed=1)
    for path in (tmp_path / "log").glob("*groundtruth*"):
        path.unlink()
    with pytest.raises(InputError, match="no ground truth"):
        robot_ratio(tmp_path / "log", RangeBearingConfig(particles=5))


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.parametrize(("name", "batch"), [("mrpt_kf_slam_2d", 0.0040), ("mrpt_kf_slam_6d", 0.0102)])
def test_the_filter_is_near_the_optimum_on_published_logs(data_dir, name, batch):
    found = robot_ratio(data_dir / name, replace(RangeBearingConfig(), particles=100), (0, 1, 2))
    assert found.batch_errors_m[0] < batch, "after a rigid alignment no more than the reference's without"
    assert 1.0 <= found.ratio < 1.6
