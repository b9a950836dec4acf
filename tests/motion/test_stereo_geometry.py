"""Pixels after a motion: the camera's own projection, numeric derivatives, infinity, and what is behind."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.motion.stereo_geometry import homography, pixels_from_points, points_from_pixels, raise_pixels, see
from tests.motion.stereo_pairs import CAR, HAND, LEAP, ROAD, noiseless

worlds = pytest.mark.parametrize("world", [ROAD, LEAP], ids=["road", "leap"])


def numeric(function, at, step):
    columns = [
        (function(at + step * unit) - function(at - step * unit)) / (2.0 * step) for unit in np.eye(len(at))
    ]
    return np.stack(columns, axis=-1)


@worlds
def test_points_are_seen_where_the_camera_projects_them(world):
    before, now, delta = noiseless(world, 50, np.random.default_rng(0))
    seen = see(world.camera, delta, before)
    np.testing.assert_allclose(seen.pixels, now, atol=1e-9)
    np.testing.assert_allclose(seen.nearness, 1.0 / world.camera.triangulate(before)[:, 2], rtol=1e-9)
    assert seen.front.all()


def test_the_two_matrices_are_inverse():
    np.testing.assert_allclose(pixels_from_points(HAND) @ points_from_pixels(HAND), np.eye(4), atol=1e-12)


@worlds
def test_derivatives(world):
    before, _, delta = noiseless(world, 3, np.random.default_rng(1))
    seen = see(world.camera, delta, before)
    for row, pixels in enumerate(before):
        by_motion = numeric(
            lambda xi, z=pixels: see(world.camera, SE3.retract(delta, xi), z[None]).pixels[0],
            np.zeros(6),
            1e-5,
        )
        by_pixels = numeric(lambda z: see(world.camera, delta, z[None]).pixels[0], pixels, 1e-3)
        np.testing.assert_allclose(seen.by_motion[row], by_motion, atol=1e-4 * np.abs(by_motion).max())
        np.testing.assert_allclose(seen.by_pixels[row], by_pixels, atol=1e-6)


def test_infinity_is_nowhere_special():
    """Pixels and derivatives go on smoothly where the disparity becomes negative."""
    delta = SE3.exp(np.array(ROAD.xi))
    disparity = np.array([0.02, 0.01, 0.0, -0.01, -0.02])
    pixels = np.stack([np.full(5, 700.0), np.full(5, 100.0), 700.0 - disparity], axis=1)
    seen = see(CAR, delta, pixels)
    assert seen.front.all()
    np.testing.assert_allclose(np.diff(seen.pixels, n=2, axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(np.diff(seen.by_motion, n=2, axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(seen.by_motion[2, :, 3:], 0.0, atol=1e-11)
    # A direction alone, turned.
    ray = SE3.rotation(delta).T @ [*CAR.camera.unproject(pixels[2, :2]), 1.0]
    np.testing.assert_allclose(seen.pixels[2, :2], CAR.camera.project(ray), rtol=1e-12)


def test_a_point_that_the_camera_has_passed_is_not_in_front():
    point = np.array([[0.3, 0.1, 2.0], [0.3, 0.1, 4.0]])
    seen = see(HAND, SE3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.0])), HAND.project(point))
    np.testing.assert_array_equal(seen.front, [False, True])
    assert np.isfinite(seen.pixels).all()


def test_many_motions_at_once():
    before, _, delta = noiseless(ROAD, 5, np.random.default_rng(2))
    deltas = np.stack([delta, SE3.identity(), SE3.inverse(delta)])
    together = see(CAR, deltas, np.broadcast_to(before, (3, 5, 3)))
    for row, one in enumerate(deltas):
        alone = see(CAR, one, before)
        np.testing.assert_allclose(together.pixels[row], alone.pixels, rtol=1e-12)
        np.testing.assert_allclose(together.by_motion[row], alone.by_motion, rtol=1e-9, atol=1e-12)
    raised = raise_pixels(homography(CAR, SE3.identity()), before)
    np.testing.assert_allclose(raised, np.concatenate([before, np.ones((5, 1))], axis=1), atol=1e-9)
