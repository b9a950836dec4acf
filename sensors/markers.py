"""A printed grid of ArUco markers in an image: known points to start from, of which some are enough.

Its frame: the top left corner of the first marker is the origin, x runs along the rows, y down, z into the sheet.
Markers are numbered row by row from 0, as OpenCV's `GridBoard` prints them. A marker says by its pattern which one it
is and which way up, so that part of the board is enough (S. Garrido-Jurado and others, 2014).
"""

import re
from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.chessboard import MOST, spread_rows
from rbpf.sensors.patches import checked_image
from rbpf.sensors.readers.images.known_points import KnownPixels

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

_SIZE = re.compile(r"(\d{1,2})[xX×](\d{1,2})", re.ASCII)


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
        found = _SIZE.fullmatch(size.strip())
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
    names, px = _detected(checked_image(image), board)
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


def _detected(image: np.ndarray, board: MarkerBoard) -> tuple[np.ndarray, np.ndarray]:
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
