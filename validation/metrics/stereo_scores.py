"""Scores of a stereo run against ground truth, with those of its odometry alone; every pair counts."""

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.trajectory import Trajectory
from rbpf.runs.truth import RunTruth
from rbpf.systems.stereo.run import StereoRun
from rbpf.validation.metrics.accuracy import ate, rpe
from rbpf.validation.metrics.mono_scores import TruePath, true_path


def score_stereo(run: StereoRun) -> dict[str, float | int]:
    """Entries of summary.json: metres and degrees; none without ground truth."""
    truth = true_path(run.truth, run.stamps_ns)
    if truth is None:
        return {}
    estimate, reference = compared(run, run.world_from_camera, truth)
    alone, _ = compared(run, run.odometry, truth)
    similar, relative = ate(estimate, reference, "similarity"), rpe(estimate, reference, alignment="rigid")
    return {
        "ate_rmse_m": ate(estimate, reference, "rigid").rmse,
        "ate_sim3_rmse_m": similar.rmse,
        "sim3_scale": similar.alignment.scale,
        "vo_ate_rmse_m": ate(alone, reference, "rigid").rmse,
        "vo_ate_sim3_rmse_m": ate(alone, reference, "similarity").rmse,
        "rpe_translation_rmse_m": relative.translation_rmse,
        "rpe_rotation_rmse_deg": relative.rotation_rmse_deg,
        "scored_instants": int(truth.rows.size),
    }


def stereo_truth(run: StereoRun) -> RunTruth | None:
    """The truth at a run's pairs, told from its first one, as the run is; to be aligned where that has no truth."""
    truth = true_path(run.truth, run.stamps_ns)
    if truth is None:
        return None
    if truth.rows[0] != 0:
        return RunTruth(truth.rows, truth.world_from_camera, {}, "rigid")
    return RunTruth(truth.rows, SE3.between(truth.world_from_camera[0], truth.world_from_camera))


def compared(run: StereoRun, poses: np.ndarray, truth: TruePath) -> tuple[Trajectory, Trajectory]:
    """Poses (T, 7) of a run where there is truth, and the truth."""
    stamps = run.stamps_ns[truth.rows]
    return Trajectory(stamps, poses[truth.rows]), Trajectory(stamps, truth.world_from_camera)


def distance_m(world_from_camera: np.ndarray) -> float:
    """Length of a path (T, 7)."""
    steps = np.diff(SE3.translation(world_from_camera), axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())
