"""World points in a rectified pair: the model is sound, starts points, and has a compiled twin."""

import numpy as np
import pytest

from rbpf.conformance import check_model
from rbpf.core.models import ObservationModel
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.camera.points import StereoPoint
from tests.sensors.camera_scenes import PLAIN, Rays
from tests.sensors.test_camera_kernels import assert_twins, lanes

RIG = RectifiedStereo(PLAIN, 0.12)


def test_a_sound_model():
    """With a lens so long that no step of the check's turning camera is by chance about 2π px."""
    long = RectifiedStereo(Pinhole(6400, 4800, 4000.0, 4100.0, 3199.5, 2399.5), 0.12)
    assert check_model(StereoPoint(long), SE3) == []


@pytest.mark.parametrize("wide", [False, True], ids=["pose", "pose and velocity"])
@pytest.mark.parametrize("moved", [0.2, 3.0])
def test_the_twin(moved, wide):
    """In front of the cameras and behind them."""
    state, _, points, _ = lanes(2, moved, wide)
    assert_twins(StereoPoint(RIG), np.array([250.0, 310.0, 241.0]), state, points, None)
    if moved == 3.0:
        assert (StereoPoint(RIG).in_camera(state, points)[:, 2] < 0.0).any()


def test_it_starts_points():
    """The analytic covariance against the numeric one of `invert`; the points are seen where they were measured."""
    rays, model = Rays.random(4, 5), StereoPoint(RIG)
    local = np.random.default_rng(1).uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 6.0], size=(5, 3))
    z, cov = RIG.project(local), np.broadcast_to(np.diag([0.1, 0.2, 0.15]) + 0.05, (5, 3, 3))
    records = model.initialise(rays.state, z, cov)
    seen = model.predict(rays.state[:, None], records.mean)
    np.testing.assert_allclose(seen, np.broadcast_to(z, (4, 5, 3)), atol=1e-9)
    numeric = ObservationModel.initialise(model, rays.state, z, cov)
    np.testing.assert_allclose(records.mean, numeric.mean, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(records.cov, numeric.cov, rtol=1e-5, atol=1e-9)
