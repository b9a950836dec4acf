"""The part of a ray's measurement that does not depend on its depth (E06 §5.2)."""

import numpy as np
import pytest

from rbpf.core.likelihoods import Gaussian
from rbpf.core.linearisation import information, innovation_covariance, linearise
from rbpf.core.particles import Information, Prior
from rbpf.lie import SE3
from rbpf.sensors.camera.points import CameraRay, EpipolarRay
from tests.exactness.models import known
from tests.sensors.camera_scenes import CAMERAS, Rays

every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
R = np.diag([1.7, 1.7])


def measured(rays: Rays, camera, seed: int = 1) -> np.ndarray:
    """(K, 2) as the first particle sees the rays, with noise."""
    px = CameraRay(camera).predict(rays.state[0], rays.mean[0], rays.const[0])
    return px + np.random.default_rng(seed).normal(scale=3.0, size=px.shape)


def covariances(rays: Rays, var_q: float) -> np.ndarray:
    half = np.random.default_rng(2).normal(scale=2e-3, size=(*rays.mean.shape[:2], 2, 3))
    cov = np.zeros((*rays.mean.shape[:2], 3, 3))
    cov[..., :2, :2] = half @ np.swapaxes(half, -1, -2)
    cov[..., 2, 2] = var_q
    return cov


def terms(model: CameraRay, rays: Rays, z: np.ndarray, var_q: float) -> Information:
    nu, jac = linearise(model, SE3, z, rays.state[:, None], rays.mean, rays.const)
    cov = innovation_covariance(known(jac.landmark), covariances(rays, var_q), np.broadcast_to(R, (5, 2, 2)))
    prior = Prior.exactly(SE3, rays.state)
    return information(nu, known(jac.state), cov, Gaussian(), prior)


@every_camera
def test_depth_along_the_line_does_not_matter(camera):
    """To first order in q, in every ray, while the full residual moves by pixels."""
    rays = Rays.random(seed=3)
    model, full, z = EpipolarRay(camera), CameraRay(camera), measured(rays, camera)
    before = model.innovation(z, rays.state[:, None], rays.mean, rays.const)
    by_rho = known(known(full.jacobians(rays.state[:, None], rays.mean, rays.const)).landmark)[..., 2]
    direction = by_rho / np.linalg.norm(by_rho, axis=-1, keepdims=True)
    np.testing.assert_allclose((before * direction).sum(axis=-1), 0.0, atol=1e-10)
    change, moved = {}, {}
    for step in (1e-3, 1e-4):
        nearer = rays.mean + np.array([0.0, 0.0, step])
        after = full.innovation(z, rays.state[:, None], nearer, rays.const)
        across = after - (after * direction).sum(axis=-1, keepdims=True) * direction
        change[step] = np.abs(across - before).max()
        moved[step] = np.abs(after - full.innovation(z, rays.state[:, None], rays.mean, rays.const)).max()
    assert moved[1e-3] > 0.05
    assert change[1e-3] < 0.02 * moved[1e-3]
    assert change[1e-4] < 0.02 * change[1e-3] + 1e-11


@every_camera
def test_what_is_left_is_the_distance_from_the_line(camera):
    """Its length is that of the residual's component across ∂h/∂q, and its Jacobians see no depth."""
    rays = Rays.random(seed=4)
    z, at = measured(rays, camera), (rays.state[:, None], rays.mean, rays.const)
    full = known(CameraRay(camera).jacobians(*at))
    along = known(full.landmark)[..., 2]
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1)[..., None]
    y = (normal * CameraRay(camera).innovation(z, *at)).sum(axis=-1)
    found = EpipolarRay(camera).innovation(z, *at)
    np.testing.assert_allclose(found, y[..., None] * normal, atol=1e-9)
    projected = known(EpipolarRay(camera).jacobians(*at))
    np.testing.assert_allclose(known(projected.landmark)[..., 2], 0.0, atol=1e-9)
    row = (normal[..., None, :] @ known(full.state))[..., 0, :]
    np.testing.assert_allclose(known(projected.state), normal[..., None] * row[..., None, :], atol=1e-8)


@every_camera
def test_limit_of_the_marginal_with_unknown_depth(camera):
    """Λ and η tend to the epipolar constraint's as P_qq → ∞, with an error that falls as 1/P_qq."""
    rays = Rays.random(seed=5)
    z = measured(rays, camera)
    limit = terms(EpipolarRay(camera), rays, z, 0.25)
    scale_info, scale_vector = np.abs(limit.info).max(), np.abs(limit.vector).max()
    errors = []
    for var_q in (1.0, 1e2, 1e4):
        marginal = terms(CameraRay(camera), rays, z, var_q)
        by_info = np.abs(marginal.info - limit.info).max() / scale_info
        errors.append([by_info, np.abs(marginal.vector - limit.vector).max() / scale_vector])
    assert min(errors[0]) > 1e-5
    np.testing.assert_allclose(errors[1], 1e-2 * np.array(errors[0]), rtol=0.05)
    np.testing.assert_allclose(errors[2], 1e-4 * np.array(errors[0]), rtol=0.3)
    again = terms(EpipolarRay(camera), rays, z, 1e6)
    np.testing.assert_allclose(again.info, limit.info, rtol=1e-7, atol=1e-9 * scale_info)
