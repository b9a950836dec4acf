"""The simulated laboratory: plan, drives, furniture, its twin in points, and its images."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rbpf.lie import SE2
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import open_images
from rbpf.sensors.readers.wheel_odometry import read_wheel_odometry
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.lab import ROBOT_FROM_CAMERA, LabDrive, TexturedLab
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import TexturedScene, cast

pytestmark = pytest.mark.slow

cv2 = pytest.importorskip("cv2")

CAMERA = Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)
TOUR = LabDrive().travelled()


@cache
def drawn() -> TexturedScene:
    return TexturedLab(LabDrive(every=400), texel_m=0.2).build(np.random.default_rng(0))


def test_the_tour_is_as_long_as_that_of_the_paper() -> None:
    assert len(TOUR.way_m) == 4000
    assert 67.0 < TOUR.way_m[-1] < 68.5
    step = SE2.local(TOUR.world_from_robot[:-1], TOUR.world_from_robot[1:])
    assert np.abs(step[:, 2]).max() < 1e-4
    assert np.diff(TOUR.way_m).max() < 0.02 and np.abs(step[:, 0]).max() < np.deg2rad(1.5)


def test_the_renderer_sees_what_single_rays_see() -> None:
    """Thousands of rectangles, most of them hidden: no tile may drop one that is seen."""
    scene = drawn()
    renderer = Renderer(scene.rectangles, CAMERA, grid=1)
    px = np.random.default_rng(0).uniform(0.0, 1.0, (400, 2)) * [319, 239]
    px = np.round(px)
    column, row = px.astype(int).T
    assert len(scene.rectangles) > 1500
    for pose in scene.world_from_camera[::5]:
        depth, seen = renderer.depth(pose)
        expected, rows = cast(scene.rectangles, pose, CAMERA.unproject(px))
        np.testing.assert_allclose(depth[row, column], expected, rtol=1e-12)
        # Where two boxes touch, two faces are at the same place.
        assert (seen[row, column] == rows).mean() > 0.99 and np.isfinite(expected).all()


def test_the_folder_holds_what_the_wheels_say(tmp_path: Path) -> None:
    small = Pinhole(96, 72, 75.0, 75.0, 47.5, 35.5)
    simulate_images(TexturedLab(LabDrive(frames=9, every=6), texel_m=0.5), Imaging(known=0), small, tmp_path / "lab", 0)
    odometry = read_wheel_odometry(tmp_path / "lab")
    sequence = open_images(tmp_path / "lab")
    assert sequence.truth is not None
    assert len(odometry.stamps_ns) == 49
    np.testing.assert_array_equal(odometry.stamps_ns[::6], sequence.stamps_ns)
    np.testing.assert_allclose(odometry.robot_from_camera, ROBOT_FROM_CAMERA)
    reckoned = odometry.world_from_camera(sequence.truth.poses[0])[::6]
    apart = np.linalg.norm(reckoned[:, 4:] - sequence.truth.poses[:, 4:], axis=1)
    assert 0.0 < apart[-1] < 0.08 * TOUR.way_m[48]
