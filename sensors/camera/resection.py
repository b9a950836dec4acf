"""Camera poses from known points (perspective-n-point): without outliers, with outliers, and with uncertain points."""

from dataclasses import dataclass
from itertools import combinations, islice

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole

FLAT = 1e-3  #: Points whose second singular value is below this fraction of the first lie on a line.
TRIPLES = 20  #: Maximum number of triples tried; four points have four.


def resect(camera: Pinhole, points: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Pose world_from_camera (7,) of least reprojection error of points (M, 3) in the world, seen at px (M, 2).

    Every P3P solution of the first triples of points is refined on all points, because few points leave several local
    optima and a single start may reach the wrong one. Raises InputError: there are fewer than four points, they are
    collinear, or no pose has all of them in front of the camera.
    """
    if points.shape[0] < 4:
        raise InputError(f"initialisation from known points needs at least four in the image, got {points.shape[0]}")
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] <= FLAT * spread[0]:
        raise InputError("the known points lie on a line: add one off it, else the rotation about it is undetermined")
    uv = camera.unproject(px)
    if not np.isfinite(uv).all():
        raise InputError("a known point's pixel has no ray under the camera's distortion: check the calibration")
    # Local optima of the reprojection error, from the solutions of the first triples of points.
    import cv2

    matrices, eye = [], np.eye(3)
    for triple in islice(combinations(range(points.shape[0]), 3), TRIPLES):
        for turn, shift in _p3p(points[list(triple)], uv[list(triple)]):
            matrices.append(_matrix(*cv2.solvePnPRefineLM(points, uv, eye, None, turn.copy(), shift.copy())))
    # Their sums of squared residuals in normalised coordinates; infinite where a point is behind the camera.
    poses = SE3.inverse(SE3.from_matrix(np.array(matrices).reshape(-1, 3, 4)))
    seen = SE3.inverse_transform(poses[:, None], points)
    with np.errstate(all="ignore"):
        costs = np.square(seen[..., :2] / seen[..., 2:] - uv).sum(axis=(1, 2))
    costs = np.where((seen[..., 2] > 0.0).all(axis=1) & np.isfinite(costs), costs, np.inf)
    if not costs.size or not np.isfinite(costs.min()):
        raise InputError("no camera pose has all known points in front of it: check their names and order")
    return poses[int(np.argmin(costs))]


def three_point_poses(points: np.ndarray, uv: np.ndarray, triples: int, rng: np.random.Generator) -> np.ndarray:
    """P3P poses world_from_camera (C, 7) of random triples of the points (M, 3), seen at uv (M, 2)."""
    matrices = []
    for _ in range(triples):
        rows = rng.choice(points.shape[0], 3, replace=False)
        if np.isfinite(uv[rows]).all():
            matrices += [_matrix(turn, shift) for turn, shift in _p3p(points[rows], uv[rows])]
    return SE3.inverse(SE3.from_matrix(np.array(matrices).reshape(-1, 3, 4)))


def _p3p(points: np.ndarray, uv: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The solutions of three points (3, 3) seen at uv (3, 2): rotation vector and translation of camera_from_world."""
    import cv2

    _, turns, shifts = cv2.solveP3P(points, uv, np.eye(3), None, flags=cv2.SOLVEPNP_AP3P)
    both = zip(turns, shifts, strict=True)
    return [(turn, shift) for turn, shift in both if np.isfinite(turn).all() and np.isfinite(shift).all()]


def _matrix(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """(3, 4) of a rotation vector and a translation as OpenCV gives them."""
    import cv2

    return np.column_stack([cv2.Rodrigues(turn)[0], shift])


ROUNDS = 10  #: Gauss-Newton steps; the inliers are reselected before each.


@dataclass(frozen=True)
class Resected:
    """A camera pose world_from_camera (7,), and its `inliers` (M,)."""

    world_from_camera: np.ndarray
    information: np.ndarray  #: (6, 6) JᵀJ of the inliers' residuals, right chart, order [ω, v].
    inliers: np.ndarray
    rms_px: float  #: residual of the inliers per axis, corrected for the degrees of freedom.


def resect_consensus(
    camera: Pinhole, points: np.ndarray, px: np.ndarray, within_px: float, triples: int, rng: np.random.Generator
) -> Resected | None:
    """RANSAC: the pose of lowest truncated error, refined on its inliers, points (M, 3) `within_px` of px (M, 2).

    Returns:
        None with fewer than four inliers, or if they do not determine the pose.
    """
    if points.shape[0] < 4:
        return None
    poses = three_point_poses(points, camera.unproject(px), triples, rng)
    if not poses.shape[0]:
        return None
    errors = squared_distances(camera, poses, Sights.known(points, px))
    # The truncated error ranks poses with equal numbers of inliers (P. Torr and A. Zisserman 2000).
    pose = poses[np.minimum(errors, within_px**2).sum(axis=1).argmin()]
    return refined(camera, pose, points, px, within_px)


def refined(camera: Pinhole, pose: np.ndarray, points: np.ndarray, px: np.ndarray, within_px: float) -> Resected | None:
    """`refined_on_all` for known points (M, 3), which are inliers within `within_px` of px (M, 2)."""
    return refined_on_all(camera, pose, Sights.known(points, px), (within_px**2,) * (ROUNDS + 1))


GATE = 9.2  #: Squared Mahalanobis distance of inliers: 99 % quantile in two dimensions.
#: Gates of each Gauss-Newton step and of the result; wide at first, as the first guess may be pixels off.
GATES = tuple(GATE * wider for wider in (16.0, 16.0, 4.0, 4.0, 1.0, 1.0, 1.0, 1.0, 1.0))


@dataclass(frozen=True)
class Sights:
    """M points (M, 3) in the world and their measured pixels px (M, 2) with standard deviation `std_px` (M,) per axis.

    `spread` (M, 3) is the standard deviation of each point along one direction; zero for a known point.
    """

    points: np.ndarray
    spread: np.ndarray
    px: np.ndarray
    std_px: np.ndarray

    @classmethod
    def known(cls, points: np.ndarray, px: np.ndarray, std_px: float = 1.0) -> "Sights":
        """Of known points, all with the same pixel noise."""
        return cls(points, np.zeros_like(points), px, np.full(len(px), std_px))

    def __add__(self, other: "Sights") -> "Sights":
        """Both, concatenated."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return Sights(*(np.concatenate(pair) for pair in pairs))


def squared_distances(camera: Pinhole, poses: np.ndarray, sights: Sights) -> np.ndarray:
    """Squared Mahalanobis distances (C, M) from predictions of poses (C, 7); infinite for points behind a camera."""
    return _compared(camera, poses, sights)[0]


def refined_on_all(camera: Pinhole, pose: Array, sights: Sights, gates: tuple[float, ...] = GATES) -> Resected | None:
    """Refines a first guess world_from_camera (7,) on its inliers.

    Its `information` and `rms_px` are in σ. `gates` are the squared distances of inliers, for each Gauss-Newton step and
    for the result. None with fewer than four inliers, or if they do not determine the pose.
    """
    for rounds_left in range(len(gates))[::-1]:
        squared, miss, seen, white = (array[0] for array in _compared(camera, pose[None], sights))
        inliers = squared <= gates[-1 - rounds_left]
        if inliers.sum() < 4:
            return None
        seen, white = seen[inliers], white[inliers]
        jac = -white @ camera.jacobian(seen) @ SE3.transform_jacobian(seen)
        information = np.einsum("kpa,kpb->ab", jac, jac)
        if np.linalg.cond(information) > 1e12:
            return None
        if rounds_left:
            step = np.linalg.solve(information, np.einsum("kpa,kp->a", jac, miss[inliers]))
            pose = SE3.retract(pose, step)
    rms = np.sqrt(squared[inliers].sum() / max(2 * inliers.sum() - 6, 1))
    return Resected(pose, information, inliers, float(rms))


def _compared(camera: Pinhole, poses: Array, sights: Sights) -> tuple[Array, Array, Array, Array]:
    """Squared distances (C, M), whitened residuals (C, M, 2), points in the camera (C, M, 3), whitening (C, M, 2, 2).

    With d, the spread projected to the image, the covariance is S = σ² I + d dᵀ, and S^(−1/2) = (I − k d dᵀ) / σ.
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
