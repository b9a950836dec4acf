"""Plain odometry of stereo features, to evaluate features: RANSAC on three points, then least squares."""

from itertools import pairwise

import cv2
import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.descriptors import MatchLimits, match_all
from rbpf.sensors.stereo import StereoFeatures

WITHIN_PX, TRIALS, STEPS, HUBER = 2.0, 200, 12, 1.5


def path(rig: RectifiedStereo, features: list[StereoFeatures], seed: int = 0) -> tuple[np.ndarray, float]:
    """Poses (T, 7), the first the identity, and the mean number of inliers of a motion."""
    cv2.setRNGSeed(seed)
    poses, agreeing = [SE3.identity()], []
    for before, after in pairwise(features):
        matches = match_all(before.descriptors, after.descriptors, MatchLimits())
        now_from_before, kept = motion(rig, before.take(matches.first), after.take(matches.second))
        poses.append(SE3.compose(poses[-1], SE3.inverse(now_from_before)))
        agreeing.append(kept)
    return np.array(poses), float(np.mean(agreeing))


def motion(rig: RectifiedStereo, before: StereoFeatures, after: StereoFeatures) -> tuple[np.ndarray, int]:
    """now_from_before (7,) from features observed twice, and the number of inliers."""
    fx, fy, cx, cy = rig.camera.params[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    _, turn, shift, inliers = cv2.solvePnPRansac(
        before.points,
        np.ascontiguousarray(after.z[:, :2]),
        matrix,
        None,
        iterationsCount=TRIALS,
        reprojectionError=WITHIN_PX,
    )
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    rows = inliers[:, 0]
    return refined(rig, before.take(rows), after.take(rows), SE3.from_matrix(first)), rows.size


def refined(rig: RectifiedStereo, before: StereoFeatures, after: StereoFeatures, pose: np.ndarray) -> np.ndarray:
    """Robust least-squares motion in both images, including the earlier points' errors."""
    for _ in range(STEPS):
        turn = SE3.rotation(pose)
        local = SE3.transform(pose, before.points)
        by_point = rig.jacobian(local) @ turn
        jac = np.concatenate([-by_point @ skew(before.points), by_point], axis=-1)
        cov = after.cov + by_point @ before.cov_points @ by_point.swapaxes(1, 2)
        white = np.linalg.inv(np.linalg.cholesky(cov))
        miss = (white @ (after.z - rig.project(local))[..., None])[..., 0]
        jac = white @ jac
        weight = np.minimum(1.0, HUBER / np.maximum(np.linalg.norm(miss, axis=1), 1e-9))
        info = np.einsum("k,kij,kil->jl", weight, jac, jac)
        pose = SE3.retract(pose, np.linalg.solve(info, np.einsum("k,kij,ki->j", weight, jac, miss)))
    return pose


def skew(vectors: np.ndarray) -> np.ndarray:
    """(K, 3, 3) with skew(a) b = a × b."""
    return np.cross(vectors[:, None, :], np.eye(3)).swapaxes(1, 2)
