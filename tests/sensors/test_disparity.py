"""Refinement of disparities on grey values."""

import numpy as np

from rbpf.sensors.stereo import refine


def texture(columns, lines):
    """A smooth pattern that is known everywhere."""
    rng = np.random.default_rng(5)
    total = np.zeros(np.broadcast_shapes(columns.shape, lines.shape))
    for _ in range(25):
        angle, period, phase = rng.uniform(0, np.pi), rng.uniform(5, 14), rng.uniform(0, 2 * np.pi)
        along = np.cos(angle) * columns + np.sin(angle) * lines
        total += np.cos(2 * np.pi * along / period + phase)
    return total


def pair(disparity, gain=1.0, offset=0.0, noise=0.0):
    line, column = np.mgrid[:80, :120].astype(float)
    rng = np.random.default_rng(0)
    left = 128 + 9 * texture(column, line)
    right = 128 + gain * 9 * texture(column + disparity, line) + offset
    return tuple(
        np.clip(np.rint(image + noise * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)
        for image in (left, right)
    )


PX = np.random.default_rng(3).uniform([50, 15], [100, 65], (60, 2))


def test_a_known_disparity_is_found():
    for disparity in (10.0, 10.25, 10.5, 13.8):
        found = refine(*pair(disparity), PX, PX[:, 0] - disparity + 0.6)
        np.testing.assert_allclose(found.u, PX[:, 0] - disparity, atol=0.05)
        assert np.abs(np.mean(found.u - PX[:, 0] + disparity)) < 0.005
        assert (found.correlation > 0.98).all()


def test_brightness_and_contrast_do_not_matter():
    found = refine(*pair(9.4, gain=0.6, offset=25.0), PX, PX[:, 0] - 9.0)
    np.testing.assert_allclose(found.u, PX[:, 0] - 9.4, atol=0.05)


def test_the_correlation_tells_right_from_wrong():
    left, right = pair(9.4, noise=4.0)
    assert np.median(refine(left, right, PX, PX[:, 0] - 9.0).correlation) > 0.9
    assert np.median(refine(left, right, PX, PX[:, 0] - 31.0).correlation) < 0.6


def test_the_window_has_to_be_in_both_images():
    left, right = pair(9.4)
    px = np.array([[4.0, 40.0], [12.0, 40.0], [60.0, 4.0], [60.0, 40.0], [60.0, 76.0]])
    found = refine(left, right, px, px[:, 0] - 9.0)
    np.testing.assert_array_equal(np.isfinite(found.u), [False, False, False, True, False])
    np.testing.assert_array_equal(found.correlation > 0.0, np.isfinite(found.u))


def test_without_texture_there_is_no_correlation():
    flat = np.full((40, 60), 90, dtype=np.uint8)
    found = refine(flat, flat, np.array([[30.0, 20.0]]), np.array([25.0]))
    assert found.correlation[0] == 0.0 and np.isfinite(found.u[0])
    assert refine(flat, flat, np.zeros((0, 2)), np.zeros(0)).u.shape == (0,)
