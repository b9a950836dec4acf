"""A camera from points of which many are mistaken."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.resection import refined, resect_consensus

CAMERA = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0, (-0.2, 0.05, 0.001, -0.001, 0.0))
POSE = SE3.retract(SE3.identity(), np.array([0.2, -0.3, 0.1, 0.5, -0.2, 0.4]))


def seen(count: int, rng: np.random.Generator, noise_px: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Points in front of the camera, and where they are seen."""
    uv = rng.uniform(-0.4, 0.4, (count, 2))
    points = np.concatenate([uv, np.ones((count, 1))], axis=1) * rng.uniform(1.0, 4.0, (count, 1))
    return SE3.transform(POSE, points), CAMERA.project(points) + noise_px * rng.normal(size=(count, 2))


@pytest.mark.parametrize("mistaken", [0, 20, 40])
def test_finds_the_camera_among_mistakes(mistaken):
    rng = np.random.default_rng(mistaken)
    points, px = seen(25 + mistaken, rng)
    px[:mistaken] = rng.uniform((0, 0), (640, 480), (mistaken, 2))
    found = resect_consensus(CAMERA, points, px, 4.0, 300, rng)
    assert found is not None
    assert found.inliers[mistaken:].mean() > 0.95
    assert found.inliers[:mistaken].sum() <= 1
    assert found.rms_px < 1.0
    assert np.abs(SE3.log(SE3.between(POSE, found.world_from_camera))).max() < 5e-3


def test_information_is_that_of_the_error():
    errors, predicted = [], None
    for seed in range(60):
        points, px = seen(20, np.random.default_rng(1), 0.0)
        px = px + 0.5 * np.random.default_rng(seed).normal(size=px.shape)
        found = refined(CAMERA, POSE, points, px, 10.0)
        assert found is not None
        errors.append(SE3.log(SE3.between(POSE, found.world_from_camera)))
        predicted = 0.25 * np.linalg.inv(found.information)
    assert np.std(errors, axis=0) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.35)


def test_points_on_a_line_fix_nothing():
    along = np.linspace(0.0, 1.0, 12)[:, None]
    camera_points = np.array([-0.5, 0.1, 2.0]) + along * np.array([1.0, 0.0, 0.5])
    points, px = SE3.transform(POSE, camera_points), CAMERA.project(camera_points)
    rng = np.random.default_rng(0)
    found = resect_consensus(CAMERA, points, px, 4.0, 100, rng)
    assert found is None or np.linalg.cond(found.information) > 1e8


def test_too_few_points_give_nothing():
    points, px = seen(3, np.random.default_rng(0))
    assert resect_consensus(CAMERA, points, px, 4.0, 50, np.random.default_rng(0)) is None


def test_nothing_agrees_with_points_behind_the_camera():
    points, px = seen(10, np.random.default_rng(0))
    behind = SE3.retract(POSE, np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert refined(CAMERA, behind, points, px, 4.0) is None
