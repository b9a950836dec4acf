"""The camera from several views of a chessboard (Z. Zhang 2000, by OpenCV): focal lengths, principal point, distortion.

The Bayesian information criterion (G. Schwarz 1978) chooses how many coefficients of distortion are estimated: one that the
corners do not need would bend the image where no corner was.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import skew
from rbpf.sensors.calibration.boards import Board
from rbpf.sensors.camera import Pinhole

LEAST_VIEWS = 5
"""Three determine the camera; with fewer than five no mistake is noticed."""
MOST_UNCERTAIN = 0.02
"""Standard deviation of the focal length, as a fraction of it, above which the views say too little."""
LEAST_TURN = np.deg2rad(10.0)
"""Angle between the board's normals that two views must have: from one direction, near and small is far and large."""
OUTLYING = 4.0
"""Views whose error is this many times the median one are left out, and …"""
HARMLESS_PX = 0.3
"""… those with less than this are not."""


class BoardView(NamedTuple):
    """Corners (rows · columns, 2) of the board in one image, px, and the image's name."""

    name: str
    px: np.ndarray


@dataclass(frozen=True)
class BoardCalibration:
    """A camera, and how well it explains V views of M corners.

    Attributes:
        camera: the camera.
        std: (P,) standard deviations of fx, fy, cx, cy [px] and the lens's coefficients; 0 for one that was not needed.
        views: those that were used.
        residuals: (V, M, 2) where corners were found less where the camera sees them, px.
        normals: (V, 3) of the board in the camera's frame.
        left_out: names of views that no camera explains together with the others.
    """

    camera: Pinhole
    std: np.ndarray
    views: tuple[BoardView, ...]
    residuals: np.ndarray
    normals: np.ndarray
    left_out: tuple[str, ...] = ()

    @property
    def rms_px(self) -> float:
        """Reprojection error: root of the mean squared distance of the corners, px."""
        return float(np.sqrt(np.square(self.residuals).sum(axis=-1).mean()))

    @property
    def rms_by_view_px(self) -> np.ndarray:
        """(V,) the same for each view."""
        return np.asarray(np.sqrt(np.square(self.residuals).sum(axis=-1).mean(axis=-1)))

    @property
    def turn_rad(self) -> float:
        """Largest angle between the board's normals in two views."""
        return float(np.arccos(np.clip(self.normals @ self.normals.T, -1.0, 1.0)).max())

    @property
    def covered(self) -> float:
        """Share of the image, in 8 × 6 fields, in which a corner was seen."""
        px = np.concatenate([view.px for view in self.views])
        field = (px / [self.camera.width, self.camera.height] * [8, 6]).astype(int).clip(0, [7, 5])
        return len(np.unique(field, axis=0)) / 48


def calibrate(
    views: Sequence[BoardView], board: Board, width: int, height: int, model: str = "radial-tangential"
) -> BoardCalibration:
    """The camera that explains the views.

    Args:
        views: of the board, all in images of one size.
        board: what is printed.
        width: of the images, px.
        height: of the images, px.
        model: of the lens's distortion, radial-tangential or equidistant.

    Raises:
        InputError: there are too few views, or they are too much alike to determine the camera.
    """
    used = list(views)
    left_out: list[str] = []
    while True:
        _require_enough(used, left_out)
        found = _fitted(used, board, width, height, model)
        rms = found.rms_by_view_px
        worst = int(rms.argmax())
        if rms[worst] <= max(OUTLYING * float(np.median(rms)), HARMLESS_PX):
            break
        left_out.append(used.pop(worst).name)
    focal = np.array([found.camera.fx, found.camera.fy])
    doubt = float((found.std[:2] / focal).max())
    if found.turn_rad < LEAST_TURN or not doubt <= MOST_UNCERTAIN:
        raise InputError(
            f"the {len(used)} views show the board from too much the same direction, the focal length stays open: turn "
            "and tilt the board, or the camera, by some 30 degrees to all sides between the images"
        )
    return replace(found, left_out=tuple(left_out))


def _require_enough(views: Sequence[BoardView], left_out: Sequence[str]) -> None:
    if len(views) >= LEAST_VIEWS:
        return
    agree = f" that agree ({', '.join(left_out)} did not)" if left_out else ""
    raise InputError(
        f"the board is found in {len(views)} images{agree}, expected at least {LEAST_VIEWS}, better 15, from different "
        "directions: take more"
    )


def _fitted(
    views: Sequence[BoardView], board: Board, width: int, height: int, model: str
) -> BoardCalibration:
    """The model of distortion with the least information criterion."""
    scores, fits = [], []
    for count, fixed in MODELS[model]:
        fit = _solved(views, board, width, height, model, fixed)
        numbers = fit.residuals.size
        parameters = 4 + count + 6 * len(views)
        mean_square = max(float(np.square(fit.residuals).mean()), np.finfo(float).tiny)
        scores.append(numbers * np.log(mean_square) + parameters * np.log(numbers))
        fits.append(fit)
    return fits[int(np.argmin(scores))]


def _solved(
    views: Sequence[BoardView], board: Board, width: int, height: int, model: str, fixed: Sequence[str]
) -> BoardCalibration:
    import cv2

    px = [view.px for view in views]
    try:
        camera, std, places, normals = fit_lens(model, board.corners, px, (width, height), fixed)
    except cv2.error as error:
        raise InputError(
            f"no camera explains the {len(views)} views ({error.err}): are they all of one flat board?"
        ) from error
    return BoardCalibration(camera, std, tuple(views), np.array(px) - camera.project(places), normals)


