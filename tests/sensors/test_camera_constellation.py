"""Several known points at once, which share the pose of their frame."""

import numpy as np
import pytest

from rbpf.conformance import Example, check_model
from rbpf.lie import SE3, Euclidean, Product
from rbpf.maps.constellation import Constellation
from rbpf.models import Records
from rbpf.numeric import numeric_jacobians
from rbpf.sensors.camera_constellation import ConstellationView
from rbpf.sensors.camera_points import CameraPoint
from tests.exactness.models import known
from tests.sensors.camera_scenes import DISTORTED, PLAIN, with_velocity

POINTS = np.random.default_rng(0).uniform([-0.5, -0.4, -0.3], [0.5, 0.4, 0.3], size=(4, 3))
COVS = np.tile(1e-4 * np.eye(3), (4, 1, 1))
SEEN = np.array([2, 0, 3])
every_camera = pytest.mark.parametrize("camera", [PLAIN, DISTORTED], ids=["plain", "distorted"])
every_group = pytest.mark.parametrize("errors", [False, True], ids=["exact", "errors"])


def scene(errors: bool, turn: float = 0.7, seed: int = 0):
    """Five particles 2.5 m in front of the group: states, landmarks with one axis of landmarks, constants."""
    rng = np.random.default_rng(seed)
    const = SE3.exp(rng.normal(size=(5, 1, 6)))
    xi = rng.normal(scale=turn, size=(5, 1, 6))
    state = SE3.retract(SE3.retract(const, xi), np.array([0.0, 0.0, 0.0, 0.0, 0.0, -2.5]))
    state = SE3.retract(state, rng.normal(scale=0.1, size=(5, 1, 6)))
    mean = np.concatenate([xi, rng.normal(scale=0.02, size=(5, 1, 12 if errors else 0))], axis=-1)
    return state, mean, const


def view(camera, errors: bool) -> ConstellationView:
    return ConstellationView(camera, POINTS[SEEN], SEEN if errors else None)


@every_group
@every_camera
def test_sound_model(camera, errors):
    state, mean, const = scene(errors)
    group = Constellation(POINTS, COVS if errors else 0.0 * COVS)
    cov = np.tile(np.eye(group.dim), (5, 1, 1, 1))
    example = Example(state=state[:, 0], landmark=group, records=Records(mean, cov, const))
    assert check_model(view(camera, errors), SE3, example=example) == []


@every_group
@every_camera
@pytest.mark.parametrize("turn", [0.0, 1e-5, 0.7, 2.0])
def test_jacobians_are_the_numeric_ones(camera, errors, turn):
    state, mean, const = scene(errors, turn)
    found = known(view(camera, errors).jacobians(with_velocity(state), mean, const))
    space = Product(SE3, Euclidean(6))
    expected = numeric_jacobians(view(camera, errors), space, with_velocity(state), mean, const)
    np.testing.assert_allclose(known(found.state), known(expected.state), rtol=1e-6, atol=2e-5)
    np.testing.assert_allclose(known(found.landmark), known(expected.landmark), rtol=1e-6, atol=2e-5)


@every_group
@every_camera
def test_the_points_are_seen_one_after_the_other(camera, errors):
    state, mean, const = scene(errors)
    px = view(camera, errors).predict(state, mean, const)
    assert px.shape == (5, 1, 6)
    errors_of = mean[:, 0, 6:].reshape(5, -1, 3)
    for k, m in enumerate(SEEN):
        place = POINTS[m] + (errors_of[:, m] if errors else 0.0)
        world = SE3.transform(SE3.compose(const, SE3.exp(mean[..., :6]))[:, 0], place)
        expected = CameraPoint(camera).predict(state[:, 0], world)
        np.testing.assert_allclose(px[:, 0, 2 * k : 2 * k + 2], expected, rtol=1e-12)


def test_visible_where_all_points_are():
    """While the camera turns away the points leave the image one after the other."""
    state, mean, const = scene(False, seed=1)
    turned = SE3.retract(state, np.linspace(0.0, 1.0, 30)[:, None, None, None] * np.eye(6)[1])
    in_camera = SE3.inverse_transform(
        turned[..., None, :], SE3.transform(SE3.retract(const, mean)[..., None, :], POINTS[SEEN])
    )
    expected = PLAIN.visible(in_camera)
    assert (expected.any(axis=-1) & ~expected.all(axis=-1)).any()
    seen = view(PLAIN, False).visible(turned, mean, const)
    assert seen.dtype == bool and seen[0].all()
    np.testing.assert_array_equal(seen, expected.all(axis=-1))
