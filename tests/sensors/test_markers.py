"""Corners of printed markers are found where OpenCV's own board was drawn, also where only part of it is seen."""

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.calibration.boards import MarkerBoard, find_markers

BOARD = MarkerBoard(4, 3, 0.04, 0.01, "4X4_50")
TEXELS_PER_M, MARGIN = 2000.0, 60


def printed() -> np.ndarray:
    """The board as OpenCV prints it."""
    patterns = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.GridBoard((BOARD.columns, BOARD.rows), BOARD.side_m, BOARD.gap_m, patterns)
    size = [round(TEXELS_PER_M * (n * 0.05 - 0.01)) + 2 * MARGIN for n in (BOARD.columns, BOARD.rows)]
    return board.generateImage(size, marginSize=MARGIN)


def seen(homography: np.ndarray, size=(640, 480)) -> tuple[np.ndarray, np.ndarray]:
    """The image, and where all corners (12, 4, 2) are in it."""
    fine = np.array([[4.0, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    large = cv2.warpPerspective(printed(), fine @ homography, (4 * size[0], 4 * size[1]), borderValue=200)
    image = cv2.resize(large, size, interpolation=cv2.INTER_AREA)
    texels = MARGIN + TEXELS_PER_M * BOARD.corners[..., :2] - 0.5
    px = cv2.perspectiveTransform(texels.reshape(1, -1, 2), homography).reshape(-1, 4, 2)
    return cv2.GaussianBlur(image, (0, 0), 0.7), px


def view(turn_deg: float, shift_px: float = 0.0) -> np.ndarray:
    """A homography that turns and tilts the sheet, about the middle of the image."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    middle = np.array([[1.0, 0, -250], [0, 1, -200], [0, 0, 1]])
    turned = np.array([[c, -s, 320 + shift_px], [s, c, 240], [0, 0, 1]])
    return turned @ np.array([[1.0, 0, 0], [0, 1, 0], [2e-4, 1e-4, 1]]) @ middle


def test_corners_are_those_of_opencvs_board():
    patterns = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    theirs = cv2.aruco.GridBoard((4, 3), 0.04, 0.01, patterns).getObjPoints()
    np.testing.assert_allclose(BOARD.corners, np.array(theirs), atol=1e-7)


@pytest.mark.parametrize("turn_deg", [0.0, 40.0, 180.0])
def test_markers_are_found_whatever_way_the_board_is_turned(turn_deg):
    image, px = seen(view(turn_deg))
    found = find_markers(image, BOARD)
    assert found.own_frame and found.names.size == 12 and not found.std_m.any()
    marker, corner = np.divmod(found.names, 4)
    np.testing.assert_allclose(found.px, px[marker, corner], atol=0.5)
    np.testing.assert_array_equal(found.positions, BOARD.corners[marker, corner])


def test_part_of_the_board_is_enough():
    image, px = seen(view(0.0, shift_px=330.0))
    found = find_markers(image, BOARD)
    marker, corner = np.divmod(found.names, 4)
    assert 1 <= np.unique(marker).size < 12
    np.testing.assert_allclose(found.px, px[marker, corner], atol=0.5)


def test_what_is_no_such_board_is_refused():
    with pytest.raises(InputError, match="no marker of a board of 4x3 from 4X4_50"):
        find_markers(np.full((480, 640), 128, dtype=np.uint8), BOARD)
    with pytest.raises(InputError, match="no marker of a board of 4x3 from 6X6_50"):
        find_markers(seen(view(0.0))[0], MarkerBoard(4, 3, 0.04, 0.01, "6X6_50"))
    small = np.diag([0.12, 0.12, 1.0])
    with pytest.raises(InputError, match=r"start nearer|no marker"):
        find_markers(seen(small)[0], BOARD)


@pytest.mark.parametrize(
    ("size", "side_m", "gap_m", "dictionary", "words"),
    [
        ("5", 0.04, 0.01, "4x4_50", "their number as 5x7"),
        ("0x3", 0.04, 0.01, "4x4_50", "at least 1x1"),
        ("4x3", 0.0, 0.01, "4x4_50", "must be positive"),
        ("4x3", 0.04, -0.01, "4x4_50", "not negative"),
        ("4x3", 0.04, 0.01, "9x9_50", "no dictionary"),
    ],
)
def test_a_board_that_makes_no_sense(size, side_m, gap_m, dictionary, words):
    with pytest.raises(InputError, match=words):
        MarkerBoard.parse(size, side_m, gap_m, dictionary)
