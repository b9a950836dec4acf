"""The batch solution of recordings: errors against the truth beside those of reference programs."""

import numpy as np
import pytest

from examples.studies.joint_ekf import joint_ekf
from rbpf.runs.trajectory import align
from rbpf.sensors.readers import open_log
from rbpf.sensors.readers.measurements import initial_estimate
from rbpf.validation.gtsam.robot import Problem, solve
from rbpf.validation.metrics.accuracy import landmark_errors
from tests.validation.log_measurements import from_log


def planar_errors(m, log, path, landmarks):
    """Root mean square of the path after rigid alignment, and mean of the landmarks after their own."""
    truth = log.truth
    true_x, true_y = truth.world_from_robot[:, 1:].T
    true = np.stack([np.interp(m.stamps_ns, truth.stamps_ns, x) for x in (true_x, true_y)], axis=1)
    off = align(path[:, 1:], true).transform(path[:, 1:]) - true
    return np.sqrt(np.square(off).sum(1).mean()), landmark_errors(landmarks, truth.landmarks, "rigid").mean


def exact_errors(m, log, path, landmarks):
    """Root mean square of the path and mean of the landmarks, without alignment."""
    off = m.space.translation(path) - m.space.translation(log.truth.world_from_robot)
    return np.sqrt(np.square(off).sum(1).mean()), landmark_errors(landmarks, log.truth.landmarks).mean


@pytest.mark.real_data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "batch", "filtered"),
    [("mrpt_kf_slam_2d", (0.0040, 0.0026), (0.0049, 0.0030)), ("mrpt_kf_slam_6d", (0.0102, 0.0042), (0.0123, 0.0043))],
)
def test_simulated_recordings_give_the_errors_of_the_reference(data_dir, folder, batch, filtered):
    log = open_log(data_dir / folder)
    m = from_log(log, start=log.truth.world_from_robot[0])
    found = solve(m)
    assert exact_errors(m, log, found.world_from_robot, found.landmarks) == pytest.approx(batch, abs=6e-5)
    expected = 0.5 * m.z.shape[1] * (len(m.z) - len(found.landmarks))
    assert found.error == pytest.approx(expected, abs=4 * np.sqrt(expected))
    ekf = joint_ekf(m)
    assert exact_errors(m, log, ekf.world_from_robot, ekf.landmarks) == pytest.approx(filtered, abs=6e-5)
    misses = [found.landmarks[name] - log.truth.landmarks[name] for name in found.landmarks]
    nees = [
        miss @ np.linalg.solve(found.cov_landmarks[name], miss)
        for name, miss in zip(found.landmarks, misses, strict=True)
    ]
    assert 0.3 < np.mean(nees) / len(misses[0]) < 2.0


@pytest.mark.real_data
@pytest.mark.slow
def test_mrclam_is_solved_as_well_as_by_the_reference(data_dir):
    log = open_log(data_dir / "mrclam6_robot1")
    m = from_log(log)
    assert Problem(m).singular
    plain, robust = (solve(m, threshold, marginals=False, incremental=True) for threshold in (None, 1.345))
    for found, reference in ((plain, (0.144, 0.089)), (robust, (0.118, 0.076))):
        errors = planar_errors(m, log, found.world_from_robot, found.landmarks)
        assert np.less(errors, np.multiply(1.1, reference)).all(), errors


@pytest.mark.real_data
@pytest.mark.slow
def test_victoria_park_needs_the_incremental_start(data_dir):
    m = from_log(open_log(data_dir / "victoria_park"))
    found = solve(m, incremental=True)
    redundancy = m.z.size - 2 * len(found.landmarks)
    assert 0.3 * redundancy < found.error < 0.7 * redundancy
    problem = Problem(m)
    lost = problem.graph().error(problem.values(initial_estimate(m)))
    assert lost > 1000 * found.error
