"""Printed boards of known size, chessboards and grids of ArUco markers: known points at the start, and camera calibration.

A chessboard's frame: the first inner corner is the origin, x runs along the rows, y across them, z into the sheet. Where
columns and rows are not both even or both odd, the first corner is the one whose diagonally inner square is black; else the
board has a half-turn symmetry, and either of two corners can be the first.

The frame of a grid of markers: the top left corner of the first marker is the origin, x runs along the rows, y down, z
into the sheet. Markers are numbered row by row from 0, as OpenCV's `GridBoard` prints them. A marker's pattern gives its
number and orientation, so that a partial view of the board is enough (S. Garrido-Jurado and others, 2014).

`calibrate` estimates focal lengths, principal point and distortion from several views of a chessboard (Z. Zhang 2000, by
OpenCV). The Bayesian information criterion (G. Schwarz 1978) selects the number of distortion coefficients: a superfluous
one would distort the parts of the image without corners.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.ranges import Count, NotNegative, Positive, check_ranges
from rbpf.sensors.camera import LENSES, Pinhole
from rbpf.sensors.features.interface import checked_image
from rbpf.sensors.readers.known_points import KnownPixels

#: Maximum number of corners used for initialisation: more would be closer together than the search radius.
MOST = 12
LEAST_SQUARE_PX = 5.0  #: Smallest usable side of a square in the image: closer corners would be confused.
LEAST_SIDE_PX = 12.0  #: Smallest usable side of a marker in the image: smaller ones are sometimes misread.
DICTIONARIES = (
    *("4X4_50", "4X4_100", "4X4_250", "5X5_50", "5X5_100", "5X5_250", "6X6_50", "6X6_100", "6X6_250"),
    "APRILTAG_36H11",
)  #: Supported marker dictionaries.
_SIZE = re.compile(r"(\d{1,3})[xX×](\d{1,3})", re.ASCII)


@dataclass(frozen=True)
class Board:
    """A printed chessboard: the numbers of inner corners in a row and in a column, and the side of a square.

    Raises InputError: there are fewer than three of either, or the side is not positive.
    """

    columns: int
    rows: int
    square_m: Positive

    def __post_init__(self) -> None:
        check_ranges(self, "a chessboard's ")
        if min(self.columns, self.rows) < 3:
            raise InputError(
                f"a chessboard needs at least 3x3 inner corners, got {self.columns}x{self.rows}: count the places "
                "where four squares meet"
            )

    @classmethod
    def parse(cls, size: str, square_m: float) -> "Board":
        """The board of a size such as "9x6" (inner corners). Raises InputError: the size is malformed."""
        return cls(*_parsed(size, "a chessboard is its inner corners as 9x6"), square_m)

    @property
    def corners(self) -> np.ndarray:
        """(rows · columns, 3) inner corners in the board's frame, row by row, m."""
        y, x = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return self.square_m * np.stack([x, y, np.zeros_like(x)], axis=-1).astype(float)


def _parsed(size: str, what: str) -> tuple[int, int]:
    """Columns and rows of a size such as "9x6"."""
    found = _SIZE.fullmatch(size.strip())
    if found is None:
        raise InputError(f"the size of {what}, got {size!r}")
    return int(found[1]), int(found[2])


def find_board(image: np.ndarray, board: Board) -> KnownPixels:
    """Well-spread corners of a board in an image (H, W) uint8, as exact known points, numbered row by row.

    Raises InputError: the board is not detected as a whole, or is too small in the image.
    """
    image = checked_image(image)
    px = board_corners(image, board)
    if px is None:
        raise InputError(
            f"no chessboard of {board.columns}x{board.rows} inner corners is detected in the first image: it has to be "
            "visible as a whole, with its white border, sharp and evenly lit"
        )
    side = least_side(px, board)
    if side < LEAST_SQUARE_PX:
        raise InputError(f"the chessboard's squares are only {side:.1f} px wide in the first image: start closer to it")
    chosen = spread_rows(board.corners, MOST)
    return KnownPixels(chosen, px[chosen], board.corners[chosen], np.zeros(chosen.size), own_frame=True)


