"""Points and rays seen by a camera whose pose is the state."""

import numpy as np
import pytest

from rbpf.conformance import Example, check_model
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.sensors.camera.points import MIN_DEPTH_FRACTION, CameraPoint, CameraRay, EpipolarRay
from tests.exactness.models import known
from tests.sensors.camera_scenes import CAMERAS, PLAIN, Rays, with_velocity

every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


@every_camera
def test_sound_models(camera):
    """The compiled twin is among what is checked."""
    assert check_model(CameraPoint(camera), SE3) == []
    assert check_model(CameraRay(camera), SE3, example=Example(landmark=InverseDepth())) == []
    assert check_model(EpipolarRay(camera), SE3, example=Example(landmark=InverseDepth())) == []


@every_camera
def test_a_ray_is_seen_where_its_point_is(camera):
    rays = Rays.random(seed=2)
    point = CameraPoint(camera).predict(rays.state[:, None], rays.points)
    ray = CameraRay(camera).predict(rays.state[:, None], rays.mean, rays.const)
    np.testing.assert_allclose(ray, point, rtol=1e-12)
    np.testing.assert_allclose(
        point, camera.project(SE3.inverse_transform(rays.state[:, None], rays.points)), rtol=1e-13
    )


@every_camera
def test_at_infinity_only_rotation_counts(camera):
    rays = Rays.random(seed=3)
    far = rays.mean * [1.0, 1.0, 0.0]
    model = CameraRay(camera)
    seen = model.predict(rays.state[:, None], far, rays.const)
    shifted = rays.state + np.array([0.0, 0.0, 0.0, 0.0, 5.0, -3.0, 9.0])
    np.testing.assert_allclose(model.predict(shifted[:, None], far, rays.const), seen, rtol=1e-9)
    jacobians = known(model.jacobians(rays.state[:, None], far, rays.const))
    np.testing.assert_array_equal(known(jacobians.state)[..., 3:6], 0.0)
    assert np.isfinite(known(jacobians.landmark)).all()


@every_camera
@pytest.mark.parametrize(
    "point", [[0.1, 0.2, -1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-3.0, 2.0, 1e-9], [1e-9, 0.0, -1e-9]]
)
def test_behind_the_camera_is_finite_and_far_outside(camera, point):
    identity, point = SE3.identity(), np.array(point)
    ray, anchor = np.array([0.1, -0.1, 0.5]), SE3.exp(np.array([0.0, np.pi, 0.0, *point]))
    models = (CameraPoint(camera), point, None), (CameraRay(camera), ray, anchor), (EpipolarRay(camera), ray, anchor)
    for model, landmark, const in models:
        jacobians = known(model.jacobians(identity, landmark, const))
        for part in (model.predict(identity, landmark, const), jacobians.state, jacobians.landmark):
            assert np.isfinite(known(part)).all()
        assert not model.visible(identity, landmark, const)
    side = np.linalg.norm(point[:2]) / np.linalg.norm(point)
    px = CameraPoint(PLAIN).predict(identity, point) - [319.5, 239.5]
    assert np.linalg.norm(px) >= 0.99 * 400.0 * side / MIN_DEPTH_FRACTION


@every_camera
@pytest.mark.parametrize("kind", [CameraRay, EpipolarRay])
def test_a_ray_starts_through_its_first_sighting(camera, kind):
    """In every particle's own frame, with the noise carried to (u, v) and the prior of q beside it."""
    model, state = kind(camera, rho=(0.7, 0.3)), with_velocity(Rays.random(seed=5).state)
    z = np.array([[100.0, 50.0], [400.0, 300.0]])
    cov = np.array([[[1.0, 0.3], [0.3, 2.0]], [[0.5, 0.0], [0.0, 0.5]]])
    records = model.initialise(state, z, cov)
    assert records.mean.shape == (4, 2, 3)
    np.testing.assert_array_equal(records.const, np.repeat(state[:, None, :7], 2, axis=1))
    np.testing.assert_allclose(
        CameraRay(camera).predict(state[:, None], records.mean, records.const), np.broadcast_to(z, (4, 2, 2))
    )
    np.testing.assert_array_equal(records.mean[..., 2], 0.7)
    np.testing.assert_allclose(records.cov[..., 2, 2], 0.09)
    np.testing.assert_array_equal(records.cov[..., 2, :2], 0.0)
    by_landmark = known(known(CameraRay(camera).jacobians(state[0], records.mean[0], records.const[0])).landmark)
    carried = by_landmark @ records.cov[0] @ np.swapaxes(by_landmark, -1, -2)
    np.testing.assert_allclose(carried, cov, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("rho", [(0.0, 0.5), (1.0, 0.0), (np.nan, 0.5)])
def test_bad_prior(rho):
    with pytest.raises(InputError, match="prior of the inverse depth needs a positive mean and deviation"):
        CameraRay(PLAIN, rho)
