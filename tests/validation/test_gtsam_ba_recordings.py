"""The batch solution of recordings: errors against the truth beside those of reference programs."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.stereo_tracks import read_stereo_tracks
from rbpf import gaussian
from rbpf.lie import SE3, Array
from rbpf.motion.stereo_vo import MotionPrior
from rbpf.runs.trajectory import align
from rbpf.sensors.readers import RobotLog, open_log
from rbpf.sensors.readers.measurements import KINDS, InitialEstimate, Measurements, initial_estimate
from rbpf.systems.stereo.config import MapConfig, OdometryConfig, StereoConfig
from rbpf.systems.stereo.named_pixels import NamedFrontEnd
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.validation.gtsam.camera import CameraProblem, CameraState, solve_features
from rbpf.validation.gtsam.observations import observation_table
from rbpf.validation.gtsam.path_sampling import draw_posterior
from rbpf.validation.gtsam.robot import RobotProblem, solve
from rbpf.validation.metrics.accuracy import landmark_errors

pytestmark = [pytest.mark.real_data, pytest.mark.slow]


def planar_errors(m, log, path, landmarks):
    """Root mean square of the path after rigid alignment, and mean of the landmarks after their own."""
    truth = log.truth
    true_x, true_y = truth.poses[:, 1:].T
    true = np.stack([np.interp(m.stamps_ns, truth.stamps_ns, x) for x in (true_x, true_y)], axis=1)
    off = align(path[:, 1:], true).transform(path[:, 1:]) - true
    return np.sqrt(np.square(off).sum(1).mean()), landmark_errors(landmarks, truth.landmarks, "rigid").mean


def exact_errors(m, log, path, landmarks):
    """Root mean square of the path and mean of the landmarks, without alignment."""
    off = m.space.translation(path) - m.space.translation(log.truth.poses)
    return np.sqrt(np.square(off).sum(1).mean()), landmark_errors(landmarks, log.truth.landmarks).mean


@pytest.mark.parametrize(
    ("folder", "batch"), [("mrpt_kf_slam_2d", (0.0040, 0.0026)), ("mrpt_kf_slam_6d", (0.0102, 0.0042))]
)
def test_simulated_recordings_give_the_errors_of_the_reference(data_dir, folder, batch):
    log = open_log(data_dir / folder)
    m = from_log(log, start=log.truth.poses[0])
    found = solve(m)
    assert exact_errors(m, log, found.world_from_body, found.landmarks) == pytest.approx(batch, abs=6e-5)
    expected = 0.5 * m.z.shape[1] * (len(m.z) - len(found.landmarks))
    assert found.error == pytest.approx(expected, abs=4 * np.sqrt(expected))
    misses = [found.landmarks[name] - log.truth.landmarks[name] for name in found.landmarks]
    nees = [
        miss @ np.linalg.solve(found.cov_landmarks[name], miss)
        for name, miss in zip(found.landmarks, misses, strict=True)
    ]
    assert 0.3 < np.mean(nees) / len(misses[0]) < 2.0


def test_mrclam_is_solved_better_than_by_a_reference_that_takes_depths_for_ranges(data_dir):
    log = open_log(data_dir / "mrclam6_robot1")
    m = from_log(log)
    assert RobotProblem(m).null.any()
    plain, robust = (solve(m, threshold, marginals=False, incremental=True) for threshold in (None, 1.345))
    for found, reference in ((plain, (0.144, 0.089)), (robust, (0.118, 0.076))):
        errors = planar_errors(m, log, found.world_from_body, found.landmarks)
        assert np.less(errors, np.multiply((0.85, 1.0), reference)).all(), errors


def test_victoria_park_needs_the_incremental_start(data_dir):
    log = open_log(data_dir / "victoria_park")
    m = from_log(replace(log, frames=log.frames[:2500]))
    found = solve(m, incremental=True)
    redundancy = m.z.size - 2 * len(found.landmarks)
    assert 0.3 * redundancy < found.error < 0.7 * redundancy
    problem = RobotProblem(m)
    lost = problem.graph().error(problem.values(initial_estimate(m)))
    assert lost > 1000 * found.error


@pytest.fixture(scope="module")
def tracks(data_dir):
    return read_stereo_tracks(data_dir / "gtsam_stereo_vo")


@pytest.fixture(scope="module")
def solved(tracks):
    start = InitialEstimate(tracks.world_from_camera, first_observations(tracks))
    return solve_features(tracks.log, start, marginals=False, tolerance=1e-3)


def first_observations(tracks):
    """Where each landmark was when it was first seen, on the guessed path."""
    points = {}
    for frame, pose in zip(tracks.log.frames, tracks.world_from_camera, strict=True):
        places = SE3.transform(pose, tracks.log.camera.triangulate(frame.z))
        for name, place in zip(frame.landmarks.tolist(), places, strict=True):
            points.setdefault(name, place)
    return points


def test_the_reference_figures_and_the_batch_solution(tracks, solved):
    """Half the squared error 90342.1 → 7399.0, which is 0.306 px per residual.
    `solve_features` adds weak priors for what has no parallax, 342 landmarks here; they change the error by
    0.11 %."""
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
    assert solved.error == pytest.approx(7399.0, rel=2e-3)


def test_visual_odometry_alone(tracks, solved):
    """Over 69 m, beside the batch solution of all measurements; the guess in the file is 0.09 m off."""
    log = tracks.log
    frames = [replace(frame, stamp_ns=100_000_000 * frame.stamp_ns) for frame in log.frames]
    odometry = OdometryConfig(prior=MotionPrior(std_speed=10.0))
    config = replace(StereoConfig.s05(), particles=1, odometry=odometry, map=MapConfig(kind="particles", used=False))
    slam = StereoSlam(log.camera, config, front_end=NamedFrontEnd(log.camera, config))
    said = [slam.take(frame) for frame in frames]
    path = np.array([one.values["odometry"] for one in said])
    batch = SE3.between(solved.world_from_body[0], solved.world_from_body)
    off = np.linalg.norm(path[:, 4:] - batch[:, 4:], axis=1)
    assert not any(one.messages for one in said)
    assert np.sqrt(np.square(off).mean()) < 0.1
    assert off[-1] < 0.2


@pytest.mark.parametrize(("folder", "error"), [("mrpt_kf_slam_2d", 0.01), ("mrclam6_robot1", 0.15)])
def test_the_evidence_of_a_recording_does_not_hang_on_the_seed(data_dir, folder, error):
    m = from_log(open_log(data_dir / folder))
    batch = solve(m, marginals=False, incremental=True)
    start = InitialEstimate(batch.world_from_body, batch.landmarks)
    one, other = (draw_posterior(m, start, np.random.default_rng(seed), 200) for seed in (0, 1))
    assert max(one.error, other.error) < error
    assert abs(one.log_evidence - other.log_evidence) < 4.0 * error


def from_log(log: RobotLog, start: Array | None = None) -> Measurements:
    """All measurements of a log; landmarks keep the log's names. It starts at the origin, if nothing else is given."""
    space, point = log.space, log.space.point_dim

    def stacked(field: str, shape: tuple[int, ...]) -> Array:
        return np.concatenate([np.reshape(getattr(frame, field), (-1, *shape)) for frame in log.frames])

    moves = log.frames[1:]
    return Measurements(
        recording=log.name,
        space=space,
        measurement=KINDS[log.measurement],
        pitch_sign=log.pitch_sign,
        robot_from_sensor=log.robot_from_sensor,
        start=space.identity() if start is None else start,
        stamps_ns=np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64),
        deltas=np.array([frame.delta for frame in moves]).reshape(-1, space.size),
        covs=gaussian.symmetrise(np.array([frame.cov_delta for frame in moves]).reshape(-1, space.dim, space.dim)),
        steps=np.repeat(np.arange(len(log.frames)), [len(frame.z) for frame in log.frames]),
        landmarks=stacked("landmarks", ()).astype(np.int64),
        z=stacked("z", (point,)),
        cov_z=gaussian.symmetrise(stacked("cov_z", (point, point))),
    )
