"""Printed boards of known size in an image, chessboards and grids of ArUco markers: known points to start from.

A chessboard's frame: the first inner corner is the origin, x runs along the rows, y across them, z into the sheet. Where
columns and rows are not both even or both odd, the first corner is the one whose square towards the board's middle is
black; else the board looks the same upside down, and either of two corners is the first.

The frame of a grid of markers: the top left corner of the first marker is the origin, x runs along the rows, y down, z
into the sheet. Markers are numbered row by row from 0, as OpenCV's `GridBoard` prints them. A marker's pattern tells its
number and which way up it is, so that part of the board is enough (S. Garrido-Jurado and others, 2014).
"""

import re
from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.features.interface import checked_image
from rbpf.sensors.readers.known_points import KnownPixels

MOST = 12
"""Corners that a run starts from, spread over the board: more are nearer to each other than a search reaches."""

LEAST_SQUARE_PX = 5.0
"""Corners nearer to each other than this cannot be told apart."""

_BOARD_SIZE = re.compile(r"(\d{1,3})[xX×](\d{1,3})", re.ASCII)
_SEARCHES = (0, "CALIB_CB_NORMALIZE_IMAGE", "CALIB_CB_EXHAUSTIVE")


@dataclass(frozen=True)
class Board:
    """What is printed.

    Attributes:
        columns: inner corners in a row.
        rows: inner corners in a column.
        square_m: side of a square.

    Raises:
        InputError: there are fewer than three of either, or the squares have no size.
    """

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise InputError(
                f"a chessboard needs at least 3x3 inner corners, got {self.columns}x{self.rows}: count the places "
                "where four squares meet"
            )
        if not 0.0 < self.square_m < np.inf:
            raise InputError(f"the side of a chessboard's square must be positive, got {self.square_m} m")

    @classmethod
    def parse(cls, size: str, square_m: float) -> "Board":
        """A board whose inner corners are written as 9x6.

        Raises:
            InputError: they are not.
        """
        found = _BOARD_SIZE.fullmatch(size.strip())
        if found is None:
            raise InputError(f"the size of a chessboard is its inner corners as 9x6, got {size!r}")
        return cls(int(found[1]), int(found[2]), square_m)

    @property
    def corners(self) -> np.ndarray:
        """(rows · columns, 3) inner corners in the board's frame, row by row, m."""
        y, x = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return self.square_m * np.stack([x, y, np.zeros_like(x)], axis=-1).astype(float)


def find_board(image: np.ndarray, board: Board) -> KnownPixels:
    """Well-spread corners of a board in an image, as exact known points; the names are their numbers, row by row.

    Args:
        image: (H, W) uint8.
        board: what is printed.

    Raises:
        InputError: the board is not seen whole, or it is too small in the image.
    """
    image = checked_image(image)
    px = board_corners(image, board)
    if px is None:
        raise InputError(
            f"no chessboard of {board.columns}x{board.rows} inner corners is seen in the first image: it has to be "
            "seen whole, with its white border, sharp and evenly lit"
        )
    side = least_side(px, board)
    if side < LEAST_SQUARE_PX:
        raise InputError(
            f"the chessboard's squares are only {side:.1f} px wide in the first image: start nearer to it"
        )
    chosen = spread_rows(board.corners, MOST)
    return KnownPixels(chosen, px[chosen], board.corners[chosen], np.zeros(chosen.size), own_frame=True)


def board_corners(image: np.ndarray, board: Board, thorough: bool = True) -> np.ndarray | None:
    """All corners (rows · columns, 2) of a board in an image (H, W) uint8, in the order of the board's frame, px.

    None where the board is not seen whole. Without `thorough` a second look at images that show none is left out.
    """
    px = _find_corners(image, board, _SEARCHES if thorough else _SEARCHES[:2])
    return None if px is None else _ordered(image, px, board)


def least_side(px: np.ndarray, board: Board) -> float:
    """Least distance of corners (rows · columns, 2) that are neighbours along a side of a square, px."""
    grid = px.reshape(board.rows, board.columns, 2)
    return min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))


def spread_rows(points: np.ndarray, count: int) -> np.ndarray:
    """Rows, ascending, of at most `count` points (M, D), each in turn the farthest from those chosen before it."""
    middle = points.mean(axis=0)
    chosen = [int(np.argmax(np.linalg.norm(points - middle, axis=1)))]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, points.shape[0]):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.sort(np.array(chosen, dtype=np.int64))


def _find_corners(image: np.ndarray, board: Board, searches: tuple[int | str, ...]) -> np.ndarray | None:
    """Corners (rows · columns, 2) in one of the orders in which a detector may give them."""
    import cv2

    for search in searches:
        flags = getattr(cv2, search) if isinstance(search, str) else search
        found, px = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags)
        if found:
            return _refined(image, np.asarray(px, dtype=np.float32).reshape(-1, 2), board)
    return None


