"""Scores of a camera's path against ground truth; a frame in which the camera was lost counts like any other."""

from dataclasses import dataclass

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.features import CameraTruth
from rbpf.systems.mono.video import VideoRun
from rbpf.validation.accuracy import ate, rpe
from rbpf.validation.alignment import Alignment
from rbpf.validation.run_files import RunTruth
from rbpf.validation.scores import poses_at
from rbpf.validation.trajectory import Trajectory

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


def camera_truth(run: VideoRun) -> RunTruth | None:
    """The truth at a run's frames: in the same world with known points, else to be moved and scaled."""
    truth = true_path(run.sequence.truth, run.stamps_ns)
    if truth is None:
        return None
    alignment: Alignment = "none" if run.known is not None else "similarity"
    return RunTruth(truth.rows, truth.world_from_camera, {}, alignment)


def score_camera(run: VideoRun) -> dict[str, float | int]:
    """Entries of summary.json: metres and degrees; none without ground truth.

    Without known points the scale is arbitrary, so the relative error is told after the similarity alignment.
    """
    truth = true_path(run.sequence.truth, run.stamps_ns)
    if truth is None:
        return {}
    stamps = run.stamps_ns[truth.rows]
    estimate = Trajectory(stamps, run.world_from_camera[truth.rows])
    reference = Trajectory(stamps, truth.world_from_camera)
    similar = ate(estimate, reference, "similarity")
    relative = rpe(estimate, reference, alignment="rigid" if run.known is not None else "similarity")
    own = {} if run.known is None else {"path_rmse_m": ate(estimate, reference).rmse}
    return {
        "ate_rmse_m": ate(estimate, reference, "rigid").rmse,
        "ate_sim3_rmse_m": similar.rmse,
        "sim3_scale": similar.alignment.scale,
        **own,
        "rpe_translation_rmse_m": relative.translation_rmse,
        "rpe_rotation_rmse_deg": relative.rotation_rmse_deg,
        "scored_instants": int(np.size(truth.rows)),
    }
