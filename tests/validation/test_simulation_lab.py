"""The simulated laboratory: plan, drives, furniture, its twin in points, and its images."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from examples.studies.point_worlds import LabWorld, Measuring, simulate_features
from rbpf.lie import SE2, SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers import open_images
from rbpf.sensors.readers.wheel_odometry import read_wheel_odometry
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.lab import (
    DOOR_M,
    LINTEL_M,
    PARTITION_M,
    ROBOT_FROM_CAMERA,
    SIZE_M,
    LabDrive,
    TexturedLab,
    furnished,
)
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


def test_the_tour_comes_back_to_places_in_the_same_and_the_opposite_direction() -> None:
    theta, x, y = TOUR.world_from_robot[::10].T
    near = np.hypot(x[:, None] - x, y[:, None] - y) < 0.05
    later = np.subtract.outer(np.arange(len(x)), np.arange(len(x))) > 60
    turned = np.cos(theta[:, None] - theta)
    again, back = ((near & later & (turned > 0.99)).sum(axis=1) > 0, (near & later & (turned < -0.99)).sum(axis=1) > 0)
    # Metres of the tour where the robot has been before, facing the same way and the opposite one.
    way = 10.0 * TOUR.way_m[-1] / 4000.0
    assert again.sum() * way > 8.0 and back.sum() * way > 8.0
    assert (x < PARTITION_M[0]).any() and (x > PARTITION_M[1]).mean() > 0.25


@pytest.mark.parametrize("trajectory", ["tour", "turn_back"])
@pytest.mark.parametrize("seed", range(2))
def test_the_robot_touches_nothing(trajectory: str, seed: int) -> None:
    place = LabDrive(trajectory).travelled().world_from_robot[::5, 1:]  # type: ignore[arg-type]
    blocks = np.array(furnished(np.random.default_rng(seed)).blocks)
    low = blocks[blocks[:, 0, 2] < 1.5]
    gap = np.maximum(low[:, 0, :2] - place[:, None], place[:, None] - low[:, 1, :2]).clip(min=0.0)
    assert np.hypot(*np.moveaxis(gap, -1, 0)).min() > 0.6
    assert (place.min(axis=0) > 1.5).all() and (place.max(axis=0) < np.array(SIZE_M[:2]) - 1.5).all()
    in_the_wall = (place[:, 0] > PARTITION_M[0]) & (place[:, 0] < PARTITION_M[1])
    assert in_the_wall.any() == (trajectory == "tour")
    assert ((place[in_the_wall, 1] > DOOR_M[0] + 0.5) & (place[in_the_wall, 1] < DOOR_M[1] - 0.5)).all()
    assert LINTEL_M > 1.5


def test_the_renderer_sees_what_single_rays_see() -> None:
    """Thousands of rectangles, most of them hidden: no tile may drop one that is seen."""
    scene = drawn()
    renderer = Renderer(scene.rectangles, CAMERA, grid=1)
    px = np.random.default_rng(0).uniform(0.0, 1.0, (400, 2)) * [319, 239]
    px = np.round(px)
    column, row = px.astype(int).T
    assert len(scene.rectangles) > 1500
    for pose in scene.world_from_camera[::3]:
        depth, seen = renderer.depth(pose)
        expected, rows = cast(scene.rectangles, pose, CAMERA.unproject(px))
        np.testing.assert_allclose(depth[row, column], expected, rtol=1e-12)
        # Where two boxes touch, two faces are at the same place.
        assert (seen[row, column] == rows).mean() > 0.99 and np.isfinite(expected).all()


def test_the_twin_in_points_is_seen_as_the_images_are() -> None:
    """A point measured in the world of points is what a ray hits in that of images; posters hang 1 cm before walls."""
    scene, stereo = drawn(), RectifiedStereo(CAMERA, 0.12)
    world = LabWorld(LabDrive(every=400), points=4000)
    measuring = Measuring(noise_px=1e-6, measurements=150, new_per_frame=150, known=0, dropout=0.0)
    log = simulate_features(world, measuring, stereo, 0)
    assert log.truth is not None
    np.testing.assert_array_equal(log.truth.world_from_camera, scene.world_from_camera)
    for frame, pose in zip(log.frames, scene.world_from_camera, strict=True):
        points = np.array([log.truth.landmarks[name] for name in frame.landmarks.tolist()])
        local = SE3.inverse_transform(pose, points)
        depth, _ = cast(scene.rectangles, pose, CAMERA.unproject(frame.z[:, :2]))
        assert (np.abs(depth - local[:, 2]) < 0.03).mean() > 0.97
        np.testing.assert_allclose(stereo.project(local), frame.z, atol=1e-4)
        assert len(points) > 15


def test_the_folder_holds_what_the_wheels_say(tmp_path: Path) -> None:
    small = Pinhole(96, 72, 75.0, 75.0, 47.5, 35.5)
    simulate_images(TexturedLab(LabDrive(frames=9, every=6), texel_m=0.5), Imaging(known=0), small, tmp_path / "lab", 0)
    odometry = read_wheel_odometry(tmp_path / "lab")
    sequence = open_images(tmp_path / "lab")
    assert sequence.truth is not None
    assert len(odometry.stamps_ns) == 49
    np.testing.assert_array_equal(odometry.stamps_ns[::6], sequence.stamps_ns)
    np.testing.assert_allclose(odometry.robot_from_camera, ROBOT_FROM_CAMERA)
    reckoned = odometry.world_from_camera(sequence.truth.world_from_camera[0])[::6]
    apart = np.linalg.norm(reckoned[:, 4:] - sequence.truth.world_from_camera[:, 4:], axis=1)
    assert 0.0 < apart[-1] < 0.08 * TOUR.way_m[48]
