"""The camera that rendered the boards is found again, within what its standard deviations say."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.calibration import BoardView, board_corners, calibrate
from rbpf.sensors.camera import Pinhole
from tests.sensors.board_pictures import BOARD, CAMERA, FISHEYE, directions, nearby, pictures

SIZE = CAMERA.width, CAMERA.height


def exact_views(camera: Pinhole, poses: np.ndarray, noise_px: float, seed: int = 0) -> list[BoardView]:
    """Where the corners are, without images, with noise."""
    rng = np.random.default_rng(seed)
    corners = BOARD.corners * [1.0, -1.0, -1.0] + [-4 * BOARD.square_m, 2.5 * BOARD.square_m, 0.0]
    views = []
    for k, pose in enumerate(poses):
        px = camera.project(SE3.inverse_transform(pose, corners))
        views.append(BoardView(f"{k}.png", px + rng.normal(0.0, noise_px, px.shape)))
    return views


def seen_whole(camera: Pinhole, noise_px: float, seed: int = 0) -> list[BoardView]:
    """Those views from near by that show the whole board to a fisheye camera."""
    poses = nearby(20)
    corners = BOARD.corners * [1.0, -1.0, -1.0] + [-4 * BOARD.square_m, 2.5 * BOARD.square_m, 0.0]
    seen = camera.visible(SE3.inverse_transform(poses[:, None], corners)).all(axis=1)
    return exact_views(camera, poses[seen], noise_px, seed)


@pytest.mark.slow
def test_rendered_boards_give_the_camera_that_rendered_them():
    found = [board_corners(image, BOARD) for image in pictures()]
    views = [BoardView(str(k), px) for k, px in enumerate(found) if px is not None]
    assert len(views) >= 10
    result = calibrate(views, BOARD, *SIZE)
    assert result.rms_px < 0.08
    # Without k3, which these images do not need; corners of rendered images have small common errors.
    error = np.abs(result.camera.params - CAMERA.params)
    assert result.std[8] == 0.0
    assert (error[:8] < 4.0 * result.std[:8]).all()
    assert (error[:4] < 0.5).all()


@pytest.mark.slow
def test_rendered_boards_give_the_fisheye_that_rendered_them():
    found = [board_corners(image, BOARD) for image in pictures(20, FISHEYE)]
    views = [BoardView(str(k), px) for k, px in enumerate(found) if px is not None]
    assert len(views) >= 12
    result = calibrate(views, BOARD, *SIZE, "equidistant")
    assert result.camera.distortion_model == "equidistant" and result.covered > 0.6
    assert result.rms_px < 0.08
    # Corners so near and so tilted have small common errors, which the standard deviations know nothing of.
    assert (np.abs(result.camera.params - FISHEYE.params)[:4] < 0.5).all()
    angle, around = np.meshgrid(np.deg2rad(np.arange(0.0, 66.0, 5.0)), np.linspace(0.0, 6.3, 12))
    rays = np.stack([np.tan(angle) * np.cos(around), np.tan(angle) * np.sin(around), np.ones_like(angle)], axis=-1)
    assert np.linalg.norm(result.camera.project(rays) - FISHEYE.project(rays), axis=-1).max() < 0.5
    # Its middle is a pinhole's with barrel distortion, its borders are not.
    assert calibrate(views, BOARD, *SIZE).rms_px > 0.5


@pytest.mark.parametrize(
    ("distortion", "count"), [((0.0,) * 4, 0), ((-0.05, 0.02, 0.0, 0.0), 2), (FISHEYE.distortion, 4)]
)
def test_no_more_distortion_of_a_fisheye_is_told_than_there_is(distortion, count):
    camera = replace(FISHEYE, distortion=distortion)
    result = calibrate(seen_whole(camera, 0.02), BOARD, *SIZE, "equidistant")
    assert np.count_nonzero(result.camera.distortion) == count == np.count_nonzero(result.std[4:])
    np.testing.assert_allclose(result.camera.params[:8], camera.params[:8], rtol=0, atol=0.1)


def test_errors_are_those_that_the_standard_deviations_tell():
    normalised = []
    for seed in range(8):
        result = calibrate(exact_views(CAMERA, directions(12), 0.2, seed), BOARD, *SIZE)
        normalised.append((result.camera.params - CAMERA.params)[:4] / result.std[:4])
    # 32 squares of unit normals, correlated within a run: their mean is 1 within a half.
    assert 0.4 < np.square(normalised).mean() < 1.9


@pytest.mark.parametrize(
    ("distortion", "count"),
    [((0.0, 0.0, 0.0, 0.0, 0.0), 0), ((-0.2, 0.05, 0.0, 0.0, 0.0), 2), ((-0.25, 0.1, 0.002, -0.001, 0.0), 4)],
)
def test_no_more_distortion_is_told_than_there_is(distortion, count):
    camera = Pinhole(*SIZE, 500.0, 500.0, 319.5, 239.5, distortion)
    result = calibrate(exact_views(camera, directions(15), 0.1), BOARD, *SIZE)
    assert np.count_nonzero(result.camera.distortion) == count


def test_a_view_that_fits_no_camera_is_left_out():
    views = exact_views(CAMERA, directions(12), 0.1)
    spoilt = views[4].px + np.random.default_rng(1).normal(0.0, 6.0, views[4].px.shape)
    views[4] = BoardView("bent.png", spoilt)
    result = calibrate(views, BOARD, *SIZE)
    assert result.left_out == ("bent.png",)
    assert result.rms_px < 0.2


def test_too_few_views_and_views_that_are_all_alike():
    views = exact_views(CAMERA, directions(4), 0.1)
    with pytest.raises(InputError, match="found in 4 images, expected at least 5"):
        calibrate(views, BOARD, *SIZE)


@pytest.mark.parametrize("turned", [0, None])
def test_views_from_one_direction_are_refused(turned):
    """Straight from above at three heights, focal length and height are one; a single tilt says little more."""
    poses = directions(3)[:1] if turned == 0 else np.tile(SE3.from_matrix(np.diag([1.0, -1, -1, 1])), (3, 1))
    poses = np.repeat(poses, 9 // len(poses), axis=0)
    if turned is None:
        poses[:, 6] = np.linspace(0.25, 0.35, len(poses))
    with pytest.raises(InputError, match="from too much the same direction"):
        calibrate(exact_views(CAMERA, poses, 0.2), BOARD, *SIZE)
