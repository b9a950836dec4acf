"""A camera that explains where it sees the corners of a board, by OpenCV: one way for each kind of lens."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rbpf.lie.matrices import skew
from rbpf.sensors.pinhole import Pinhole

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
