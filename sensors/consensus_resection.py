"""Where a camera is that sees points of which many are mistaken: P3P, consensus, least squares (RANSAC)."""

from dataclasses import dataclass

import numpy as np

from rbpf.lie import SE3
from rbpf.lie.matrices import skew
from rbpf.sensors.pinhole import Pinhole

ROUNDS = 10
"""Of Gauss-Newton; points are taken in and out before each."""


@dataclass(frozen=True)
class Resected:
    """A camera, and the points that say so.

    Attributes:
        world_from_camera: (7,).
        information: (6, 6) JᵀJ of the inliers' pixels at it, right chart, order [ω, v], 1/px².
        inliers: (M,) bool.
        rms_px: of the inliers, per axis, with their degrees of freedom.
    """

    world_from_camera: np.ndarray
    information: np.ndarray
    inliers: np.ndarray
    rms_px: float


def resect_consensus(
    camera: Pinhole,
    points: np.ndarray,
    px: np.ndarray,
    within_px: float,
    triples: int,
    rng: np.random.Generator,
) -> Resected | None:
    """The camera that most points agree with, refined on these.

    Args:
        camera: of the image.
        points: (M, 3) in the world.
        px: (M, 2) where they may be seen.
        within_px: a point agrees if it is seen as near to its projection.
        triples: of points that are tried.
        rng: draws them.

    Returns:
        None where fewer than four agree, or they do not fix the camera.
    """
    if points.shape[0] < 4:
        return None
    poses = three_point_poses(points, camera.unproject(px), triples, rng)
    if not poses.shape[0]:
        return None
    errors = _errors(camera, poses, points, px)
    # The truncated error tells apart poses that as many points agree with (P. Torr and A. Zisserman 2000).
    pose = poses[np.minimum(errors, within_px**2).sum(axis=1).argmin()]
    return refined(camera, pose, points, px, within_px)


def three_point_poses(
    points: np.ndarray, uv: np.ndarray, triples: int, rng: np.random.Generator
) -> np.ndarray:
    """Poses world_from_camera (C, 7) of three of the points (M, 3) each, seen at uv (M, 2) (OpenCV's P3P)."""
    import cv2

    matrices = []
    for _ in range(triples):
        rows = rng.choice(points.shape[0], 3, replace=False)
        if not np.isfinite(uv[rows]).all():
            continue
        _, turns, shifts = cv2.solveP3P(points[rows], uv[rows], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P)
        for turn, shift in zip(turns, shifts, strict=True):
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
            matrices.append(matrix)
    stacked = np.array(matrices).reshape(-1, 4, 4)
    return SE3.inverse(SE3.from_matrix(stacked[np.isfinite(stacked).all(axis=(1, 2))]))


def _errors(camera: Pinhole, poses: np.ndarray, points: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Squared distances (C, M) [px²] between places and projections; infinite behind a camera."""
    seen = SE3.inverse_transform(poses[:, None], points)
    squared = np.square(camera.project(seen) - px).sum(axis=-1)
    return np.where((seen[..., 2] > 0.0) & np.isfinite(squared), squared, np.inf)


def refined(
    camera: Pinhole, pose: np.ndarray, points: np.ndarray, px: np.ndarray, within_px: float
) -> Resected | None:
    """The camera near a first guess that points (M, 3) within so many px of where they are seen (M, 2) agree on.

    Returns:
        None where fewer than four agree, or they do not fix the camera.
    """
    for last in [False] * ROUNDS + [True]:
        squared = _errors(camera, pose[None], points, px)[0]
        inliers = squared <= within_px**2
        seen = SE3.inverse_transform(pose, points[inliers])
        if inliers.sum() < 4:
            return None
        by_pose = np.concatenate([skew(seen), np.broadcast_to(-np.eye(3), (len(seen), 3, 3))], axis=-1)
        jac = camera.jacobian(seen) @ by_pose
        information = np.einsum("kpa,kpb->ab", jac, jac)
        if np.linalg.cond(information) > 1e12:
            return None
        if last:
            break
        miss = px[inliers] - camera.project(seen)
        pose = SE3.retract(pose, np.linalg.solve(information, np.einsum("kpa,kp->a", jac, miss)))
    rms = np.sqrt(squared[inliers].sum() / max(2 * inliers.sum() - 6, 1))
    return Resected(pose, information, inliers, float(rms))
