"""The camera from several views of a chessboard (Z. Zhang 2000, by OpenCV): focal lengths, principal point, distortion.

How much distortion is told is chosen by the Bayesian information criterion (G. Schwarz 1978): a coefficient that the
corners do not need would bend the image where no corner was.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.chessboard import Board
from rbpf.sensors.lens_calibration import MODELS, fit_lens
from rbpf.sensors.pinhole import Pinhole

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