MODELS = {
    "radial-tangential": (
        (0, ("CALIB_FIX_K1", "CALIB_FIX_K2", "CALIB_FIX_K3", "CALIB_ZERO_TANGENT_DIST")),
        (2, ("CALIB_FIX_K3", "CALIB_ZERO_TANGENT_DIST")),
        (4, ("CALIB_FIX_K3",)),
        (5, ()),
    ),
    "equidistant": (
        (0, ("CALIB_FIX_K1", "CALIB_FIX_K2", "CALIB_FIX_K3", "CALIB_FIX_K4")),
        (2, ("CALIB_FIX_K3", "CALIB_FIX_K4")),
        (4, ()),
    ),
}
"""Of each kind of lens: numbers of coefficients, and what OpenCV is told to leave at zero."""


class LensFit(NamedTuple):
    """A camera and V boards of M corners before it.

    Attributes:
        camera: the camera.
        std: (P,) standard deviations of its numbers; 0 for what was left at zero.
        places: (V, M, 3) corners in the camera's frame.
        normals: (V, 3) of the boards in the camera's frame.
    """

    camera: Pinhole
    std: np.ndarray
    places: np.ndarray
    normals: np.ndarray


def fit_lens(
    model: str, board: np.ndarray, px: Sequence[np.ndarray], size: tuple[int, int], fixed: Sequence[str]
) -> LensFit:
    """The camera of least squared error.

    Args:
        model: of distortion.
        board: (M, 3) corners in the board's frame.
        px: V times (M, 2) where they are seen.
        size: width and height of the images.
        fixed: names of OpenCV's flags for what is left at zero.

    Raises:
        cv2.error: OpenCV finds none.
        InputError: what it finds is no camera.
    """
    import cv2

    flags = sum(getattr(cv2, name) for name in fixed)
    find = _equidistant if model == "equidistant" else _radial_tangential
    matrix, distortion, turns, shifts, std = find(cv2, board, px, size, flags)
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    camera = Pinhole(*size, fx, fy, cx, cy, tuple(distortion.tolist()), model)
    rotations = np.array([cv2.Rodrigues(turn)[0] for turn in turns])
    places = board @ rotations.mT + np.array(shifts).reshape(-1, 1, 3)
    if std is None:
        free = [True] * 4 + [
            f"CALIB_FIX_{name.upper()}" not in fixed for name in camera.lens.coefficient_names
        ]
        std = _deviations(camera, places, np.array(px), np.array(free))
    return LensFit(camera, std, places, rotations[..., 2])


def _radial_tangential(
    cv2: Any, board: np.ndarray, px: Sequence[np.ndarray], size: tuple[int, int], flags: int
) -> Any:
    points = [board.astype(np.float32)] * len(px)
    seen = [view.astype(np.float32).reshape(-1, 1, 2) for view in px]
    _, matrix, distortion, turns, shifts, std = cv2.calibrateCameraExtended(
        points, seen, size, None, None, flags=flags
    )[:6]
    five = distortion.ravel()[:5]
    return matrix, np.pad(five, (0, 5 - five.size)), turns, shifts, std.ravel()[:9].copy()


def _equidistant(
    cv2: Any, board: np.ndarray, px: Sequence[np.ndarray], size: tuple[int, int], flags: int
) -> Any:
    points = [board.reshape(1, -1, 3)] * len(px)
    seen = [view.reshape(1, -1, 2) for view in px]
    flags |= cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
    precise = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
    _, matrix, distortion, turns, shifts = cv2.fisheye.calibrate(
        points, seen, size, np.zeros((3, 3)), np.zeros((4, 1)), flags=flags, criteria=precise
    )
    return matrix, distortion.ravel(), turns, shifts, None


def _deviations(camera: Pinhole, places: np.ndarray, px: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Standard deviations (P,) of a camera's numbers with the boards' poses unknown; 0 where they are not `free` (P,).

    From the residuals' variance and derivatives, as calibrateCameraExtended has them of other lenses.
    """
    by_camera = _by_camera(camera, places)[..., free]
    turned = np.concatenate([-skew(places), np.broadcast_to(np.eye(3), (*places.shape, 3))], axis=-1)
    by_pose = camera.jacobian(places) @ turned
    v, m = places.shape[:2]
    a, b = by_camera.reshape(v, 2 * m, -1), by_pose.reshape(v, 2 * m, 6)
    shared = a.mT @ b
    information = (a.mT @ a - shared @ np.linalg.solve(b.mT @ b, shared.mT)).sum(axis=0)
    squared = np.square(camera.project(places) - px).sum()
    variance = squared / (2 * v * m - 6 * v - free.sum())
    std = np.zeros(free.size)
    std[free] = np.sqrt(variance * np.diagonal(np.linalg.inv(information)))
    return std


def _by_camera(camera: Pinhole, places: np.ndarray) -> np.ndarray:
    """∂px (V, M, 2, P) by fx, fy, cx, cy and the coefficients: pixels are linear in each, so that one more tells it."""
    k = np.array(camera.distortion)
    more = [replace(camera, **{name: getattr(camera, name) + 1.0}) for name in ("fx", "fy", "cx", "cy")]
    more += [replace(camera, distortion=tuple((k + unit).tolist())) for unit in np.eye(k.size)]
    return np.stack([one.project(places) - camera.project(places) for one in more], axis=-1)
