"""Several known points at once, which share the pose of their frame."""

import numpy as np
import pytest

from rbpf.conformance import Example, check_model
from rbpf.core.models import Records
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation, UncertainConstellation
from rbpf.sensors.camera.points import ConstellationView, MembersView
from tests.sensors.camera_scenes import CAMERAS, PLAIN

POINTS = np.random.default_rng(0).uniform([-0.5, -0.4, -0.3], [0.5, 0.4, 0.3], size=(4, 3))
COVS = np.tile(1e-4 * np.eye(3), (4, 1, 1))
SEEN = np.array([2, 0, 3])
every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
every_group = pytest.mark.parametrize("errors", [False, True], ids=["exact", "errors"])


def scene(errors: bool, turn: float = 0.7, seed: int = 0):
    """Five particles 2.5 m in front of the group: states, landmarks with one axis of landmarks, constants."""
    rng = np.random.default_rng(seed)
    const = SE3.exp(rng.normal(size=(5, 1, 6)))
    xi = rng.normal(scale=turn, size=(5, 1, 6))
    frame = SE3.retract(const, xi)
    state = SE3.retract(frame, np.array([0.0, 0.0, 0.0, 0.0, 0.0, -2.5]))
    state = SE3.retract(state, rng.normal(scale=0.1, size=(5, 1, 6)))
    if not errors:
        return state, xi, const
    points = SE3.transform(frame[..., None, :], POINTS + rng.normal(scale=0.02, size=(5, 1, 4, 3)))
    return state, points.reshape(5, 1, 12), None


def view(camera, errors: bool) -> ConstellationView | MembersView:
    return MembersView(camera, SEEN) if errors else ConstellationView(camera, POINTS[SEEN])


def seen_in_world(errors: bool, mean, const) -> np.ndarray:
    if errors:
        return mean.reshape(5, 1, 4, 3)[:, :, SEEN]
    return SE3.transform(SE3.retract(const, mean)[..., None, :], POINTS[SEEN])


@every_group
@every_camera
@pytest.mark.parametrize("turn", [1e-5, 0.7, 2.0])
def test_sound_model(camera, errors, turn):
    state, mean, const = scene(errors, turn)
    group = UncertainConstellation(POINTS, COVS) if errors else Constellation(POINTS)
    cov = np.tile(np.eye(group.dim), (5, 1, 1, 1))
    example = Example(state=state[:, 0], landmark=group, records=Records(mean, cov, const))
    assert check_model(view(camera, errors), SE3, example=example) == []


@every_group
def test_visible_where_all_points_are(errors):
    """While the camera turns away the points leave the image one after the other."""
    state, mean, const = scene(errors, seed=1)
    turned = SE3.retract(state, np.linspace(0.0, 1.0, 30)[:, None, None, None] * np.eye(6)[1])
    in_camera = SE3.inverse_transform(turned[..., None, :], seen_in_world(errors, mean, const))
    expected = PLAIN.visible(in_camera)
    assert (expected.any(axis=-1) & ~expected.all(axis=-1)).any()
    seen = view(PLAIN, errors).visible(turned, mean, const)
    assert seen.dtype == bool and seen[0].all()
    np.testing.assert_array_equal(seen, expected.all(axis=-1))
