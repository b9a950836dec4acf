"""Camera poses from known points (perspective-n-point): exact, with outliers, and with points of uncertain depth."""

from dataclasses import dataclass
from itertools import combinations, islice

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, skew
from rbpf.sensors.camera import Pinhole

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


GATE = 9.2
"""Squared Mahalanobis distance within which a point agrees: 99 % of two dimensions."""
WIDER = (16.0, 16.0, 4.0, 4.0, 1.0, 1.0, 1.0, 1.0)
"""Times the gate in each round of Gauss-Newton: a first guess may be some pixels off everywhere."""


@dataclass(frozen=True)
class Sights:
    """M points and where they may be seen.

    Attributes:
        points: (M, 3) in the world.
        spread: (M, 3) standard deviation of each along one direction; zero where it is known.
        px: (M, 2).
        std_px: (M,) of the place in the image, per axis.
    """

    points: np.ndarray
    spread: np.ndarray
    px: np.ndarray
    std_px: np.ndarray

    def __add__(self, other: "Sights") -> "Sights":
        """Both, one after the other."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return Sights(*(np.concatenate(pair) for pair in pairs))


def squared_distances(camera: Pinhole, poses: np.ndarray, sights: Sights) -> np.ndarray:
    """Mahalanobis distances (C, M), squared, of what poses world_from_camera (C, 7) predict; infinite behind them."""
    return _compared(camera, poses, sights)[0]


def refined_on_all(camera: Pinhole, pose: np.ndarray, sights: Sights) -> Resected | None:
    """The camera near a first guess (7,) that most points agree on; its information in 1/px², `rms_px` in σ.

    Returns:
        None where fewer than four agree, or they do not fix the camera.
    """
    for wider in (*WIDER, None):
        squared, miss, seen, white = (array[0] for array in _compared(camera, pose[None], sights))
        inliers = squared <= GATE * (wider or 1.0)
        if inliers.sum() < 4:
            return None
        seen, white = seen[inliers], white[inliers]
        by_pose = np.concatenate([skew(seen), np.broadcast_to(-np.eye(3), (len(seen), 3, 3))], axis=-1)
        jac = white @ camera.jacobian(seen) @ by_pose
        information = np.einsum("kpa,kpb->ab", jac, jac)
        if np.linalg.cond(information) > 1e12:
            return None
        if wider is not None:
            step = np.linalg.solve(information, np.einsum("kpa,kp->a", jac, miss[inliers]))
            pose = SE3.retract(pose, step)
    rms = np.sqrt(squared[inliers].sum() / max(2 * inliers.sum() - 6, 1))
    return Resected(pose, information, inliers, float(rms))


def _compared(
    camera: Pinhole, poses: np.ndarray, sights: Sights
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Squared distances (C, M), whitened misses (C, M, 2), points in the camera (C, M, 3), whitening (C, M, 2, 2).

    With the image's slope d along the spread, the covariance is S = σ² I + d dᵀ, and S^(−1/2) = (I − k d dᵀ) / σ.
    """
    seen = SE3.inverse_transform(poses[:, None], sights.points)
    turn = SE3.inverse_transform(poses[:, None], sights.points + sights.spread) - seen
    std = sights.std_px
    with np.errstate(all="ignore"):
        along = np.einsum("cmpa,cma->cmp", camera.jacobian(seen), turn) / std[:, None]
        length = np.square(along).sum(axis=-1)
        shrink = (1.0 - 1.0 / np.sqrt(1.0 + length)) / np.maximum(length, 1e-300)
        outer = along[..., :, None] * along[..., None, :]
        white = (np.eye(2) - shrink[..., None, None] * outer) / std[:, None, None]
        miss = np.einsum("cmpq,cmq->cmp", white, sights.px - camera.project(seen))
        squared = np.square(miss).sum(axis=-1)
    right = (seen[..., 2] > 0.0) & np.isfinite(squared)
    return np.where(right, squared, np.inf), miss, seen, white
