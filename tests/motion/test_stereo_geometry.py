"""Pixels after a motion, and the innovation of matches: projection, derivatives, infinity, compiled twins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from rbpf.lie import SE3
from rbpf.motion.stereo_geometry import (
    homography,
    linearised,
    pixels_from_points,
    points_from_pixels,
    reproject,
    residuals,
    squared_distances,
    times_pixels,
    white_rows,
)
from tests.motion.numpy_twins import innovation
from tests.motion.stereo_pairs import CAR, FAR_ROAD, HAND, LEAP, ROAD, correlated, noiseless

worlds = pytest.mark.parametrize("world", [ROAD, LEAP], ids=["road", "leap"])


def numeric(function, at, step):
    columns = [(function(at + step * unit) - function(at - step * unit)) / (2.0 * step) for unit in np.eye(len(at))]
    return np.stack(columns, axis=-1)


@worlds
def test_points_are_seen_where_the_camera_projects_them(world):
    before, now, delta = noiseless(world, 50, np.random.default_rng(0))
    seen = reproject(world.camera, delta, before)
    np.testing.assert_allclose(seen.pixels, now, atol=1e-9)
    np.testing.assert_allclose(seen.inverse_depth, 1.0 / world.camera.triangulate(before)[:, 2], rtol=1e-9)
    assert seen.front.all()


def test_the_two_matrices_are_inverse():
    np.testing.assert_allclose(pixels_from_points(HAND) @ points_from_pixels(HAND), np.eye(4), atol=1e-12)


@worlds
def test_derivatives(world):
    before, _, delta = noiseless(world, 3, np.random.default_rng(1))
    seen = reproject(world.camera, delta, before)
    for row, pixels in enumerate(before):
        by_motion = numeric(
            lambda xi, z=pixels: reproject(world.camera, SE3.retract(delta, xi), z[None]).pixels[0], np.zeros(6), 1e-5
        )
        by_pixels = numeric(lambda z: reproject(world.camera, delta, z[None]).pixels[0], pixels, 1e-3)
        np.testing.assert_allclose(seen.by_motion[row], by_motion, atol=1e-4 * np.abs(by_motion).max())
        np.testing.assert_allclose(seen.by_pixels[row], by_pixels, atol=1e-6)


def test_infinity_is_nowhere_special():
    """Pixels and derivatives go on smoothly where the disparity becomes negative."""
    delta = SE3.exp(np.array(ROAD.xi))
    disparity = np.array([0.02, 0.01, 0.0, -0.01, -0.02])
    pixels = np.stack([np.full(5, 700.0), np.full(5, 100.0), 700.0 - disparity], axis=1)
    seen = reproject(CAR, delta, pixels)
    assert seen.front.all()
    np.testing.assert_allclose(np.diff(seen.pixels, n=2, axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(np.diff(seen.by_motion, n=2, axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(seen.by_motion[2, :, 3:], 0.0, atol=1e-11)
    # A direction alone, turned.
    ray = SE3.rotation(delta).T @ [*CAR.camera.unproject(pixels[2, :2]), 1.0]
    np.testing.assert_allclose(seen.pixels[2, :2], CAR.camera.project(ray), rtol=1e-12)


def test_a_point_that_the_camera_has_passed_is_not_in_front():
    point = np.array([[0.3, 0.1, 2.0], [0.3, 0.1, 4.0]])
    seen = reproject(HAND, SE3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.0])), HAND.project(point))
    np.testing.assert_array_equal(seen.front, [False, True])
    assert np.isfinite(seen.pixels).all()


def test_many_motions_at_once():
    before, _, delta = noiseless(ROAD, 5, np.random.default_rng(2))
    deltas = np.stack([delta, SE3.identity(), SE3.inverse(delta)])
    together = reproject(CAR, deltas, np.broadcast_to(before, (3, 5, 3)))
    for row, one in enumerate(deltas):
        alone = reproject(CAR, one, before)
        np.testing.assert_allclose(together.pixels[row], alone.pixels, rtol=1e-12)
        np.testing.assert_allclose(together.by_motion[row], alone.by_motion, rtol=1e-9, atol=1e-12)
    raised = times_pixels(homography(CAR, SE3.identity()), before)
    np.testing.assert_allclose(raised, np.concatenate([before, np.ones((5, 1))], axis=1), atol=1e-9)


every_kind = pytest.mark.parametrize("points", ["adjusted", "propagated", "exact"])


@every_kind
@pytest.mark.parametrize("world", [ROAD, LEAP, FAR_ROAD], ids=["road", "leap", "far"])
def test_the_compiled_twin(world, points):
    matches, delta = correlated(world, 40, np.random.default_rng(0))
    rows, front, pixels = white_rows(matches, delta, points)
    found, expected = innovation(matches, delta, points)
    np.testing.assert_allclose(pixels, found.pixels, atol=1e-4)
    assert front.all() and found.seen.front.all()
    # The twins end their sweeps for each match, and for all.
    np.testing.assert_allclose(rows, expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(squared_distances(matches, delta, points), np.square(rows[..., 0]).sum(axis=1))


@every_kind
def test_points_behind_the_camera(points):
    matches, _ = correlated(LEAP, 30, np.random.default_rng(1))
    past = SE3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.0]))
    behind = LEAP.camera.triangulate(matches.z_prev)[:, 2] < 2.9
    rows, front, _ = white_rows(matches, past, points)
    distances = squared_distances(matches, past, points)
    assert behind.any() and not front[behind].any()
    np.testing.assert_array_equal(rows[~front], 0.0)
    np.testing.assert_array_equal(innovation(matches, past, points)[0].seen.front, front)
    np.testing.assert_array_equal(np.isinf(distances), ~front)
    assert np.isinf(residuals(matches, past, points)[0]).all()


def test_the_earlier_points_covariance_in_space():
    """A R⁻ Aᵀ = J_P C J_Pᵀ, with the derivatives of the camera itself."""
    matches, delta = correlated(ROAD, 20, np.random.default_rng(2))
    camera = matches.camera
    before = camera.triangulate(matches.z_prev)
    by_z = np.linalg.inv(camera.jacobian(before))
    cov_points = by_z @ matches.cov_prev @ by_z.mT
    by_point = camera.jacobian(SE3.inverse_transform(delta, before)) @ SE3.rotation(delta).T
    expected = matches.cov_now + by_point @ cov_points @ by_point.mT
    np.testing.assert_allclose(linearised(matches, delta, matches.z_prev, "propagated").cov, expected, rtol=1e-8)
    np.testing.assert_array_equal(linearised(matches, delta, matches.z_prev, "exact").cov, matches.cov_now)


@pytest.mark.parametrize("world", [ROAD, LEAP, FAR_ROAD], ids=["road", "leap", "far"])
def test_adjusted_distances_are_the_minimum_over_the_point(world):
    matches, delta = correlated(world, 6, np.random.default_rng(3))
    off = SE3.retract(delta, 0.01 * np.ones(6))
    ours = squared_distances(matches, off, "adjusted")
    for row in range(len(matches)):
        one = matches.rows(np.array([row]))
        whites = [np.linalg.inv(np.linalg.cholesky(cov[0])) for cov in (one.cov_prev, one.cov_now)]

        def misses(pixels, one=one, whites=whites):
            seen = reproject(one.camera, off, pixels[None]).pixels[0]
            return np.concatenate([whites[0] @ (one.z_prev[0] - pixels), whites[1] @ (one.z_now[0] - seen)])

        theirs = least_squares(misses, one.z_prev[0], xtol=1e-15, ftol=1e-15, gtol=1e-12)
        np.testing.assert_allclose(ours[row], 2.0 * theirs.cost, rtol=1e-6)


@pytest.mark.parametrize("world", [ROAD, LEAP, FAR_ROAD], ids=["road", "leap", "far"])
def test_the_derivative_of_what_is_minimised(world):
    """Jᵀε is the gradient of ½‖ε‖² after the points are eliminated, also away from the minimum."""
    matches, delta = correlated(world, 30, np.random.default_rng(4))
    off = SE3.retract(delta, np.array([2e-3, -1e-3, 1e-3, 0.02, 0.01, -0.02]))
    residual, jac = residuals(matches, off, "adjusted")

    def half(xi):
        return 0.5 * squared_distances(matches, SE3.retract(off, xi), "adjusted").sum()

    steps = 1e-4 * np.repeat([0.1, 1.0], 3)
    numeric = [(half(s * e) - half(-s * e)) / (2 * s) for s, e in zip(steps, np.eye(6), strict=True)]
    np.testing.assert_allclose(jac.T @ residual, numeric, rtol=2e-4)


def test_exact_derivative():
    matches, delta = correlated(LEAP, 10, np.random.default_rng(5))
    matches = replace(matches, z_now=matches.z_now + 1.0)
    jac = residuals(matches, delta, "exact")[1]
    step = 1e-6
    numeric = [
        residuals(matches, SE3.retract(delta, step * e), "exact")[0]
        - residuals(matches, SE3.retract(delta, -step * e), "exact")[0]
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(jac, np.stack(numeric, axis=1) / (2 * step), atol=1e-4 * np.abs(jac).max())
