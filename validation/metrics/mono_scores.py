"""Scores of a camera's path against ground truth; a frame in which the camera was lost counts like any other."""

from dataclasses import dataclass

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.alignment import Alignment
from rbpf.runs.trajectory import Trajectory
from rbpf.runs.truth import RunTruth, poses_at
from rbpf.sensors.feature_log import CameraTruth
from rbpf.systems.mono.video import VideoRun
from rbpf.validation.metrics.accuracy import ate, rpe

LEAST = 3
"""Instants with a true pose that an alignment needs."""


@dataclass(frozen=True)
class TruePath:
    """The truth at the run's own instants.

    Attributes:
        rows: (R,) frames of the run that have a true pose.
        world_from_camera: (R, 7).
    """

    rows: np.ndarray
    world_from_camera: np.ndarray


def true_path(truth: CameraTruth | None, stamps_ns: np.ndarray) -> TruePath | None:
    """The truth interpolated at stamps (T,); None where there is too little of it."""
    if truth is None:
        return None
    rows, poses = poses_at(SE3, truth.stamps_ns, truth.world_from_camera, stamps_ns)
    return TruePath(rows, poses) if rows.size >= LEAST else None


def usual_alignment(run: VideoRun) -> Alignment:
    """How a run's path is brought onto the truth where nothing else is said.

    Not at all with known points in the truth's world; rigidly with known points in a frame of their own, such as a
    chessboard's; with its scale without any.
    """
    if run.mapped is not None:
        return run.mapped.alignment
    if run.known is None:
        return "similarity"
    return "rigid" if run.known.own_frame else "none"


def camera_truth(run: VideoRun) -> RunTruth | None:
    """The truth at a run's frames, and how the path is brought onto it."""
    truth = true_path(run.sequence.truth, run.stamps_ns)
    if truth is None:
        return None
    return RunTruth(truth.rows, truth.world_from_camera, {}, usual_alignment(run))


def score_camera(run: VideoRun) -> dict[str, float | int]:
    """Entries of summary.json for the filter's path; none without ground truth."""
    path = Trajectory(run.stamps_ns, run.world_from_camera)
    return score_path(run.sequence.truth, path, usual_alignment(run))


def score_path(true: CameraTruth | None, path: Trajectory, how: Alignment) -> dict[str, float | int]:
    """Errors of a path: metres and degrees; none without ground truth.

    Args:
        true: ground truth.
        path: of the camera.
        how: what its world has in common with the truth's; without a common scale the relative error is told after
            the similarity alignment.
    """
    truth = true_path(true, path.stamps_ns)
    if truth is None:
        return {}
    stamps = path.stamps_ns[truth.rows]
    estimate = Trajectory(stamps, path.world_from_body[truth.rows])
    reference = Trajectory(stamps, truth.world_from_camera)
    similar = ate(estimate, reference, "similarity")
    relative = rpe(estimate, reference, alignment="similarity" if how == "similarity" else "rigid")
    own = {"path_rmse_m": ate(estimate, reference).rmse} if how == "none" else {}
    return {
        "ate_rmse_m": ate(estimate, reference, "rigid").rmse,
        "ate_sim3_rmse_m": similar.rmse,
        "sim3_scale": similar.alignment.scale,
        **own,
        "rpe_translation_rmse_m": relative.translation_rmse,
        "rpe_rotation_rmse_deg": relative.rotation_rmse_deg,
        "scored_instants": int(np.size(truth.rows)),
    }