def board_corners(image: np.ndarray, board: Board, thorough: bool = True) -> np.ndarray | None:
    """All corners (rows · columns, 2) of a board in an image (H, W) uint8, in the order of the board's frame, px.

    None if the board is not detected as a whole. `thorough` adds an exhaustive search if the fast ones fail.
    """
    import cv2

    searches = (0, cv2.CALIB_CB_NORMALIZE_IMAGE, cv2.CALIB_CB_EXHAUSTIVE)
    for flags in searches if thorough else searches[:2]:
        found, px = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags)
        if found:
            break
    else:
        return None
    # Subpixel refinement of the saddle points: image gradients around a corner are orthogonal to the lines to it.
    px = np.asarray(px, dtype=np.float32).reshape(-1, 2)
    half = int(np.clip(0.4 * least_side(px, board), 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    px = cv2.cornerSubPix(image, px.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), criteria)
    grid = np.asarray(px, dtype=float).reshape(board.rows, board.columns, 2)
    # The detector returns one of several orders. In the right one the board is seen from the front, so that x, y and z into
    # the sheet are right-handed, and the square at the first corner is darker than its neighbour.
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0.0:
        grid = grid[:, ::-1]
    middles = [np.rint(grid[:2, k : k + 2].mean(axis=(0, 1))).astype(int) for k in (0, 1)]
    if int(image[middles[0][1], middles[0][0]]) > int(image[middles[1][1], middles[1][0]]):
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def least_side(px: np.ndarray, board: Board) -> float:
    """Shortest side of a square in the image, px, from its corners (rows · columns, 2)."""
    grid = px.reshape(board.rows, board.columns, 2)
    return min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))


def spread_rows(points: np.ndarray, count: int) -> np.ndarray:
    """Ascending indices of at most `count` points (M, D) by farthest-point sampling."""
    middle = points.mean(axis=0)
    chosen = [int(np.argmax(np.linalg.norm(points - middle, axis=1)))]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, points.shape[0]):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.sort(np.array(chosen, dtype=np.int64))


@dataclass(frozen=True)
class MarkerBoard:
    """A printed grid of markers of a dictionary in `DICTIONARIES`, `gap_m` apart.

    A marker's `side_m` includes its black border. Raises InputError: a number is out of range, or the dictionary is unknown
    or too small.
    """

    columns: Count
    rows: Count
    side_m: Positive
    gap_m: NotNegative
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        check_ranges(self, "the board of markers: ")
        if self.dictionary not in DICTIONARIES:
            raise InputError(f"there is no dictionary {self.dictionary!r} of markers; known: {', '.join(DICTIONARIES)}")

    @classmethod
    def parse(cls, size: str, side_m: float, gap_m: float, dictionary: str) -> "MarkerBoard":
        """The board of a size such as "5x7" (columns x rows). Raises InputError: the size is malformed."""
        return cls(*_parsed(size, "a board of markers is their number as 5x7"), side_m, gap_m, dictionary.upper())

    @property
    def corners(self) -> np.ndarray:
        """(rows · columns, 4, 3) corners of the markers, each from its top left one clockwise, m."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        origin = (self.side_m + self.gap_m) * np.stack([column, row, np.zeros_like(row)], axis=-1)
        square = self.side_m * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        return origin[:, None] + square


def find_markers(image: np.ndarray, board: MarkerBoard) -> KnownPixels:
    """Well-spread corners of the markers seen in an image (H, W) uint8, as exact known points.

    Corner k of marker i is named 4 i + k. Raises InputError: no marker of the board is detected, or all are too small in
    the image.
    """
    import cv2

    image = checked_image(image)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    patterns = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    found, names, _ = cv2.aruco.ArucoDetector(patterns, parameters).detectMarkers(image)
    # The board's own markers, only those detected exactly once, sorted by number.
    numbers = np.zeros(0, dtype=np.int64) if names is None else np.asarray(names).ravel().astype(np.int64)
    px = np.array(found, dtype=float).reshape(-1, 4, 2)
    numbers, first, count = np.unique(numbers, return_index=True, return_counts=True)
    mine = (numbers < board.columns * board.rows) & (count == 1)
    numbers, px = numbers[mine], px[first[mine]]
    side = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=-1).min(axis=1) if numbers.size else np.zeros(0)
    large = side >= LEAST_SIDE_PX
    if not large.any():
        small = f"; {numbers.size} are detected, with sides of {side.max(initial=0.0):.0f} px: start closer"
        raise InputError(
            f"no marker of a board of {board.columns}x{board.rows} from {board.dictionary} is detected large enough in the "
            f"first image{small if numbers.size else ''}; each needs a white margin"
        )
    positions = board.corners[numbers[large]].reshape(-1, 3)
    corners = (4 * numbers[large][:, None] + np.arange(4)).ravel()
    chosen = spread_rows(positions, MOST)
    seen = px[large].reshape(-1, 2)[chosen]
    return KnownPixels(corners[chosen], seen, positions[chosen], np.zeros(chosen.size), own_frame=True)


LEAST_VIEWS = 5  #: Three determine the camera; fewer than five leave no redundancy to detect errors.
#: Standard deviation of the focal length, as a fraction of it, above which the views are insufficient.
MOST_UNCERTAIN = 0.02
#: Least angle between the board's normals in two views: equal orientations leave the focal length undetermined.
LEAST_TURN = np.deg2rad(10.0)
OUTLYING = 4.0  #: Views with an error above this multiple of the median are rejected …
HARMLESS_PX = 0.3  #: … if it also exceeds this.
#: Candidate numbers of distortion coefficients to estimate, the first ones, for each lens model.
COUNTS = {"radial-tangential": (0, 2, 4, 5), "equidistant": (0, 2, 4)}


class BoardView(NamedTuple):
    """Corners (rows · columns, 2) of the board in one image, px, and the image's name."""

    name: str
    px: np.ndarray


