"""Causes of a filter's distance from the optimum: what is changed is changed, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.runs.folder import write_trajectory
from rbpf.runs.measurement_files import write_measurements
from rbpf.runs.truth import RunTruth, write_truth
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.run import run as filter_log
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.error_causes import (
    AS_IT_IS,
    BATCH,
    FROM_FILTER,
    ONLINE,
    camera_causes,
    robot_causes,
    scaled_noise,
)
from rbpf.validation.error_ratios import robot_ratio
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


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


def test_a_log_without_truth_is_refused(tmp_path):
    simulate_robot(RobotWorld(steps=8, landmarks=10), tmp_path / "log", seed=1)
    for path in (tmp_path / "log").glob("*groundtruth*"):
        path.unlink()
    with pytest.raises(InputError, match="no ground truth"):
        robot_causes(tmp_path / "log", RangeBearingConfig(particles=5), (0,))


@pytest.fixture
def folder(tmp_path):
    """What a monocular run leaves, as far as it is read here, of a simulated log."""
    log = simulate_features(DeskWorld(frames=25), Measuring(), MONO, 3)
    config = MonoConfig(particles=8)
    run = filter_log(log, config)
    write_measurements(tmp_path, log)
    write_trajectory(tmp_path, run.stamps_ns, run.world_from_camera, run.cov)
    write_truth(tmp_path, RunTruth(np.arange(25), log.truth.world_from_camera))
    (tmp_path / "config.yaml").write_text("rbpf: 0\nsystem: mono\nparticles: 8\n")
    (tmp_path / "summary.json").write_text("{}")
    return tmp_path


@pytest.mark.slow
def test_a_cameras_causes(folder):
    """The measurements are those of the run: filtered again by the same seed they give the same path."""
    rows = {cause.name: cause for cause in camera_causes(folder, (0,))}
    assert rows["same measurements"].errors_m == pytest.approx(rows[AS_IT_IS].errors_m, rel=1e-6)
    assert rows["perfect associations"].errors_m == pytest.approx(rows[AS_IT_IS].errors_m, rel=0.5)
    assert rows[BATCH].row()[4] == 1.0
    assert rows[FROM_FILTER].errors_m[0] == pytest.approx(rows[BATCH].errors_m[0], rel=0.2)
    assert rows["10× particles"].errors_m != rows[AS_IT_IS].errors_m


def test_a_run_without_truth_is_refused(folder):
    (folder / "truth.npz").unlink()
    with pytest.raises(InputError, match="no ground truth"):
        camera_causes(folder, (0,))


def test_the_noise_is_scaled_and_nothing_else():
    log = simulate_features(DeskWorld(frames=3), Measuring(), MONO, 0)
    half = scaled_noise(log, 0.5)
    for one, other in zip(half.frames, log.frames, strict=True):
        np.testing.assert_allclose(one.cov_z, 0.25 * other.cov_z)
        np.testing.assert_array_equal(one.z, other.z)
    assert replace(half, frames=log.frames) == log
