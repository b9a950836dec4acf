"""Printed boards are found where they were drawn, in one frame whatever way they are turned."""

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.calibration import MOST, Board, MarkerBoard, find_board, find_markers, spread_rows

BOARD = Board(9, 6, 0.024)
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


def seen(board: Board, homography: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    found = find_board(image, BOARD)
    assert found.own_frame and found.names.size == MOST
    np.testing.assert_allclose(found.px, px[found.names], atol=0.1)
    np.testing.assert_array_equal(found.positions, BOARD.corners[found.names])
    assert not found.std_m.any()


def test_the_chosen_corners_hold_the_outer_ones_and_are_apart():
    chosen = spread_rows(BOARD.corners, MOST)
    assert {0, 8, 45, 53} <= set(chosen.tolist()) and chosen.size == MOST
    points = BOARD.corners[chosen]
    distance = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(MOST, 1)]
    assert distance.min() > 1.9 * BOARD.square_m
    assert spread_rows(BOARD.corners[:4], MOST).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("image", ["flat", "cut off", "another board"])
def test_what_is_no_such_board_is_refused(image):
    pictures = {
        "flat": np.full((480, 640), 128, dtype=np.uint8),
        "cut off": seen(BOARD, np.array([[1.0, 0, 300], [0, 1, 0], [0, 0, 1]]))[0],
        "another board": seen(Board(7, 5, 0.03), view(0.0))[0],
    }
    with pytest.raises(InputError, match="no chessboard of 9x6 inner corners is seen in the first image"):
        find_board(pictures[image], BOARD)


@pytest.mark.parametrize(
    ("size", "square_m", "words"),
    [
        ("9", 0.02, "inner corners as 9x6"),
        ("9x-6", 0.02, "inner corners as 9x6"),
        ("9x2", 0.02, "at least 3x3"),
        ("9x6", 0.0, "must be positive"),
    ],
)
def test_a_board_that_makes_no_sense(size, square_m, words):
    with pytest.raises(InputError, match=words):
        Board.parse(size, square_m)


def test_sizes_as_people_write_them():
    assert Board.parse(" 9X6", 0.024) == Board.parse("9×6", 0.024) == BOARD


MARKERS = MarkerBoard(4, 3, 0.04, 0.01, "4X4_50")
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
    found = find_markers(image, MARKERS)
    assert found.own_frame and found.names.size == 12 and not found.std_m.any()
    marker, corner = np.divmod(found.names, 4)
    np.testing.assert_allclose(found.px, px[marker, corner], atol=0.5)
    np.testing.assert_array_equal(found.positions, MARKERS.corners[marker, corner])


def test_part_of_the_board_is_enough():
    image, px = seen_markers(np.array([[1.0, 0, 330], [0, 1, 0], [0, 0, 1]]) @ view(0.0, 1.0))
    found = find_markers(image, MARKERS)
    marker, corner = np.divmod(found.names, 4)
    assert 1 <= np.unique(marker).size < 12
    np.testing.assert_allclose(found.px, px[marker, corner], atol=0.5)


def test_what_is_no_such_board_of_markers_is_refused():
    with pytest.raises(InputError, match="no marker of a board of 4x3 from 4X4_50"):
        find_markers(np.full((480, 640), 128, dtype=np.uint8), MARKERS)
    with pytest.raises(InputError, match="no marker of a board of 4x3 from 6X6_50"):
        find_markers(seen_markers(view(0.0, 1.0))[0], MarkerBoard(4, 3, 0.04, 0.01, "6X6_50"))
    small = np.diag([0.12, 0.12, 1.0])
    with pytest.raises(InputError, match=r"start nearer|no marker"):
        find_markers(seen_markers(small)[0], MARKERS)


@pytest.mark.parametrize(
    ("size", "side_m", "gap_m", "dictionary", "words"),
    [
        ("5", 0.04, 0.01, "4x4_50", "their number as 5x7"),
        ("4x3", 0.0, 0.01, "4x4_50", "is positive"),
        ("4x3", 0.04, -0.01, "4x4_50", "not negative"),
        ("4x3", 0.04, 0.01, "9x9_50", "no dictionary"),
    ],
)
def test_a_board_of_markers_that_makes_no_sense(size, side_m, gap_m, dictionary, words):
    with pytest.raises(InputError, match=words):
        MarkerBoard.parse(size, side_m, gap_m, dictionary)
