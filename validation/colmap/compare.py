"""How far a path and a map are from COLMAP's reconstruction: camera centres, and distances between the clouds.

COLMAP's world and scale are its own: its cameras are brought onto the reference's by the best similarity, or by the
best rigid motion where a stereo pair gave the scale. Then one metre is the reference's.
"""

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.runs.alignment import Similarity
from rbpf.runs.trajectory import Trajectory, associate
from rbpf.runs.truth import poses_at
from rbpf.sensors.feature_log import CameraTruth
from rbpf.validation.colmap.cloud_distance import CloudDistance, cloud_distance
from rbpf.validation.colmap.pipeline import LEAST_FRAMES
from rbpf.validation.colmap.reconstruct import Reconstruction
from rbpf.validation.metrics.accuracy import AbsoluteError, ate


@final
@dataclass(frozen=True, eq=False)
class ColmapComparison:
    """COLMAP beside a reference: the filter, or the truth.

    Attributes:
        reconstruction: what COLMAP found.
        path: distances of the camera centres, after the alignment that fits these best.
        reference_from_colmap: brings COLMAP's world onto the reference's, by the cameras' orientations and centres.
        cloud: distances of the reference's landmarks; None without.
        extent_m: diagonal of the box that holds the reference's camera centres.
    """

    reconstruction: Reconstruction
    path: AbsoluteError
    reference_from_colmap: Similarity
    cloud: CloudDistance | None
    extent_m: float

    def as_dict(self) -> dict[str, Any]:
        """Figures for JSON."""
        return {
            **self.reconstruction.as_dict(),
            "alignment": "rigid" if self.reconstruction.metric else "similarity",
            "scale": self.path.alignment.scale,
            "compared_frames": len(self.path.keys),
            "ate_rmse_m": self.path.rmse,
            "ate_median_m": self.path.median,
            "ate_max_m": self.path.max,
            "extent_m": self.extent_m,
            **({} if self.cloud is None else self.cloud.as_dict()),
        }


def compare_with_path(
    found: Reconstruction,
    reference: Trajectory,
    landmarks: Array | None = None,
    cov_landmarks: Array | None = None,
) -> ColmapComparison:
    """COLMAP beside a filter's path and, if given, its map.

    Args:
        found: the reconstruction.
        reference: poses of the camera; those at the key frames' times are compared.
        landmarks: (M, 3) in the reference's world.
        cov_landmarks: (M, 3, 3) of them.

    Raises:
        InputError: the two share too few instants.
    """
    ours, theirs = associate(found.path, reference)
    if len(ours) < LEAST_FRAMES:
        raise InputError(
            f"COLMAP's key frames of {found.name} and the path share {len(ours)} instants, expected "
            f"{LEAST_FRAMES} or more for an alignment."
        )
    errors = ate(ours, theirs, "rigid" if found.metric else "similarity")
    move, cloud = align_cameras(ours, theirs, not found.metric), None
    if landmarks is not None and len(landmarks):
        cloud = cloud_distance(move.transform(found.points), landmarks, cov_landmarks)
    return ColmapComparison(
        found, errors, move, cloud, float(np.linalg.norm(np.ptp(theirs.positions, axis=0)))
    )


def align_cameras(estimate: Trajectory, reference: Trajectory, with_scale: bool) -> Similarity:
    """The similarity of the mean rotation between the cameras, and of the scale and shift that then fit the centres.

    Centres on a short or straight path leave the rotation open, and points far from it would be far off.
    """
    mine, theirs = estimate.world_from_body, reference.world_from_body
    turns = SE3.compose(theirs, SE3.inverse(mine))
    turns[:, 4:] = 0.0
    rotation = SE3.rotation(SE3.mean(turns, np.full(len(turns), 1.0 / len(turns))))
    x, y = mine[:, 4:] @ rotation.T, theirs[:, 4:]
    dx, dy = x - x.mean(axis=0), y - y.mean(axis=0)
    square = float(np.square(dx).sum())
    scale = float((dx * dy).sum() / square) if with_scale and square > 0.0 else 1.0
    return Similarity(scale, rotation, y.mean(axis=0) - scale * x.mean(axis=0))


def compare_with_truth(found: Reconstruction, truth: CameraTruth | None) -> ColmapComparison:
    """COLMAP beside the truth, interpolated at the key frames.

    Raises:
        InputError: there is no truth, or too little of it.
    """
    if truth is None:
        raise InputError(
            f"{found.name} has no ground truth to compare with; compare with a run's path instead."
        )
    rows, poses = poses_at(SE3, truth.stamps_ns, truth.world_from_camera, found.stamps_ns)
    if len(rows) < LEAST_FRAMES:
        raise InputError(
            f"The ground truth of {found.name} covers {len(rows)} of {len(found.frames)} key frames, expected "
            f"{LEAST_FRAMES} or more; its stamps must be those of the images' clock."
        )
    return compare_with_path(found, Trajectory(found.stamps_ns[rows], poses))