def _refined(image: np.ndarray, px: np.ndarray, board: Board) -> np.ndarray:
    """Corners to a fraction of a pixel: where the slopes of the image all point past them (saddle points)."""
    import cv2

    half = int(np.clip(0.4 * least_side(px, board), 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    refined = cv2.cornerSubPix(image, px.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), criteria)
    return np.asarray(refined, dtype=float).reshape(-1, 2)


def _ordered(image: np.ndarray, px: np.ndarray, board: Board) -> np.ndarray:
    """The same corners in the order of the board's frame."""
    grid = px.reshape(board.rows, board.columns, 2)
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0.0:
        grid = grid[:, ::-1]  # seen from the front, x, y and z into the sheet are right-handed
    if _grey(image, grid, 0) > _grey(image, grid, 1):
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def _grey(image: np.ndarray, grid: np.ndarray, column: int) -> int:
    """Grey level in the middle of a square of the first row between inner corners."""
    x, y = np.rint(grid[:2, column : column + 2].mean(axis=(0, 1))).astype(int)
    return int(image[y, x])


DICTIONARIES = (
    "4X4_50",
    "4X4_100",
    "4X4_250",
    "5X5_50",
    "5X5_100",
    "5X5_250",
    "6X6_50",
    "6X6_100",
    "6X6_250",
    "APRILTAG_36H11",
)
LEAST_SIDE_PX = 12.0
"""Markers smaller than this are read wrongly now and then."""

_MARKERS_SIZE = re.compile(r"(\d{1,2})[xX×](\d{1,2})", re.ASCII)


@dataclass(frozen=True)
class MarkerBoard:
    """What is printed.

    Attributes:
        columns: markers in a row.
        rows: markers in a column.
        side_m: of a marker, its black border included.
        gap_m: between two markers.
        dictionary: of patterns, a name in `DICTIONARIES`.

    Raises:
        InputError: a number makes no sense, or the dictionary is not known or too small.
    """

    columns: int
    rows: int
    side_m: float
    gap_m: float
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 1:
            raise InputError(f"a board needs at least 1x1 markers, got {self.columns}x{self.rows}")
        if not (0.0 < self.side_m < np.inf and 0.0 <= self.gap_m < np.inf):
            raise InputError(
                f"a marker's side must be positive and the gap not negative, got {self.side_m} m, {self.gap_m} m"
            )
        if self.dictionary not in DICTIONARIES:
            raise InputError(
                f"there is no dictionary {self.dictionary!r} of markers; known: {', '.join(DICTIONARIES)}"
            )

    @classmethod
    def parse(cls, size: str, side_m: float, gap_m: float, dictionary: str) -> "MarkerBoard":
        """A board whose markers are written as 5x7, columns first.

        Raises:
            InputError: they are not.
        """
        found = _MARKERS_SIZE.fullmatch(size.strip())
        if found is None:
            raise InputError(f"the size of a board of markers is their number as 5x7, got {size!r}")
        return cls(int(found[1]), int(found[2]), side_m, gap_m, dictionary.upper())

    @property
    def corners(self) -> np.ndarray:
        """(rows · columns, 4, 3) corners of the markers, each from its top left one clockwise, m."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        origin = (self.side_m + self.gap_m) * np.stack([column, row, np.zeros_like(row)], axis=-1)
        square = self.side_m * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        return origin[:, None] + square


def find_markers(image: np.ndarray, board: MarkerBoard) -> KnownPixels:
    """Well-spread corners of the markers that are seen, as exact known points; corner k of marker i is named 4 i + k.

    Args:
        image: (H, W) uint8.
        board: what is printed.

    Raises:
        InputError: no marker of the board is seen, or all are too small in the image.
    """
    names, px = _detect_markers(checked_image(image), board)
    side = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=-1).min(axis=1) if names.size else np.zeros(0)
    large = side >= LEAST_SIDE_PX
    if not large.any():
        seen = (
            f"; {names.size} are seen, with sides of {side.max():.0f} px: start nearer" if names.size else ""
        )
        raise InputError(
            f"no marker of a board of {board.columns}x{board.rows} from {board.dictionary} is seen large enough in the "
            f"first image{seen}; white has to be left around each"
        )
    positions = board.corners[names[large]].reshape(-1, 3)
    numbers = (4 * names[large][:, None] + np.arange(4)).ravel()
    chosen = spread_rows(positions, MOST)
    return KnownPixels(
        numbers[chosen],
        px[large].reshape(-1, 2)[chosen],
        positions[chosen],
        np.zeros(chosen.size),
        own_frame=True,
    )


def _detect_markers(image: np.ndarray, board: MarkerBoard) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (M,), ascending, of the board's markers in the image, and their corners (M, 4, 2)."""
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    patterns = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    found, names, _ = cv2.aruco.ArucoDetector(patterns, parameters).detectMarkers(image)
    if names is None or not len(names):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2))
    numbers, px = np.asarray(names).ravel().astype(np.int64), np.array(found, dtype=float).reshape(-1, 4, 2)
    numbers, first, count = np.unique(numbers, return_index=True, return_counts=True)
    mine = (numbers < board.columns * board.rows) & (count == 1)
    return numbers[mine], px[first[mine]]
