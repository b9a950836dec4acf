"""The compiled twins of the camera's models equal NumPy: rays, points and whole constellations."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera import kernels, points
from rbpf.sensors.camera.points import CameraPoint, CameraRay, ConstellationView, EpipolarRay, MembersView
from tests.exactness.models import known
from tests.sensors.camera_scenes import CAMERAS, DISTORTED, PLAIN, Rays, compiled, with_velocity

Z = np.array([250.0, 310.0])
every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
every_state = pytest.mark.parametrize("wide", [False, True], ids=["pose", "pose and velocity"])


def assert_twins(model, z, state, mean, const, tolerance=1e-10):
    """Relative to the largest number of each result: differences of large numbers are no better than these."""
    nu, by_state, by_landmark = compiled(model, z, state, mean, const)
    jacobians = known(model.jacobians(state, mean, const))
    expected = (
        model.innovation(z, state, mean, const),
        known(jacobians.state)[..., :6],
        known(jacobians.landmark),
    )
    for found, plain in zip((nu, by_state, by_landmark), expected, strict=True):
        assert np.isfinite(plain).all()
        np.testing.assert_allclose(found, plain, rtol=tolerance, atol=tolerance * np.abs(plain).max())


def lanes(seed: int, moved: float, wide: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """31 lanes: states, rays, their points and anchors."""
    rays = Rays.random(31, 1, seed, moved)
    state = with_velocity(rays.state) if wide else rays.state
    return state, rays.mean[:, 0], rays.points[:, 0], rays.const[:, 0]


@every_state
@every_camera
@pytest.mark.parametrize("moved", [0.0, 1e-6, 0.2, 3.0])
@pytest.mark.parametrize("kind", [CameraRay, EpipolarRay])
def test_rays(kind, camera, moved, wide):
    """Where the camera has hardly moved, and where points lie behind it."""
    state, mean, _, const = lanes(1, moved, wide)
    mean[3:6, 2] = [0.0, -0.1, 1e-9]
    assert_twins(kind(camera), Z, state, mean, const)
    if moved == 3.0:
        in_camera = CameraRay(camera).in_camera(state, mean, const)
        assert (in_camera[:, 2] < 0.0).any() and (in_camera[:, 2] > 0.0).any()


@every_state
@every_camera
@pytest.mark.parametrize("moved", [0.2, 3.0])
def test_points(camera, moved, wide):
    state, _, points, _ = lanes(2, moved, wide)
    assert_twins(CameraPoint(camera), Z, state, points, None)


@every_camera
def test_rays_on_either_side_of_the_threshold(camera):
    """Some have an epipolar line and some have none."""
    state, mean, _, const = lanes(3, 0.01, False)
    model = EpipolarRay(camera, rho=(0.6, 0.2), least_px=1.0)
    by_rho = known(known(CameraRay(camera).jacobians(state, mean, const)).landmark)[..., 2]
    lengths = np.linalg.norm(by_rho, axis=-1) * 0.2
    assert 5 < (lengths > 1.0).sum() < 26
    assert np.abs(lengths - 1.0).min() > 1e-9
    assert_twins(model, Z, state, mean, const)


def test_both_keep_the_same_depth_in_front():
    assert kernels.MIN_DEPTH_FRACTION == points.MIN_DEPTH_FRACTION


ANGLES = [0.0, 1e-9, 1e-3, 0.1 - 1e-9, 0.1 + 1e-9, 0.5, 1.0, 3.0, np.pi, 5.0]
"""The coefficients' series end at θ² = 0.01."""


@every_state
@every_camera
@pytest.mark.parametrize("angle", ANGLES)
def test_exact_constellations(angle, camera, wide):
    rng = np.random.default_rng(7)
    view = ConstellationView(camera, np.random.default_rng(6).normal(scale=0.3, size=(3, 3)))
    n = 31
    axis = rng.normal(size=(n, 3))
    xi = np.concatenate(
        [angle * axis / np.linalg.norm(axis, axis=1, keepdims=True), rng.normal(size=(n, 3))], axis=1
    )
    const = SE3.exp(rng.normal(size=(n, 6)))
    state = in_front(SE3.retract(const, xi), rng)
    in_camera = SE3.inverse_transform(
        state[:, None], SE3.transform(SE3.retract(const, xi)[:, None], view.points)
    )
    assert (in_camera[..., 2] > 0.5).mean() > 0.9
    z = np.tile(Z, 3) + 10.0 * rng.normal(size=6)
    assert_twins(view, z, with_velocity(state) if wide else state, xi, const, 1e-9)


@every_state
@every_camera
def test_uncertain_constellations(camera, wide):
    rng, n = np.random.default_rng(8), 31
    frame = SE3.exp(rng.normal(size=(n, 6)))
    points = SE3.transform(frame[:, None], rng.normal(scale=0.3, size=(n, 4, 3)))
    state = in_front(frame, rng)
    z = np.tile(Z, 3) + 10.0 * rng.normal(size=6)
    view = MembersView(camera, np.array([3, 0, 2]))
    assert_twins(
        view, z, with_velocity(state) if wide else state, points.reshape(n, 12), np.zeros((n, 0)), 1e-9
    )


def in_front(frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    ahead = np.concatenate([np.zeros(3), [0.0, 0.0, -2.5]])
    return SE3.retract(frame, ahead + rng.normal(scale=0.2, size=(len(frame), 6)))


def test_coefficients_meet_where_the_series_ends():
    """On either side of θ² = 0.01 a twin's numbers differ by the step alone, not by a missing term."""
    view, rng = ConstellationView(PLAIN, 0.3 * np.eye(3)), np.random.default_rng(8)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    const, state = SE3.identity((2,)), SE3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -3.0]] * 2))
    mean = np.zeros((2, 6))
    mean[:, :3] = np.outer([0.1 - 1e-13, 0.1 + 1e-13], direction)
    mean[:, 3:] = [0.3, -0.2, 0.4]
    assert (mean[0, :3] ** 2).sum() < 0.01 < (mean[1, :3] ** 2).sum()
    for part in compiled(view, np.tile(Z, 3), state, mean, const):
        np.testing.assert_allclose(part[0], part[1], rtol=1e-10, atol=1e-9)


def test_behind_the_camera():
    points = 0.3 * np.eye(3)
    state = SE3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, z] for z in (-3.0, 0.1, 3.0)]))
    exact = ConstellationView(DISTORTED, points)
    assert_twins(exact, np.tile(Z, 3), state, np.zeros((3, 6)), SE3.identity((3,)), 1e-9)
    uncertain = MembersView(DISTORTED, np.arange(3))
    assert_twins(uncertain, np.tile(Z, 3), state, np.tile(points.ravel(), (3, 1)), np.zeros((3, 0)), 1e-9)
