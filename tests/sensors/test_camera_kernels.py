"""The compiled twins of the camera's models equal NumPy: rays, points and whole constellations."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors import camera_kernels, camera_points
from rbpf.sensors.camera_constellation import ConstellationView
from rbpf.sensors.camera_points import CameraPoint, CameraRay, EpipolarRay
from tests.exactness.models import known
from tests.sensors.camera_scenes import DISTORTED, PLAIN, Rays, compiled, with_velocity

Z = np.array([250.0, 310.0])
every_camera = pytest.mark.parametrize("camera", [PLAIN, DISTORTED], ids=["plain", "distorted"])
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
    assert camera_kernels.GRAZING == camera_points.GRAZING


ANGLES = [0.0, 1e-9, 1e-3, 0.1 - 1e-9, 0.1 + 1e-9, 0.5, 1.0, 3.0, np.pi, 5.0]
"""The coefficients' series end at θ² = 0.01."""


def views(camera, errors: bool) -> ConstellationView:
    points = np.random.default_rng(6).normal(scale=0.3, size=(3, 3))
    return ConstellationView(camera, points, np.array([3, 0, 2]) if errors else None)


@every_state
@every_camera
@pytest.mark.parametrize("errors", [False, True], ids=["exact", "errors"])
@pytest.mark.parametrize("angle", ANGLES)
def test_constellations(angle, errors, camera, wide):
    rng, view = np.random.default_rng(7), views(camera, errors)
    n = 31
    axis = rng.normal(size=(n, 3))
    xi = np.concatenate(
        [angle * axis / np.linalg.norm(axis, axis=1, keepdims=True), rng.normal(size=(n, 3))], axis=1
    )
    mean = np.concatenate([xi, rng.normal(scale=0.02, size=(n, 12 if errors else 0))], axis=1)
    const = SE3.exp(rng.normal(size=(n, 6)))
    ahead = np.concatenate([np.zeros(3), [0.0, 0.0, -2.5]])
    state = SE3.retract(SE3.retract(const, xi), ahead + rng.normal(scale=0.2, size=(n, 6)))
    in_camera = SE3.inverse_transform(
        state[:, None], SE3.transform(SE3.retract(const, xi)[:, None], view.points)
    )
    assert (in_camera[..., 2] > 0.5).mean() > 0.9
    z = np.tile(Z, 3) + 10.0 * rng.normal(size=6)
    wide_state = with_velocity(state) if wide else state
    assert_twins(view, z, wide_state, mean, const, 1e-9)


def test_coefficients_meet_where_the_series_ends():
    """On either side of θ² = 0.01 a twin's numbers differ by the step alone, not by a missing term."""
    view, rng = views(PLAIN, True), np.random.default_rng(8)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    const, state = SE3.identity((2,)), SE3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -3.0]] * 2))
    mean = np.zeros((2, 18))
    mean[:, :3] = np.outer([0.1 - 1e-13, 0.1 + 1e-13], direction)
    mean[:, 3:6], mean[:, 6:] = [0.3, -0.2, 0.4], 0.01 * rng.normal(size=12)
    assert (mean[0, :3] ** 2).sum() < 0.01 < (mean[1, :3] ** 2).sum()
    for part in compiled(view, np.tile(Z, 3), state, mean, const):
        np.testing.assert_allclose(part[0], part[1], rtol=1e-10, atol=1e-9)


def test_behind_the_camera():
    view = views(DISTORTED, True)
    state = SE3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, z] for z in (-3.0, 0.1, 3.0)]))
    assert_twins(view, np.tile(Z, 3), state, np.zeros((3, 18)), SE3.identity((3,)), 1e-9)


def test_lanes_beyond_the_count_stay_untouched():
    """Rows of errors that are not seen are zero, of lanes that do not count what they were."""
    view = views(PLAIN, True)
    nu, by_state, by_landmark = compiled(
        view,
        np.tile(Z, 3),
        SE3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -3.0]])),
        np.zeros((1, 18)),
        SE3.identity((1,)),
    )
    np.testing.assert_array_equal(by_landmark[..., 9:12], 0.0)
    for row, place in ((slice(0, 2), 3), (slice(2, 4), 0), (slice(4, 6), 2)):
        assert np.abs(by_landmark[0, row, 6 + 3 * place : 9 + 3 * place]).max() > 10.0
    assert np.isfinite(nu).all() and np.isfinite(by_state).all()
