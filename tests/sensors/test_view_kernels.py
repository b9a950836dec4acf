"""The compiled choice of features in view against the camera's own methods."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.kernels import in_view
from rbpf.systems.mono.feature_table import directions

CAMERAS = {
    "plain": Pinhole(640, 480, 400.0, 410.0, 319.5, 239.5),
    "folding": Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.42, 0.21, 0.012, -0.009, -0.06)),
    "fisheye": Pinhole(640, 480, 220.0, 220.0, 320.0, 240.0, (-0.03, 0.02, -0.012, 0.002), "equidistant"),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_chosen_features_are_those_that_the_camera_sees_nearly_as_at_first(camera):
    rng, count, margin, least, most = np.random.default_rng(1), 4000, 8.0, 0.7, 2.0
    place = np.concatenate([rng.uniform(-3.0, 3.0, (count, 3)), np.ones((count, 1))], axis=1)
    place[:200, 3] = rng.uniform(0.0, 1.0, 200)
    first_pose, pose = SE3.exp(0.5 * rng.normal(size=(count, 6))), SE3.exp(0.2 * rng.normal(size=6))
    alive = rng.uniform(size=count) < 0.8
    rows, px = np.empty(count, dtype=np.int64), np.empty((count, 2))
    limits = np.array([camera.width, camera.height, margin, camera.monotonic_radius, least, most])
    found = in_view(place, first_pose, alive, pose, camera.params, limits, rows, px)

    seen = directions(place, pose)
    then = place[:, :3] - place[:, 3:] * SE3.translation(first_pose)
    now = place[:, :3] - place[:, 3:] * SE3.translation(pose)
    lengths = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
    scale, cosine = lengths[1] / lengths[0], (then * now).sum(axis=1) / (lengths[0] * lengths[1])
    wanted = alive & camera.visible(seen, margin) & (cosine >= least)
    wanted &= (scale <= most) & (scale >= 1.0 / most)
    assert 50 < wanted.sum() < count / 2
    np.testing.assert_array_equal(rows[:found], np.flatnonzero(wanted))
    np.testing.assert_allclose(px[:found], camera.project(seen[wanted]), rtol=0.0, atol=1e-9)
