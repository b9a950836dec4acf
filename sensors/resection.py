"""Where a camera is that sees known points: the first estimate of a run's start."""

from itertools import combinations, islice

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.pinhole import Pinhole

FLAT = 1e-3
"""Points whose second spread is below this fraction of the first lie on a line."""

TRIPLES = 20
"""Triples of points that are tried; four points have four."""


def resect(camera: Pinhole, points: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Pose world_from_camera (7,) of least reprojection error.

    Every solution of the first triples of points is refined on all of them, because few points have several local
    optima and a single start may find the wrong one.

    Args:
        camera: of the image.
        points: (M, 3) in the world, metres.
        px: (M, 2) where they are seen.

    Raises:
        InputError: there are fewer than four points, they lie on a line, or no pose in front of them explains them.
    """
    if points.shape[0] < 4:
        raise InputError(
            f"a start from known points needs at least four that are seen, got {points.shape[0]}"
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] <= FLAT * spread[0]:
        raise InputError(
            "the known points lie on a line: add one beside it, the camera could turn around them"
        )
    uv = camera.unproject(px)
    if not np.isfinite(uv).all():
        raise InputError(
            "a known point is seen where the camera's distortion has no direction: check the calibration"
        )
    poses = _candidates(points, uv)
    costs = [_cost(pose, points, uv) for pose in poses]
    if not costs or not np.isfinite(min(costs)):
        raise InputError(
            "no camera in front of the known points sees them as measured: check their names and order"
        )
    return poses[int(np.argmin(costs))]


def _candidates(points: np.ndarray, uv: np.ndarray) -> list[np.ndarray]:
    """Local optima of the reprojection error, from the solutions of three points each (OpenCV's P3P)."""
    import cv2

    eye, poses = np.eye(3), []
    for triple in islice(combinations(range(points.shape[0]), 3), TRIPLES):
        rows = list(triple)
        _, turns, shifts = cv2.solveP3P(points[rows], uv[rows], eye, None, flags=cv2.SOLVEPNP_AP3P)
        for turn, shift in zip(turns, shifts, strict=True):
            if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
                continue
            turn, shift = cv2.solvePnPRefineLM(points, uv, eye, None, turn.copy(), shift.copy())
            camera_from_world = np.eye(4)
            camera_from_world[:3, :3], camera_from_world[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
            poses.append(SE3.inverse(SE3.from_matrix(camera_from_world)))
    return poses


def _cost(world_from_camera: np.ndarray, points: np.ndarray, uv: np.ndarray) -> float:
    """Sum of squared residuals in normalised coordinates; infinite where a point is behind the camera."""
    x, y, z = SE3.inverse_transform(world_from_camera, points).T
    if not (z > 0.0).all():
        return float("inf")
    return float(np.square(np.stack([x / z, y / z], axis=-1) - uv).sum())
