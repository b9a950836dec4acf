"""Camera poses from known points (perspective-n-point): exact, with outliers, and with points of uncertain depth."""

from dataclasses import dataclass
from itertools import combinations, islice

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole

FLAT = 1e-3  #: Points whose second spread is below this fraction of the first lie on a line.
TRIPLES = 20  #: Triples of points that are tried; four points have four.


def resect(camera: Pinhole, points: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Pose world_from_camera (7,) of least reprojection error of points (M, 3) in the world, seen at px (M, 2).

    Every solution of the first triples of points is refined on all of them, because few points have several local
    optima and a single start may find the wrong one. Raises InputError: there are fewer than four points, they lie on a
    line, or no pose in front of them explains them.
    """
    if points.shape[0] < 4:
        raise InputError(f"a start from known points needs at least four that are seen, got {points.shape[0]}")
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] <= FLAT * spread[0]:
        raise InputError("the known points lie on a line: add one beside it, the camera could turn around them")
    uv = camera.unproject(px)
    if not np.isfinite(uv).all():
        raise InputError("a known point is seen where the camera's distortion has no direction: check the calibration")
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
        raise InputError("no camera in front of the known points sees them as measured: check their names and order")
    return poses[int(np.argmin(costs))]


def three_point_poses(points: np.ndarray, uv: np.ndarray, triples: int, rng: np.random.Generator) -> np.ndarray:
    """Poses world_from_camera (C, 7) of three of the points (M, 3) each, seen at uv (M, 2), drawn `triples` times."""
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


ROUNDS = 10  #: Of Gauss-Newton; points are taken in and out before each.


@dataclass(frozen=True)
class Resected:
    """A camera world_from_camera (7,), and the points that say so, `inliers` (M,)."""

    world_from_camera: np.ndarray
    information: np.ndarray  #: (6, 6) JᵀJ of the inliers' pixels at it, right chart, order [ω, v], 1/px².
    inliers: np.ndarray
    rms_px: float  #: of the inliers, per axis, with their degrees of freedom.


def resect_consensus(
    camera: Pinhole, points: np.ndarray, px: np.ndarray, within_px: float, triples: int, rng: np.random.Generator
) -> Resected | None:
    """The camera that most points (M, 3) agree with, refined on these; they agree if seen at px (M, 2) `within_px`.

    Returns:
        None where fewer than four agree, or they do not fix the camera.
    """
    if points.shape[0] < 4:
        return None
    poses = three_point_poses(points, camera.unproject(px), triples, rng)
    if not poses.shape[0]:
        return None
    errors = squared_distances(camera, poses, Sights.known(points, px))
    # The truncated error tells apart poses that as many points agree with (P. Torr and A. Zisserman 2000).
    pose = poses[np.minimum(errors, within_px**2).sum(axis=1).argmin()]
    return refined(camera, pose, points, px, within_px)


def refined(camera: Pinhole, pose: np.ndarray, points: np.ndarray, px: np.ndarray, within_px: float) -> Resected | None:
    """`refined_on_all` of points (M, 3) that are known and agree if they are seen (M, 2) within so many px."""
    return refined_on_all(camera, pose, Sights.known(points, px), (within_px**2,) * (ROUNDS + 1))


GATE = 9.2  #: Squared Mahalanobis distance within which a point agrees: 99 % of two dimensions.
#: Of each round of Gauss-Newton, and of the result: a first guess may be some pixels off everywhere.
GATES = tuple(GATE * wider for wider in (16.0, 16.0, 4.0, 4.0, 1.0, 1.0, 1.0, 1.0, 1.0))


@dataclass(frozen=True)
class Sights:
    """M points (M, 3) in the world and where they may be seen, px (M, 2) with `std_px` (M,) per axis.

    `spread` (M, 3) is the standard deviation of each point along one direction; zero where it is known.
    """

    points: np.ndarray
    spread: np.ndarray
    px: np.ndarray
    std_px: np.ndarray

    @classmethod
    def known(cls, points: np.ndarray, px: np.ndarray, std_px: float = 1.0) -> "Sights":
        """Of points that are known, seen equally well."""
        return cls(points, np.zeros_like(points), px, np.full(len(px), std_px))

    def __add__(self, other: "Sights") -> "Sights":
        """Both, one after the other."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return Sights(*(np.concatenate(pair) for pair in pairs))


def squared_distances(camera: Pinhole, poses: np.ndarray, sights: Sights) -> np.ndarray:
    """Mahalanobis distances (C, M), squared, of what poses world_from_camera (C, 7) predict; infinite behind them."""
    return _compared(camera, poses, sights)[0]


def refined_on_all(camera: Pinhole, pose: Array, sights: Sights, gates: tuple[float, ...] = GATES) -> Resected | None:
    """The camera near a first guess world_from_camera (7,) that most points agree on.

    Its information is in 1/px², `rms_px` in σ. `gates` are the squared distances within which a point agrees, in each
    round of Gauss-Newton and at its end. None where fewer than four agree, or they do not fix the camera.
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