@dataclass(frozen=True)
class BoardCalibration:
    """A calibrated camera and its fit to V views of M corners."""

    camera: Pinhole  #: the camera.
    #: (P,) standard deviations of fx, fy, cx, cy [px] and the lens's coefficients; 0 for one that was not estimated.
    std: np.ndarray
    views: tuple[BoardView, ...]  #: those that were used.
    residuals: np.ndarray  #: (V, M, 2) detected minus projected corners, px.
    normals: np.ndarray  #: (V, 3) of the board in the camera's frame.
    left_out: tuple[str, ...] = ()  #: names of views rejected as outliers.

    @property
    def rms_px(self) -> float:
        """Reprojection error: root of the mean squared distance of the corners, px."""
        return float(np.sqrt(np.square(self.residuals).sum(axis=-1).mean()))

    @property
    def rms_by_view_px(self) -> np.ndarray:
        """(V,) reprojection error of each view, px."""
        return np.asarray(np.sqrt(np.square(self.residuals).sum(axis=-1).mean(axis=-1)))

    @property
    def turn_rad(self) -> float:
        """Largest angle between the board's normals in two views."""
        return float(np.arccos(np.clip(self.normals @ self.normals.T, -1.0, 1.0)).max())

    @property
    def covered(self) -> float:
        """Fraction of 8 × 6 image cells in which a corner was detected."""
        px = np.concatenate([view.px for view in self.views])
        field = (px / [self.camera.width, self.camera.height] * [8, 6]).astype(int).clip(0, [7, 5])
        return len(np.unique(field, axis=0)) / 48


def calibrate(
    views: Sequence[BoardView], board: Board, width: int, height: int, model: str = "radial-tangential"
) -> BoardCalibration:
    """Calibrates a camera from views of a board, all in images of one size [px].

    The distortion `model` is radial-tangential or equidistant. Raises InputError: there are too few views, or they are too
    similar to determine the camera.
    """
    used = list(views)
    left_out: list[str] = []
    while True:
        if len(used) < LEAST_VIEWS:
            agree = f" that agree ({', '.join(left_out)} did not)" if left_out else ""
            raise InputError(
                f"the board is detected in {len(used)} images{agree}, expected at least {LEAST_VIEWS}, better 15, from "
                "different directions: take more"
            )
        # The number of coefficients with the lowest information criterion.
        scores, fits = [], []
        for count in COUNTS[model]:
            fit = _fitted(used, board, (width, height), model, count)
            numbers, parameters = fit.residuals.size, 4 + count + 6 * len(used)
            mean_square = max(float(np.square(fit.residuals).mean()), np.finfo(float).tiny)
            scores.append(numbers * np.log(mean_square) + parameters * np.log(numbers))
            fits.append(fit)
        found = fits[int(np.argmin(scores))]
        rms = found.rms_by_view_px
        worst = int(rms.argmax())
        if rms[worst] <= max(OUTLYING * float(np.median(rms)), HARMLESS_PX):
            break
        left_out.append(used.pop(worst).name)
    relative_std = float((found.std[:2] / [found.camera.fx, found.camera.fy]).max())
    if found.turn_rad < LEAST_TURN or not relative_std <= MOST_UNCERTAIN:
        raise InputError(
            f"the {len(used)} views show the board from too similar directions to determine the focal length: turn "
            "and tilt the board, or the camera, by some 30 degrees to all sides between the images"
        )
    return replace(found, left_out=tuple(left_out))


