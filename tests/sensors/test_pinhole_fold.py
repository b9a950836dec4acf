"""Where the distortion stops being one-to-one: its radius, directions beyond it, pixels without a direction."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.sensors.camera import Pinhole

FOLDING = Pinhole(640, 480, 320.0, 320.0, 320.0, 240.0, (-0.25, 0.0, 0.0, 0.0, 0.0))


def test_radius_of_one_coefficient():
    assert FOLDING.monotonic_radius == pytest.approx(np.sqrt(4.0 / 3.0), rel=1e-15)
    assert Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0).monotonic_radius == np.inf
    pincushion = Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0, (0.25, 0.12, -0.003, 0.004, 0.05))
    assert pincushion.monotonic_radius == np.inf


@pytest.mark.parametrize("k3", [0.0, 1e-300, -1e-300, -0.05, -3.0])
@pytest.mark.parametrize(("k1", "k2"), [(-0.4, 0.02), (-0.4, -0.1), (0.3, -0.2), (0.0, -0.1)])
def test_radius_is_the_first_turning_point(k1, k2, k3):
    radius = Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0, (k1, k2, 0.0, 0.0, k3)).monotonic_radius

    def slope(r):
        return 1.0 + 3.0 * k1 * r**2 + 5.0 * k2 * r**4 + 7.0 * k3 * r**6

    assert slope(np.linspace(0.0, radius * (1.0 - 1e-9), 10_001)).min() > 0.0
    assert slope(radius) == pytest.approx(0.0, abs=1e-13)


def test_a_point_that_folds_back_into_the_image_is_not_visible():
    radius = FOLDING.monotonic_radius
    # r (1 − r²/4) is 0 at r = 2 and falls from the radius on: two directions for one pixel.
    rays = np.array([[1.9, 0.0, 1.0], [0.0, -1.5, 1.0], [-2.0, 0.0, 1.0], [radius + 1e-9, 0.0, 1.0]])
    assert FOLDING.inside(FOLDING.project(rays)).all()
    assert not FOLDING.visible(rays).any()
    assert FOLDING.visible(np.array([0.7, 0.0, 1.0]))


def test_a_point_beyond_a_second_fold_is_not_visible():
    # The derivative 1 − 1.5 r² + 0.5 r⁴ is negative from 1 to √2 alone: beyond, the image runs outwards once more.
    camera = Pinhole(640, 480, 320.0, 320.0, 320.0, 240.0, (-0.5, 0.1, 0.0, 0.0, 0.0))
    ray = np.array([1.6, 0.0, 1.0])
    assert camera.monotonic_radius == pytest.approx(1.0, rel=1e-14)
    assert camera.jacobian(ray)[0, 0] > 0.0
    assert camera.inside(camera.project(ray))
    assert not camera.visible(ray)
    # It lands beyond the pixel of the first fold, 512, which no direction within the radius exceeds.
    assert np.isnan(camera.unproject(camera.project(ray))).all()


def test_unproject_finds_the_direction_on_this_side_of_the_fold():
    px = FOLDING.project(np.array([[1.9, 0.0, 1.0], [0.0, -1.5, 1.0]]))
    uv = FOLDING.unproject(px)
    assert (np.hypot(*uv.T) < FOLDING.monotonic_radius).all()
    rays = np.concatenate([uv, np.ones((2, 1))], axis=1)
    np.testing.assert_allclose(FOLDING.project(rays), px, rtol=0, atol=1e-9)


def test_pixels_beyond_the_fold_have_no_direction():
    radius = FOLDING.monotonic_radius
    reach = FOLDING.fx * radius * (1.0 - 0.25 * radius**2)
    px = FOLDING.cx + np.array([-1.0, -0.999, 0.999, 1.001, 5.0])[:, None] * [reach, 0.0]
    px[:, 1] = FOLDING.cy
    finite = np.isfinite(FOLDING.unproject(px[1:]))
    np.testing.assert_array_equal(finite, [[True, True], [True, True], [False, False], [False, False]])
    np.testing.assert_array_equal(np.isfinite(FOLDING.unproject_jacobian(px[1:]))[:, 0, 0], finite[:, 0])
    assert np.isnan(FOLDING.unproject(np.array([[np.nan, 1.0], [np.inf, 1.0]]))).all()


def test_tangential_distortion_that_folds_back():
    camera = Pinhole(640, 480, 320.0, 320.0, 320.0, 240.0, (0.0, 0.0, 0.01, 0.0, 0.0))
    # Along v the model is v + 3 p1 v²: v = −1/(3 p1) lands on the principal point.
    ray = np.array([0.0, -1.0 / 0.03, 1.0])
    np.testing.assert_allclose(camera.project(ray), [320.0, 240.0], atol=1e-9)
    assert not camera.visible(ray)
    np.testing.assert_allclose(camera.unproject(camera.project(ray)), [0.0, 0.0], atol=1e-12)


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
