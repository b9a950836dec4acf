"""The rectified stereo pair: pixels, derivatives, round trips, visibility, and what is refused."""

import re

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo

CAMERA = Pinhole(640, 480, 525.0, 520.0, 319.5, 239.5)
STEREO = RectifiedStereo(CAMERA, 0.12)
DISTORTED = Pinhole(640, 480, 320.0, 320.0, 320.0, 240.0, (-0.25, 0.0, 0.0, 0.0, 0.0))


class TestRectifiedStereo:
    points = np.array([[0.0, 0.0, 2.0], [0.5, -0.3, 4.0], [-1.0, 0.8, 9.0], [3.0, 2.0, 60.0]])

    def test_pixels(self):
        z = STEREO.project(np.array([0.5, -0.3, 4.0]))
        left = [319.5 + 525.0 * 0.125, 239.5 - 520.0 * 0.075, 319.5 + 525.0 * 0.38 / 4.0]
        np.testing.assert_allclose(z, left, rtol=1e-15)
        assert STEREO.dim == z.shape[-1] == 3

    def test_slope_is_the_derivative(self):
        step = 1e-4 * np.eye(3)[:, None]
        numeric = (STEREO.project(self.points + step) - STEREO.project(self.points - step)) / 2e-4
        numeric = np.moveaxis(numeric, 0, -1)
        np.testing.assert_allclose(STEREO.jacobian(self.points), numeric, rtol=0, atol=1e-5)

    def test_round_trip(self):
        np.testing.assert_allclose(STEREO.triangulate(STEREO.project(self.points)), self.points, rtol=1e-10)
        z = np.array([[[400.0, 100.0, 380.0], [20.0, 470.0, 19.0]]])
        np.testing.assert_allclose(STEREO.project(STEREO.triangulate(z)), z, rtol=1e-12)

    def test_no_point_without_disparity(self):
        z = np.array([[100.0, 100.0, 100.0], [100.0, 100.0, 101.0], [101.0, 100.0, 100.0]])
        np.testing.assert_array_equal(np.isfinite(STEREO.triangulate(z)).all(axis=1), [False, False, True])

    def test_visible_in_both_images(self):
        # 0.6 m to the left at 1 m: u_left is 4.5, u_right is −58.5.
        points = np.array(
            [[-0.6, 0.0, 1.0], [-0.4, 0.0, 1.0], [0.0, 0.0, -1.0], [0.7, 0.0, 1.0], [0.0, 0.6, 1.0]]
        )
        np.testing.assert_array_equal(STEREO.visible(points), [False, True, False, False, False])
        assert STEREO.camera.visible(points[0])
        assert not STEREO.camera.visible(points[3])
        assert not STEREO.visible(points[1], margin_px=50.0)
        np.testing.assert_array_equal(STEREO.inside(STEREO.project(points[:2])), [False, True])


@pytest.mark.parametrize(
    ("camera", "baseline", "message"),
    [
        (CAMERA, 0.0, "the stereo baseline must be positive, got 0.0 m"),
        (CAMERA, -0.1, "the stereo baseline must be positive, got -0.1 m"),
        (CAMERA, float("nan"), "the stereo baseline must be a finite number, got nan"),
        (
            DISTORTED,
            0.1,
            "the camera of a rectified stereo pair has radial-tangential distortion (-0.25, 0.0, 0.0, 0.0, 0.0): "
            "rectify the images and give the camera of the rectified ones",
        ),
    ],
)
def test_a_wrong_stereo_pair_is_refused(camera, baseline, message):
    with pytest.raises(InputError, match=f"^{re.escape(message)}$"):
        RectifiedStereo(camera, baseline)
