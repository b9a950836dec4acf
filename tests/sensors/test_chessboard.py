"""A printed board is found where it was drawn, in one frame whatever way it is turned."""

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.calibration.boards import MOST, Board, find_board, spread_rows

BOARD = Board(9, 6, 0.024)
TEXELS, MARGIN = 40, 60


def printed(columns: int, rows: int) -> np.ndarray:
    """Squares, the first one black, in a white margin."""
    row, column = np.indices((rows + 1, columns + 1))
    cells = np.where((row + column) % 2 == 0, 20, 235).astype(np.uint8)
    sheet = cells.repeat(TEXELS, axis=0).repeat(TEXELS, axis=1)
    return np.pad(sheet, MARGIN, constant_values=235)


def seen(
    board: Board, homography: np.ndarray, size: tuple[int, int] = (640, 480)
) -> tuple[np.ndarray, np.ndarray]:
    """The image, and where the inner corners (rows · columns, 2) are in it."""
    sheet, fine = printed(board.columns, board.rows), np.array([[4.0, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    large = cv2.warpPerspective(sheet, fine @ homography, (4 * size[0], 4 * size[1]), borderValue=120)
    image = cv2.resize(large, size, interpolation=cv2.INTER_AREA)
    # Texel (i, j) has its centre at whole numbers, so that the edge between two squares lies half a texel before.
    texel = MARGIN + TEXELS * (board.corners[:, :2] / board.square_m + 1.0) - 0.5
    px = cv2.perspectiveTransform(texel[None], homography)[0]
    noise = np.random.default_rng(0).normal(0.0, 2.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8), px


def view(turn_deg: float, tilt: float = 2e-4, scale: float = 0.7) -> np.ndarray:
    """A homography that turns the sheet about the middle of the image, and tilts it."""
    c, s = scale * np.cos(np.deg2rad(turn_deg)), scale * np.sin(np.deg2rad(turn_deg))
    middle = np.array([[1.0, 0, -260], [0, 1, -200], [0, 0, 1]])
    turned = np.array([[c, -s, 320], [s, c, 240], [0, 0, 1]])
    leaning = np.array([[1.0, 0, 0], [0, 1, 0], [tilt, 0.5 * tilt, 1]])
    return turned @ leaning @ middle


@pytest.mark.parametrize("turn_deg", [0.0, 40.0, 90.0, 180.0, 250.0])
def test_corners_are_found_to_a_tenth_of_a_pixel_in_the_board_s_own_order(turn_deg):
    image, px = seen(BOARD, view(turn_deg))
    found = find_board(image, BOARD)
    assert found.own_frame and found.names.size == MOST
    np.testing.assert_allclose(found.px, px[found.names], atol=0.1)
    np.testing.assert_array_equal(found.positions, BOARD.corners[found.names])
    assert not found.std_m.any()


def test_a_board_that_looks_the_same_upside_down_is_still_right_handed():
    board = Board(7, 5, 0.03)
    image, px = seen(board, view(200.0))
    found = find_board(image, board)
    errors = [np.abs(found.px - order[found.names]).max() for order in (px, px[::-1])]
    assert min(errors) < 0.1


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
        ("9x6x3", 0.02, "inner corners as 9x6"),
        ("9x-6", 0.02, "inner corners as 9x6"),
        ("9x2", 0.02, "at least 3x3"),
        ("9x6", 0.0, "must be positive"),
        ("9x6", float("nan"), "must be positive"),
    ],
)
def test_a_board_that_makes_no_sense(size, square_m, words):
    with pytest.raises(InputError, match=words):
        Board.parse(size, square_m)


def test_sizes_as_people_write_them():
    assert Board.parse(" 9X6", 0.024) == Board.parse("9×6", 0.024) == BOARD
