"""GTSAM and COLMAP (Ceres) on the same adjustment of a run's sightings: two programs that should give one answer.

The known points are held exactly, or without any the run's best seen landmarks: COLMAP has no priors on points.
"""

from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.validation.colmap.adjust import LEAST_HELD, ColmapAdjustment, adjust_by_colmap, with_held
from rbpf.validation.gtsam.camera import CameraEstimate, CameraSolution, solve_features
from rbpf.validation.gtsam.mono_batch import connected_frames

HELD = 4
"""Landmarks that are held where none are known."""


@final
@dataclass(frozen=True, eq=False)
class TwoOptima:
    """Both optima of one problem.

    Attributes:
        log: the problem, with the landmarks that are held as exact known points.
        gtsam: one optimum.
        colmap: the other.
        pose_differences: (T, 6) of the poses in the right chart [rad, m].
        landmark_differences_m: (L,) distances of the free landmarks.
        pose_covariance_errors: (T,) Frobenius norms of the covariances' differences over those of GTSAM's.
        landmark_covariance_errors: (L,) likewise.
    """

    log: FeatureLog
    gtsam: CameraSolution
    colmap: ColmapAdjustment
    pose_differences: Array
    landmark_differences_m: Array
    pose_covariance_errors: Array
    landmark_covariance_errors: Array

    def as_dict(self) -> dict[str, Any]:
        """The largest of each, for JSON."""
        return {
            "frames": len(self.pose_differences),
            "landmarks": len(self.landmark_differences_m),
            "held": 0 if self.log.known is None else len(self.log.known.names),
            "error_gtsam": self.gtsam.error,
            "error_colmap": self.colmap.error,
            "pose_difference_max": float(np.abs(self.pose_differences).max()),
            "landmark_difference_max_m": float(self.landmark_differences_m.max(initial=0.0)),
            "pose_covariance_error_max": float(self.pose_covariance_errors.max()),
            "landmark_covariance_error_max": float(self.landmark_covariance_errors.max(initial=0.0)),
        }


def adjust_by_both(log: FeatureLog, world_from_camera: Array) -> TwoOptima:
    """Adjusts a log by both optimisers, from the same poses.

    Landmarks that the sightings do not determine are left out of both.

    Args:
        log: of one camera, all pixels with the same isotropic noise.
        world_from_camera: (T, 7) where both begin, such as a run's path.

    Raises:
        InputError: too little is seen to fix the gauge, or an optimiser does not converge.
    """
    frames = connected_frames(log)
    if frames.size < 2:
        raise InputError(f"{log.name}: no two frames share enough landmarks for a batch adjustment.")
    log = replace(log, frames=[log.frames[t] for t in frames.tolist()])
    start = world_from_camera[frames]
    free = solve_features(log, CameraEstimate(start, {}), marginals=False)
    settled = {name: free.landmarks[name] for name in sorted(free.landmarks.keys() - set(free.undetermined))}
    held = _held(log, settled)
    problem = with_held(_only(log, settled), held)
    gtsam = solve_features(problem, CameraEstimate(free.world_from_camera, settled | held))
    colmap = adjust_by_colmap(problem, CameraEstimate(start, settled | held))
    names = sorted(colmap.landmarks.keys() - held.keys())
    return TwoOptima(
        log=problem,
        gtsam=gtsam,
        colmap=colmap,
        pose_differences=SE3.local(gtsam.world_from_camera, colmap.world_from_camera),
        landmark_differences_m=np.array(
            [np.linalg.norm(gtsam.landmarks[name] - colmap.landmarks[name]) for name in names]
        ),
        pose_covariance_errors=_errors(colmap.cov_poses, gtsam.cov_poses),
        landmark_covariance_errors=_errors(
            *(np.array([one.cov_landmarks[name] for name in names]) for one in (colmap, gtsam))
        ),
    )


def _held(log: FeatureLog, settled: dict[int, Array]) -> dict[int, Array]:
    """Known points where they are said to be; else, of the landmarks seen most often, those farthest apart."""
    if log.known is not None:
        given = dict(zip(log.known.names.tolist(), log.known.positions, strict=True))
        return {name: point for name, point in given.items() if name in settled}
    names, counts = np.unique(np.concatenate([frame.landmarks for frame in log.frames]), return_counts=True)
    often = [name for name in names[np.argsort(-counts, kind="stable")].tolist() if name in settled]
    candidates = often[: max(len(often) // 2, LEAST_HELD)]
    chosen = candidates[:1]
    while len(chosen) < min(HELD, len(candidates)):
        gaps = [
            min(np.linalg.norm(settled[name] - settled[other]) for other in chosen) for name in candidates
        ]
        chosen.append(candidates[int(np.argmax(gaps))])
    return {name: settled[name] for name in chosen}


def _only(log: FeatureLog, settled: dict[int, Array]) -> FeatureLog:
    names, frames = np.array(list(settled), dtype=np.int64), []
    for frame in log.frames:
        kept = np.isin(frame.landmarks, names)
        frames.append(FeatureFrame(frame.stamp_ns, frame.landmarks[kept], frame.z[kept], frame.cov_z[kept]))
    return replace(log, frames=frames)


def _errors(found: Array, expected: Array) -> Array:
    def norm(cov: Array) -> Array:
        return np.sqrt(np.square(cov).sum((-1, -2)))

    return norm(found - expected) / norm(expected)
