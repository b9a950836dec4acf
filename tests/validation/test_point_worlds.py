"""Simulated worlds of points: cameras in a hand, and what is measured: noise, visibility, outliers."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, STEREO, DeskWorld, LabWorld, Measuring, PointWorld, simulate_features
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.simulation.lab import LabDrive


def truth(log: FeatureLog, frame: int) -> np.ndarray:
    """True places (K, 3), in the camera's frame, of what a frame measures."""
    assert log.truth is not None
    world = [log.truth.landmarks[name] for name in log.frames[frame].landmarks.tolist()]
    return SE3.inverse_transform(log.truth.world_from_camera[frame], np.array(world).reshape(-1, 3))


def errors(log: FeatureLog) -> np.ndarray:
    """(n, p) measured minus projected pixels."""
    return np.concatenate([f.z - log.camera.project(truth(log, t)) for t, f in enumerate(log.frames)])


CAMERAS = [MONO, STEREO]
FISHEYE = replace(MONO, fx=262.0, fy=262.0, distortion=(-0.03, 0.02, -0.012, 0.002), distortion_model="equidistant")
BENT = replace(MONO, distortion=(-0.28, 0.07, 2e-4, 2e-5, 0.0))
DESK = DeskWorld(frames=200)
CHANGING = LabWorld(LabDrive(frames=60, every=10), points=3000)


@pytest.mark.parametrize("camera", CAMERAS)
def test_measurements_are_projections_with_the_stated_noise(camera: Pinhole | RectifiedStereo) -> None:
    log = simulate_features(DESK, Measuring(noise_px=0.7), camera, seed=0)
    score = errors(log) / 0.7
    n = score.size
    assert n > 5000
    assert abs((score**2).sum() - n) < 4.0 * np.sqrt(2.0 * n)
    assert (np.abs(score.sum(axis=0)) < 4.0 * np.sqrt(len(score))).all()
    assert abs((score[:, 0] * score[:, 1]).sum()) < 4.0 * np.sqrt(len(score))
    for frame in log.frames:
        np.testing.assert_allclose(frame.cov_z, np.tile(0.49 * np.eye(camera.dim), (len(frame.z), 1, 1)))


@pytest.mark.parametrize(("world", "camera"), [(DESK, MONO), (CHANGING, STEREO), (CHANGING, BENT), (DESK, FISHEYE)])
def test_only_what_is_visible_is_measured(world: PointWorld, camera: Pinhole | RectifiedStereo) -> None:
    measuring = Measuring(nearest_m=0.7, farthest_m=5.0)
    log = simulate_features(world, measuring, camera, seed=1)
    assert len(log.outside()) == 0
    for t in range(len(log.frames)):
        points = truth(log, t)
        assert camera.visible(points, margin_px=8.0).all()
        distance = np.linalg.norm(points, axis=1)
        assert ((distance >= 0.7) & (distance <= 5.0)).all()
