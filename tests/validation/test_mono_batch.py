"""The batch adjustment beside a run over images: which frames take part, what it finds, when it gives up; its camera."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.validation.gtsam.batch_problem import Optimum, connected_frames, solve_problem
from rbpf.validation.gtsam.camera import solve_features
from rbpf.validation.gtsam.observations import HUBER
from rbpf.validation.gtsam.self_calibration import refine_calibration
from rbpf.validation.gtsam.stated import DOUBTFUL, measured_calibration
from tests.exactness.models import known

pytestmark = pytest.mark.slow

FRAMES = 30


@pytest.fixture(scope="module")
def log() -> FeatureLog:
    return simulate_features(DeskWorld(frames=FRAMES), Measuring(), MONO, 3)


def rough(log: FeatureLog) -> np.ndarray:
    """Poses somewhere near the truth."""
    rng = np.random.default_rng(0)
    return SE3.retract(known(log.truth).poses, 0.01 * rng.standard_normal((len(log.frames), 6)))


def adjusted(log: FeatureLog, path: np.ndarray, **options: Any) -> Optimum:
    return solve_problem(log, path, HUBER, marginals=False, **options)


def kept(frame: FeatureFrame, rows: np.ndarray) -> FeatureFrame:
    return FeatureFrame(frame.stamp_ns, frame.landmarks[rows], frame.z[rows], frame.cov_z[rows])


def changed(log: FeatureLog, frames: dict[int, FeatureFrame]) -> FeatureLog:
    return replace(log, frames=[frames.get(t, frame) for t, frame in enumerate(log.frames)])


def renamed(frame: FeatureFrame, offset: int) -> FeatureFrame:
    return replace(frame, landmarks=frame.landmarks + offset)


def test_a_whole_log_is_the_plain_solution(log):
    batch = adjusted(log, rough(log))
    np.testing.assert_array_equal(batch.steps, np.arange(FRAMES))
    plain = solve_features(log, InitialEstimate(known(log.truth).poses, {}), robust=HUBER, marginals=False)
    assert np.abs(SE3.local(plain.world_from_body, batch.estimate.world_from_body)).max() < 1e-4
    error = batch.estimate.trajectory.positions - SE3.translation(known(log.truth).poses)
    assert np.sqrt(np.square(error).sum(axis=1).mean()) < 0.02


def test_it_does_not_hang_on_where_the_filter_went(log):
    """A path that turns away after a while: from there alone another optimum is found."""
    path = rough(log)
    path[8:, 4:] += np.linspace(0.0, 0.6, FRAMES - 8)[:, None] * [1.0, -0.5, 0.8]
    assert adjusted(log, path).error == pytest.approx(adjusted(log, rough(log)).error, rel=1e-4)


def test_blind_frames_and_those_that_share_nothing_with_the_known_points_or_the_first_frame_are_left_out(log):
    blind = {4: kept(log.frames[4], np.arange(0)), 9: kept(log.frames[9], np.arange(3))}
    batch = adjusted(changed(log, blind), rough(log))
    assert set(range(FRAMES)) - set(batch.steps.tolist()) == {4, 9}
    assert batch.estimate.trajectory.stamps_ns.tolist() == [log.frames[t].stamp_ns for t in batch.steps]
    away = changed(log, {t: renamed(log.frames[t], 10_000) for t in range(20, FRAMES)})
    for one in (away, replace(away, known=None)):
        assert connected_frames(one).tolist() == list(range(20))


def test_it_tells_how_far_it_is_and_gives_up_after_so_much_work(log):
    told = []
    adjusted(log, rough(log), on_iteration=lambda count, error: told.append((count, error)))
    counts, errors = zip(*told, strict=True)
    assert counts == tuple(range(1, len(told) + 1)) and errors[0] > 2.0 * errors[-1]
    with pytest.raises(InputError, match="given up after 3 iterations: allow more with --batch-limit"):
        adjusted(log, rough(log), most=3)


def test_a_wrong_focal_length_and_distortion_are_mended():
    log = simulate_features(DeskWorld(frames=30), Measuring(noise_px=0.3), MONO, 5)
    camera, rounds = log.camera, []
    wrong = replace(camera, fx=0.96 * camera.fx, fy=0.96 * camera.fy, distortion=(-0.02, 0.0, 0.0, 0.0, 0.0))
    spoilt = replace(log, camera=wrong)
    start = solve_problem(spoilt, known(log.truth).poses, HUBER, marginals=False)
    right = solve_problem(log, known(log.truth).poses, HUBER, marginals=False)
    assert max(one.apart for one in measured_calibration(right)) < DOUBTFUL
    focal, k1 = measured_calibration(start)
    assert focal.apart > DOUBTFUL and focal._replace(stated=camera.fx).apart < 4.0
    assert k1._replace(stated=0.0).apart < 4.0
    refined = refine_calibration(spoilt, start, lambda done, most: rounds.append(done))
    assert refined.batch.error < start.error
    off = np.array([refined.camera.fx / camera.fx - 1.0, refined.camera.distortion[0]])
    assert (np.abs(off) < [0.012, 0.007]).all()
    assert (np.abs(off) < 4.0 * refined.std).all() and (refined.std < 0.02).all()
    assert rounds == list(range(1, len(rounds) + 1))