def _fitted(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], model: str, count: int
) -> BoardCalibration:
    """The least-squares camera with the first `count` distortion coefficients; the others are zero.

    Raises InputError: OpenCV fails, or its result is not a valid camera.
    """
    import cv2

    corners, px, names = board.corners, np.array([view.px for view in views]), LENSES[model].coefficient_names
    # OpenCV fixes the tangential coefficients p1 and p2 by one common flag.
    flags = sum(getattr(cv2, f"CALIB_FIX_{name.upper()}") for name in names[count:] if name.startswith("k"))
    flags |= cv2.CALIB_ZERO_TANGENT_DIST if "p1" in names[count:] else 0
    try:
        if model == "equidistant":
            flags |= cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
            precise = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
            _, matrix, distortion, turns, shifts = cv2.fisheye.calibrate(
                [corners.reshape(1, -1, 3)] * len(px), [view.reshape(1, -1, 2) for view in px], size,
                np.zeros((3, 3)), np.zeros((4, 1)), flags=flags, criteria=precise,
            )  # fmt: skip
            coefficients, std = distortion.ravel(), None
        else:
            seen = [view.astype(np.float32).reshape(-1, 1, 2) for view in px]
            _, matrix, distortion, turns, shifts, std = cv2.calibrateCameraExtended(
                [corners.astype(np.float32)] * len(px), seen, size, None, None, flags=flags
            )[:6]
            coefficients = np.pad(distortion.ravel()[:5], (0, max(5 - distortion.size, 0)))
            std = std.ravel()[:9].copy()
    except cv2.error as error:
        raise InputError(
            f"the calibration failed for the {len(views)} views ({error.err}): are they all of one flat board?"
        ) from error
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    camera = Pinhole(*size, fx, fy, cx, cy, tuple(coefficients.tolist()), model)
    rotations = np.array([cv2.Rodrigues(turn)[0] for turn in turns])
    places = corners @ rotations.mT + np.array(shifts).reshape(-1, 1, 3)
    if std is None:
        std = _deviations(camera, places, px, np.arange(4 + len(names)) < 4 + count)
    return BoardCalibration(camera, std, tuple(views), px - camera.project(places), rotations[..., 2])


def _deviations(camera: Pinhole, places: np.ndarray, px: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Standard deviations (P,) of a camera's parameters, the board poses marginalised; 0 where not `free` (P,).

    From the residuals' variance and Jacobians, as calibrateCameraExtended does for other lenses; corners are (V, M, 3) in
    the camera's frame, detected at px (V, M, 2).
    """
    # Pixels are linear in fx, fy, cx, cy and each coefficient: a unit increment gives the exact derivative.
    k = np.array(camera.distortion)
    more = [replace(camera, **{name: getattr(camera, name) + 1.0}) for name in ("fx", "fy", "cx", "cy")]
    more += [replace(camera, distortion=tuple((k + unit).tolist())) for unit in np.eye(k.size)]
    by_camera = np.stack([one.project(places) - camera.project(places) for one in more], axis=-1)[..., free]
    by_pose = camera.jacobian(places) @ SE3.transform_jacobian(places)
    v, m = places.shape[:2]
    a, b = by_camera.reshape(v, 2 * m, -1), by_pose.reshape(v, 2 * m, 6)
    shared = a.mT @ b
    information = (a.mT @ a - shared @ np.linalg.solve(b.mT @ b, shared.mT)).sum(axis=0)
    squared = np.square(camera.project(places) - px).sum()
    variance = squared / (2 * v * m - 6 * v - free.sum())
    std = np.zeros(free.size)
    std[free] = np.sqrt(variance * np.diagonal(np.linalg.inv(information)))
    return std
