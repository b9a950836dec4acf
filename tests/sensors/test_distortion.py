"""Where the distortion stops being one-to-one: its radius, directions beyond it, pixels without a direction."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.distortion import MAX_ANGLE, Equidistant
from rbpf.sensors.camera.points import MIN_DEPTH_FRACTION
from tests.sensors.test_pinhole import FISHEYES, matrix, seen_points

FOLDING = Pinhole(640, 480, 320.0, 320.0, 320.0, 240.0, (-0.25, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("k3", [0.0, 1e-300, -1e-300, -0.05, -3.0])
@pytest.mark.parametrize(("k1", "k2"), [(-0.4, 0.02), (-0.4, -0.1), (0.3, -0.2), (0.0, -0.1)])
def test_radius_is_the_first_turning_point(k1, k2, k3):
    radius = Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0, (k1, k2, 0.0, 0.0, k3)).monotonic_radius

    def slope(r):
        return 1.0 + 3.0 * k1 * r**2 + 5.0 * k2 * r**4 + 7.0 * k3 * r**6

    assert slope(np.linspace(0.0, radius * (1.0 - 1e-9), 10_001)).min() > 0.0
    assert slope(radius) == pytest.approx(0.0, abs=1e-13)


def test_pixels_beyond_the_fold_have_no_direction():
    radius = FOLDING.monotonic_radius
    reach = FOLDING.fx * radius * (1.0 - 0.25 * radius**2)
    px = FOLDING.cx + np.array([-1.0, -0.999, 0.999, 1.001, 5.0])[:, None] * [reach, 0.0]
    px[:, 1] = FOLDING.cy
    finite = np.isfinite(FOLDING.unproject(px[1:]))
    np.testing.assert_array_equal(finite, [[True, True], [True, True], [False, False], [False, False]])
    np.testing.assert_array_equal(np.isfinite(FOLDING.unproject_jacobian(px[1:]))[:, 0, 0], finite[:, 0])
    assert np.isnan(FOLDING.unproject(np.array([[np.nan, 1.0], [np.inf, 1.0]]))).all()


@given(
    k1=st.floats(-0.5, 0.5),
    k2=st.floats(-0.3, 0.3),
    k3=st.floats(-0.1, 0.1),
    tangential=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
    fraction=st.floats(0.0, 0.98),
    angle=st.floats(0.0, 6.3),
)
def test_every_visible_direction_comes_back(k1, k2, k3, tangential, fraction, angle):
    camera = Pinhole(4000, 4000, 500.0, 500.0, 2000.0, 2000.0, (k1, k2, *tangential, k3))
    length = fraction * min(camera.monotonic_radius, 1.5)
    ray = np.array([length * np.cos(angle), length * np.sin(angle), 1.0])
    if camera.visible(ray):
        again = np.append(camera.unproject(camera.project(ray)), 1.0)
        np.testing.assert_allclose(camera.project(again), camera.project(ray), rtol=0, atol=1e-8)
        least = np.linalg.svd(camera.jacobian(ray), compute_uv=False)[-1] / camera.fx
        np.testing.assert_allclose(again, ray, rtol=0, atol=1e-11 / least)


every_fisheye = pytest.mark.parametrize("camera", FISHEYES.values(), ids=FISHEYES.keys())
FOLDING_LENS = (-0.3, 0.0, 0.0, 0.0)


def ray(angle: float | np.ndarray, around: float = 0.7) -> np.ndarray:
    """Directions (…, 3) at an angle from the axis."""
    angle = np.asarray(angle, float)
    parts = [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]
    return np.stack(parts, axis=-1)


@every_fisheye
def test_projects_and_unprojects_as_opencv(camera):
    points = seen_points(camera)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros((3, 1)), np.zeros((3, 1)), matrix(camera), np.array(camera.distortion)
    )
    assert len(points) > 500
    assert np.arctan2(np.hypot(*points[:, :2].T), points[:, 2]).max() > np.deg2rad(73.0)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], rtol=0, atol=1e-9)
    precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-15)
    k = matrix(camera), np.array(camera.distortion)
    uv = cv2.fisheye.undistortPoints(expected, *k, criteria=precise)[:, 0]
    np.testing.assert_allclose(camera.unproject(expected[:, 0]), uv, rtol=0, atol=1e-8)


def test_it_sees_75_degrees_from_the_axis_and_no_more():
    camera = Pinhole(2000, 2000, 262.0, 262.0, 1000.0, 1000.0, (0.0, 0.0, 0.0, 0.0), "equidistant")
    near, beyond = ray(np.deg2rad(74.99)), ray(np.deg2rad([75.01, 80.0, 89.9, 90.0, 100.0]))
    assert camera.visible(near)
    assert not camera.visible(beyond).any()
    assert np.isfinite(camera.unproject(camera.project(near))).all()
    assert np.isnan(camera.unproject(camera.project(beyond[:3]))).all()
    # The models of landmarks hold the depth positive from `MIN_DEPTH_FRACTION` on: there no pixel may still be taken for it.
    assert np.cos(MAX_ANGLE) > MIN_DEPTH_FRACTION


def test_the_circle_in_which_it_sees():
    camera = FISHEYES["tum-vi"]
    rows, columns = np.mgrid[:512, :512]
    seen = np.isfinite(camera.unproject(np.stack([columns, rows], axis=-1).astype(float)))[..., 0]
    np.testing.assert_array_equal(camera.field_of_view_mask(0.0), seen)
    px = np.argwhere(camera.field_of_view_mask(16.0))[:, ::-1]
    for corner in np.array([[-11.0, -11.0], [-11.0, 11.0], [11.0, -11.0], [11.0, 11.0]]):
        assert np.isfinite(camera.unproject(px + corner)).all()
    assert replace(camera, width=300, height=300, cx=150.0, cy=150.0).field_of_view_mask(16.0) is None
    assert Pinhole(640, 480, 320.0, 320.0, 320.0, 240.0, (-0.25, 0.0, 0.0, 0.0, 0.0)).field_of_view_mask(16.0) is None


def test_a_lens_that_folds_back_is_seen_up_to_there():
    lens = Equidistant(FOLDING_LENS)
    fold = np.sqrt(1.0 / 0.9)
    assert lens.max_angle == pytest.approx(fold, rel=1e-14)
    camera = Pinhole(900, 900, 262.0, 262.0, 450.0, 450.0, FOLDING_LENS, "equidistant")
    assert camera.visible(ray(fold - 1e-6)) and not camera.visible(ray(fold + 1e-6))
    reach = 262.0 * fold * (1.0 - 0.3 * fold**2)
    px = np.array([[450.0 + 0.999 * reach, 450.0], [450.0 + 1.001 * reach, 450.0], [np.nan, 1.0], [np.inf, 1.0]])
    np.testing.assert_array_equal(np.isfinite(camera.unproject(px))[:, 0], [True, False, False, False])


@given(coefficients=st.tuples(*[st.floats(-0.2, 0.2)] * 4), fraction=st.floats(0.0, 0.98), around=st.floats(0.0, 6.3))
def test_every_visible_direction_of_a_fisheye_comes_back(coefficients, fraction, around):
    lens = Equidistant(coefficients)
    camera = Pinhole(8000, 8000, 262.0, 262.0, 4000.0, 4000.0, coefficients, "equidistant")
    seen = ray(fraction * lens.max_angle, around)
    assert camera.visible(seen)
    again = np.append(camera.unproject(camera.project(seen)), 1.0)
    least = np.linalg.svd(camera.jacobian(again)[:, :2], compute_uv=False)[-1] / camera.fx
    np.testing.assert_allclose(again, seen / seen[2], rtol=0, atol=1e-11 / least)
