"""Where a camera is that sees points of which some are known on a line only: robust least squares."""

from dataclasses import dataclass

import numpy as np

from rbpf.lie import SE3
from rbpf.lie.matrices import skew
from rbpf.sensors.consensus_resection import Resected
from rbpf.sensors.pinhole import Pinhole

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
