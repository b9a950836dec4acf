"""Printed boards are found where they were drawn, and the camera that rendered them is found again."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors import calibration
from rbpf.sensors.camera import Pinhole
from tests.sensors.board_pictures import BOARD, CAMERA, FISHEYE, directions, nearby, pictures

TEXELS, MARGIN = 40, 60


def printed(columns: int, rows: int) -> np.ndarray:
    """Squares, the first one black, in a white margin."""
    row, column = np.indices((rows + 1, columns + 1))
    cells = np.where((row + column) % 2 == 0, 20, 235).astype(np.uint8)
    sheet = cells.repeat(TEXELS, axis=0).repeat(TEXELS, axis=1)
    return np.pad(sheet, MARGIN, constant_values=235)


def taken(sheet: np.ndarray, homography: np.ndarray, around: int) -> np.ndarray:
    """An image of 640 × 480 px, finely sampled."""
    fine = np.array([[4.0, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    large = cv2.warpPerspective(sheet, fine @ homography, (2560, 1920), borderValue=around)
    return cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA)


def seen(board: calibration.Board, homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image, and where the inner corners (rows · columns, 2) are in it."""
    image = taken(printed(board.columns, board.rows), homography, 120)
    # Texel (i, j) has its centre at whole numbers, so that the edge between two squares lies half a texel before.
    texel = MARGIN + TEXELS * (board.corners[:, :2] / board.square_m + 1.0) - 0.5
    px = cv2.perspectiveTransform(texel[None], homography)[0]
    noise = np.random.default_rng(0).normal(0.0, 2.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8), px


def view(turn_deg: float, scale: float = 0.7, tilt: float = 2e-4) -> np.ndarray:
    """A homography that turns the sheet about the middle of the image, and tilts it."""
    c, s = scale * np.cos(np.deg2rad(turn_deg)), scale * np.sin(np.deg2rad(turn_deg))
    middle = np.array([[1.0, 0, -260], [0, 1, -200], [0, 0, 1]])
    turned = np.array([[c, -s, 320], [s, c, 240], [0, 0, 1]])
    leaning = np.array([[1.0, 0, 0], [0, 1, 0], [tilt, 0.5 * tilt, 1]])
    return turned @ leaning @ middle


@pytest.mark.parametrize("turn_deg", [0.0, 40.0, 180.0, 250.0])
def test_corners_are_found_to_a_tenth_of_a_pixel_in_the_board_s_own_order(turn_deg):
    image, px = seen(BOARD, view(turn_deg))
    found = calibration.find_board(image, BOARD)
    assert found.own_frame and found.names.size == calibration.MOST
    np.testing.assert_allclose(found.px, px[found.names], atol=0.1)
    np.testing.assert_array_equal(found.positions, BOARD.corners[found.names])
    assert not found.std_m.any()


def test_the_chosen_corners_hold_the_outer_ones_and_are_apart():
    chosen = calibration.spread_rows(BOARD.corners, calibration.MOST)
    assert {0, 8, 45, 53} <= set(chosen.tolist()) and chosen.size == calibration.MOST
    points = BOARD.corners[chosen]
    distance = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(calibration.MOST, 1)]
    assert distance.min() > 1.9 * BOARD.square_m
    assert calibration.spread_rows(BOARD.corners[:4], calibration.MOST).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("image", ["flat", "cut off", "another board"])
def test_what_is_no_such_board_is_refused(image):
    pictures = {
        "flat": np.full((480, 640), 128, dtype=np.uint8),
        "cut off": seen(BOARD, np.array([[1.0, 0, 300], [0, 1, 0], [0, 0, 1]]))[0],
        "another board": seen(calibration.Board(7, 5, 0.03), view(0.0))[0],
    }
    with pytest.raises(InputError, match="no chessboard of 9x6 inner corners is detected in the first image"):
        calibration.find_board(pictures[image], BOARD)


@pytest.mark.parametrize(
    ("kind", "numbers", "words"),
    [
        (calibration.Board, ("9", 0.02), "inner corners as 9x6"),
        (calibration.Board, ("9x-6", 0.02), "inner corners as 9x6"),
        (calibration.Board, ("9x2", 0.02), "at least 3x3"),
        (calibration.Board, ("9x6", 0.0), "square_m must be above 0"),
        (calibration.MarkerBoard, ("5", 0.04, 0.01, "4x4_50"), "their number as 5x7"),
        (calibration.MarkerBoard, ("4x3", 0.0, 0.01, "4x4_50"), "side_m must be above 0"),
        (calibration.MarkerBoard, ("4x3", 0.04, -0.01, "4x4_50"), "gap_m must be at least 0"),
        (calibration.MarkerBoard, ("4x3", 0.04, 0.01, "9x9_50"), "no dictionary"),
    ],
)
def test_a_board_that_makes_no_sense(kind, numbers, words):
    with pytest.raises(InputError, match=words):
        kind.parse(*numbers)


