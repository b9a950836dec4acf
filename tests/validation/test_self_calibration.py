"""A camera calibrated by what a run measured, where the true one is known."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.validation.gtsam.batch_problem import solve_problem
from rbpf.validation.gtsam.observations import HUBER
from rbpf.validation.gtsam.self_calibration import refine_calibration
from tests.exactness.models import known

pytestmark = pytest.mark.slow


def test_a_wrong_focal_length_and_distortion_are_mended():
    log = simulate_features(DeskWorld(frames=30), Measuring(noise_px=0.3), MONO, 5)
    camera, rounds = log.camera, []
    wrong = replace(camera, fx=0.96 * camera.fx, fy=0.96 * camera.fy, distortion=(-0.02, 0.0, 0.0, 0.0, 0.0))
    spoilt = replace(log, camera=wrong)
    start = solve_problem(spoilt, known(log.truth).world_from_camera, HUBER, marginals=False)
    refined = refine_calibration(spoilt, start, lambda done, most: rounds.append(done))
    assert refined.batch.error < start.error
    off = np.array([refined.camera.fx / camera.fx - 1.0, refined.camera.distortion[0]])
    assert (np.abs(off) < [0.012, 0.007]).all()
    assert (np.abs(off) < 4.0 * refined.std).all() and (refined.std < 0.02).all()
    assert rounds == list(range(1, len(rounds) + 1))
