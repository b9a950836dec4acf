"""The compiled projection against the NumPy one."""

import numpy as np
import pytest
from numba import njit

from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.kernels import project

DISTORTIONS = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0),
    "barrel": (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
    "strong": (-0.42, 0.21, 0.012, -0.009, -0.06),
    "pincushion": (0.3, 0.2, -0.01, 0.01, 0.08),
    "equidistant": (0.0, 0.0, 0.0, 0.0),
    "fisheye": (-0.03, 0.02, -0.012, 0.002),
}


@njit(error_model="numpy")
def project_all(points, params):
    """The kernel in a loop, as the sensors' kernels use it."""
    out = np.empty((points.shape[0], 8))
    for i in range(points.shape[0]):
        out[i] = project(points[i, 0], points[i, 1], points[i, 2], params)
    return out


@pytest.mark.parametrize("distortion", DISTORTIONS.values(), ids=DISTORTIONS.keys())
def test_pixels_and_slope_equal_numpys(distortion):
    model = "equidistant" if len(distortion) == 4 else "radial-tangential"
    camera = Pinhole(752, 480, 458.654, 457.296, 367.215, 248.375, distortion, model)
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.2, 40.0, (500, 1)) * rng.choice([-1.0, 1.0], (500, 1))
    points = np.concatenate([rng.uniform(-1.2, 1.2, (500, 2)), np.ones((500, 1))], axis=1) * depth
    points[0] = [0.0, 0.0, 2.0]
    points[1:5, :2] = points[1:5, 2:] * np.array([[1e-9, 0.0], [-2e-8, 1e-8], [3.6, 0.5], [1e-200, 0.0]])
    out = project_all(points, camera.params)
    np.testing.assert_allclose(out[:, :2], camera.project(points), rtol=1e-12, atol=1e-12 * camera.fx)
    slope, scale = camera.jacobian(points), camera.fx / np.abs(points[:, 2, None, None])
    np.testing.assert_allclose(out[:, 2:].reshape(-1, 2, 3) / scale, slope / scale, rtol=1e-12, atol=1e-12)


def test_called_by_itself():
    camera = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0)
    found = project(0.4, -0.2, 2.0, camera.params)
    assert found == pytest.approx((420.0, 189.0, 250.0, 0.0, -50.0, 0.0, 255.0, 25.5), rel=1e-15)


def test_the_plane_of_the_camera_gives_no_number_and_no_error():
    camera = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0)
    assert not np.isfinite(project_all(np.array([[1.0, 0.5, 0.0]]), camera.params)[0, :2]).any()
    assert not np.isfinite(camera.project(np.array([1.0, 0.5, 0.0]))).any()