def test_sizes_as_people_write_them():
    assert calibration.Board.parse(" 9X6", 0.024) == calibration.Board.parse("9×6", 0.024) == BOARD


MARKERS = calibration.MarkerBoard(4, 3, 0.04, 0.01, "4X4_50")
TEXELS_PER_M = 2000.0


def printed_markers() -> np.ndarray:
    """The board as OpenCV prints it."""
    patterns = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.GridBoard((MARKERS.columns, MARKERS.rows), MARKERS.side_m, MARKERS.gap_m, patterns)
    size = [round(TEXELS_PER_M * (n * 0.05 - 0.01)) + 2 * MARGIN for n in (MARKERS.columns, MARKERS.rows)]
    return board.generateImage(size, marginSize=MARGIN)


def seen_markers(homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image, and where all corners (12, 4, 2) are in it."""
    texels = MARGIN + TEXELS_PER_M * MARKERS.corners[..., :2] - 0.5
    px = cv2.perspectiveTransform(texels.reshape(1, -1, 2), homography).reshape(-1, 4, 2)
    return cv2.GaussianBlur(taken(printed_markers(), homography, 200), (0, 0), 0.7), px


def test_corners_are_those_of_opencvs_board():
    patterns = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    theirs = cv2.aruco.GridBoard((4, 3), 0.04, 0.01, patterns).getObjPoints()
    np.testing.assert_allclose(MARKERS.corners, np.array(theirs), atol=1e-7)


@pytest.mark.parametrize("turn_deg", [0.0, 40.0, 180.0])
def test_markers_are_found_whatever_way_the_board_is_turned(turn_deg):
    image, px = seen_markers(view(turn_deg, 1.0))
    found = calibration.find_markers(image, MARKERS)
    assert found.own_frame and found.names.size == 12 and not found.std_m.any()
    marker, corner = np.divmod(found.names, 4)
    np.testing.assert_allclose(found.px, px[marker, corner], atol=0.5)
    np.testing.assert_array_equal(found.positions, MARKERS.corners[marker, corner])


def test_part_of_the_board_is_enough():
    image, px = seen_markers(np.array([[1.0, 0, 330], [0, 1, 0], [0, 0, 1]]) @ view(0.0, 1.0))
    found = calibration.find_markers(image, MARKERS)
    marker, corner = np.divmod(found.names, 4)
    assert 1 <= np.unique(marker).size < 12
    np.testing.assert_allclose(found.px, px[marker, corner], atol=0.5)


def test_what_is_no_such_board_of_markers_is_refused():
    with pytest.raises(InputError, match="no marker of a board of 4x3 from 4X4_50"):
        calibration.find_markers(np.full((480, 640), 128, dtype=np.uint8), MARKERS)
    with pytest.raises(InputError, match="no marker of a board of 4x3 from 6X6_50"):
        calibration.find_markers(seen_markers(view(0.0, 1.0))[0], calibration.MarkerBoard(4, 3, 0.04, 0.01, "6X6_50"))
    small = np.diag([0.12, 0.12, 1.0])
    with pytest.raises(InputError, match=r"start closer|no marker"):
        calibration.find_markers(seen_markers(small)[0], MARKERS)


SIZE = CAMERA.width, CAMERA.height
CORNERS = BOARD.corners * [1.0, -1.0, -1.0] + [-4 * BOARD.square_m, 2.5 * BOARD.square_m, 0.0]


def exact_views(camera: Pinhole, poses: np.ndarray, noise_px: float, seed: int = 0) -> list[calibration.BoardView]:
    """Where the corners are, without images, with noise."""
    rng = np.random.default_rng(seed)
    views = []
    for k, pose in enumerate(poses):
        px = camera.project(SE3.inverse_transform(pose, CORNERS))
        views.append(calibration.BoardView(f"{k}.png", px + rng.normal(0.0, noise_px, px.shape)))
    return views


def seen_whole(camera: Pinhole, noise_px: float, seed: int = 0) -> list[calibration.BoardView]:
    """Those views from near by that show the whole board to a fisheye camera."""
    poses = nearby(20)
    seen = camera.visible(SE3.inverse_transform(poses[:, None], CORNERS)).all(axis=1)
    return exact_views(camera, poses[seen], noise_px, seed)


@pytest.mark.slow
def test_rendered_boards_give_the_camera_that_rendered_them():
    found = [calibration.board_corners(image, BOARD) for image in pictures()]
    views = [calibration.BoardView(str(k), px) for k, px in enumerate(found) if px is not None]
    assert len(views) >= 10
    result = calibration.calibrate(views, BOARD, *SIZE)
    assert result.rms_px < 0.08
    # Without k3, which these images do not need; corners of rendered images have small common errors.
    error = np.abs(result.camera.params - CAMERA.params)
    assert result.std[8] == 0.0 and (error[:8] < 4.0 * result.std[:8]).all()
    assert (error[:4] < 0.5).all()


@pytest.mark.slow
def test_rendered_boards_give_the_fisheye_that_rendered_them():
    found = [calibration.board_corners(image, BOARD) for image in pictures(20, FISHEYE)]
    views = [calibration.BoardView(str(k), px) for k, px in enumerate(found) if px is not None]
    assert len(views) >= 12
    result = calibration.calibrate(views, BOARD, *SIZE, "equidistant")
    assert result.camera.distortion_model == "equidistant" and result.covered > 0.6 and result.rms_px < 0.08
    # Corners so near and so tilted have small common errors, which the standard deviations know nothing of.
    assert (np.abs(result.camera.params - FISHEYE.params)[:4] < 0.5).all()
    angle, around = np.meshgrid(np.deg2rad(np.arange(0.0, 66.0, 5.0)), np.linspace(0.0, 6.3, 12))
    rays = np.stack([np.tan(angle) * np.cos(around), np.tan(angle) * np.sin(around), np.ones_like(angle)], axis=-1)
    assert np.linalg.norm(result.camera.project(rays) - FISHEYE.project(rays), axis=-1).max() < 0.5
    # Its middle is a pinhole's with barrel distortion, its borders are not.
    assert calibration.calibrate(views, BOARD, *SIZE).rms_px > 0.5


def test_errors_are_those_that_the_standard_deviations_tell():
    normalised = []
    for seed in range(8):
        result = calibration.calibrate(exact_views(CAMERA, directions(12), 0.2, seed), BOARD, *SIZE)
        normalised.append((result.camera.params - CAMERA.params)[:4] / result.std[:4])
    # 32 squares of unit normals, correlated within a run: their mean is 1 within a half.
    assert 0.4 < np.square(normalised).mean() < 1.9


@pytest.mark.parametrize(
    ("distortion", "count"),
    [
        ((0.0, 0.0, 0.0, 0.0, 0.0), 0), ((-0.2, 0.05, 0.0, 0.0, 0.0), 2), ((-0.25, 0.1, 0.002, -0.001, 0.0), 4),
        ((0.0,) * 4, 0), ((-0.05, 0.02, 0.0, 0.0), 2), (FISHEYE.distortion, 4),
    ],
)  # fmt: skip
def test_no_more_distortion_is_told_than_there_is(distortion, count):
    """Of a pinhole camera, with five numbers, and of a fisheye, with four."""
    if len(distortion) == 5:
        camera = Pinhole(*SIZE, 500.0, 500.0, 319.5, 239.5, distortion)
        result = calibration.calibrate(exact_views(camera, directions(15), 0.1), BOARD, *SIZE)
    else:
        camera = replace(FISHEYE, distortion=distortion)
        result = calibration.calibrate(seen_whole(camera, 0.02), BOARD, *SIZE, "equidistant")
        np.testing.assert_allclose(result.camera.params[:8], camera.params[:8], rtol=0, atol=0.1)
    assert np.count_nonzero(result.camera.distortion) == count == np.count_nonzero(result.std[4:])


def test_a_view_that_fits_no_camera_is_left_out():
    views = exact_views(CAMERA, directions(12), 0.1)
    spoilt = views[4].px + np.random.default_rng(1).normal(0.0, 6.0, views[4].px.shape)
    views[4] = calibration.BoardView("bent.png", spoilt)
    result = calibration.calibrate(views, BOARD, *SIZE)
    assert result.left_out == ("bent.png",) and result.rms_px < 0.2


@pytest.mark.parametrize("turned", [0, None])
def test_views_from_one_direction_are_refused(turned):
    """Straight from above at three heights, focal length and height are one; a single tilt says little more."""
    poses = directions(3)[:1] if turned == 0 else np.tile(SE3.from_matrix(np.diag([1.0, -1, -1, 1])), (3, 1))
    poses = np.repeat(poses, 9 // len(poses), axis=0)
    if turned is None:
        poses[:, 6] = np.linspace(0.25, 0.35, len(poses))
    with pytest.raises(InputError, match="from too similar directions"):
        calibration.calibrate(exact_views(CAMERA, poses, 0.2), BOARD, *SIZE)
