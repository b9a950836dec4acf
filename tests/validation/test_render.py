"""Rendered pictures: geometry to a part of a pixel, depth, occlusion, filtering, consistency between views."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.calibration import Board
from rbpf.sensors.camera import Pinhole
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import Rectangle, cast
from rbpf.validation.simulation.textures import clouds, grey_levels

CAMERA = Pinhole(160, 120, 110.0, 108.0, 78.0, 61.5)
DISTORTED = replace(CAMERA, distortion=(-0.28, 0.07, 1e-3, -5e-4, 0.01))
FISHEYE = Pinhole(160, 120, 66.0, 66.0, 78.0, 61.5, (-0.03, 0.02, -0.012, 0.002), "equidistant")
AXES = np.eye(3)
DESK = TexturedDesk(frames=12, texel_m=0.008, board=(7, 5), square_m=0.1)


def facing(distance: float, size: float, texture: np.ndarray) -> Rectangle:
    """A square that faces a camera at the origin."""
    corner = np.array([-0.5 * size, -0.5 * size, distance])
    return Rectangle(corner, size * AXES[0], size * AXES[1], texture)


def noise(side: int, seed: int = 0) -> np.ndarray:
    return grey_levels(128.0 + 30.0 * clouds((side, side), np.random.default_rng(seed)))


def squares(
    board: Board, world_from_board: np.ndarray, camera: Pinhole, pose: np.ndarray, px: np.ndarray
) -> np.ndarray:
    """Grey levels (…) of a chessboard at pixels (…, 2), from the board's definition alone."""
    ray = np.concatenate([camera.unproject(px), np.ones((*px.shape[:-1], 1))], axis=-1)
    board_from_camera = SE3.compose(SE3.inverse(world_from_board), pose)
    eye = board_from_camera[4:]
    turned = SE3.transform(board_from_camera, ray) - eye
    place = eye - eye[2] / turned[..., 2:] * turned
    cell = np.floor(place[..., :2] / board.square_m).sum(axis=-1) % 2
    return np.where(cell == 0, 20.0, 235.0)


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED, replace(FISHEYE, fx=110.0, fy=108.0)])
def test_corners_are_seen_where_opencv_projects_them(camera: Pinhole) -> None:
    """A window about each corner is registered (least squares) to the mean of 9 × 9 exact rays per pixel."""
    cv2 = pytest.importorskip("cv2")
    scene = DESK.build(np.random.default_rng(5))
    board, lies = scene.boards[0]
    renderer = Renderer(scene.rectangles, camera)
    around = np.stack(np.meshgrid(np.arange(-5.0, 6.0), np.arange(-5.0, 6.0)), axis=-1)
    within = np.stack(np.meshgrid(*[(np.arange(9) - 4.0) / 9.0] * 2), axis=-1)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    for pose in scene.world_from_camera[-1:]:
        image = renderer.image(pose)
        points = SE3.inverse_transform(pose, SE3.transform(lies, board.corners))
        project = cv2.fisheye.projectPoints if camera.distortion_model == "equidistant" else cv2.projectPoints
        none, distortion = np.zeros((3, 1)), np.array(camera.distortion)
        seen = project(points[:, None], none, none, matrix, distortion)[0].reshape(-1, 2)
        for corner in seen:
            px = np.round(corner) + around
            exact = squares(board, lies, camera, pose, px[:, :, None, None] + within).mean(axis=(2, 3))
            down, across = np.gradient(exact)
            slope = np.stack([across, down], axis=-1)[1:-1, 1:-1].reshape(-1, 2)
            column, row = np.moveaxis(px.astype(int)[1:-1, 1:-1], -1, 0)
            shift, *_ = np.linalg.lstsq(slope, (exact[1:-1, 1:-1] - image[row, column]).ravel(), rcond=None)
            assert np.abs(shift).max() < 0.05


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED, FISHEYE])
@pytest.mark.parametrize("size", [0.1, 1.0])
def test_the_nearest_of_many_rectangles_is_seen(camera: Pinhole, size: float) -> None:
    """Also of those that reach behind the camera; the reference casts each ray at each rectangle."""
    rng = np.random.default_rng(0)
    reach = size * np.array([[4.0], [1.5], [1.5]])
    places = reach * rng.uniform(-1.0, 1.0, (150, 3, 3))
    sheets = [Rectangle(corner, across, down, noise(8)) for corner, across, down in places]
    pose = SE3.exp(rng.normal(size=6) * [1.0, 1.0, 1.0, size, size, size])
    depth, rows = Renderer(sheets, camera).depth(pose)
    px = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1)
    expected, expected_rows = cast(sheets, pose, camera.unproject(px).reshape(-1, 2))
    assert len(set(rows.ravel().tolist())) > 8
    np.testing.assert_array_equal(rows.ravel(), expected_rows)
    np.testing.assert_allclose(depth.ravel(), expected, rtol=1e-9)


def test_pixels_without_a_ray_and_rays_without_a_rectangle_are_black() -> None:
    folded = replace(CAMERA, fx=40.0, fy=40.0, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    white = np.full((4, 4), 255, dtype=np.uint8)
    nowhere = np.isnan(folded.unproject(np.array([0.0, 0.0]))).any()
    image = Renderer([facing(1.0, 50.0, white)], folded).image(SE3.identity())
    assert nowhere and image[0, 0] == 0.0 and image[60, 80] == 255.0
    image = Renderer([facing(1.0, 0.5, white)], CAMERA).image(SE3.identity())
    assert image[0, 0] == 0.0 and image[60, 80] == 255.0


def test_a_distant_texture_is_averaged() -> None:
    """Texels of 0 and 255 in turn, seven to a pixel: without filtering the picture would be full of moiré."""
    checker = (255 * (np.indices((1024, 1024)).sum(axis=0) % 2)).astype(np.uint8)
    inner = Renderer([facing(2.0, 4.0, checker)], CAMERA).image(SE3.identity())[30:90, 40:120]
    np.testing.assert_allclose(inner, 127.5, atol=1.5)


def test_a_near_texture_is_interpolated() -> None:
    """Between two texels' centres the grey level rises evenly."""
    step = np.array([[50, 150], [50, 150]], dtype=np.uint8)
    camera = replace(CAMERA, fx=100.0, fy=100.0)
    row = Renderer([facing(1.0, 1.6, step)], camera).image(SE3.identity())[60]
    inside = np.arange(40, 117)
    expected = 50.0 + 100.0 * ((inside - camera.cx) / 160.0 + 0.25) * 2.0
    np.testing.assert_allclose(row[inside], np.clip(expected, 50.0, 150.0), atol=0.7)


@pytest.mark.parametrize("grid", [1, 2, 3])
def test_an_edge_covers_its_share_of_the_pixel(grid: int) -> None:
    white = np.full((4, 4), 200, dtype=np.uint8)
    fractions, rays = np.linspace(0.05, 0.95, 10), grid * grid
    for fraction in fractions:
        edge = (80.0 - 0.5 + fraction - CAMERA.cx) / CAMERA.fx
        sheet = Rectangle(np.array([edge - 2.0, -2.0, 1.0]), 2.0 * AXES[0], 4.0 * AXES[1], white)
        row = Renderer([sheet], CAMERA, grid).image(SE3.identity())[60]
        assert row[79] == 200.0 and row[81] == 0.0
        assert abs(row[80] / 200.0 - fraction) <= 0.5 / rays + 1e-6
