"""The batch adjustment of the pixels that a stereo run used, by odometry or map: the best it could have known."""

from typing import Any

from rbpf.errors import InputError
from rbpf.runs.trajectory import Trajectory
from rbpf.systems.stereo.run import StereoRun
from rbpf.validation.gtsam.batch_problem import STEREO_TOLERANCE
from rbpf.validation.gtsam.mono_batch import Batch, Told, adjust_log
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.metrics.mono_scores import true_path

MOST = 300_000
"""Sightings that are adjusted at once after a run: more take minutes and gigabytes, and are left to who asks for it."""


def adjust_stereo(run: StereoRun, limit_s: float | None = None, on_iteration: Told | None = None) -> Batch:
    """Adjusts what a run measured, from where the filter was; the first pose is held, the baseline is the scale.

    Args:
        run: what was filtered.
        limit_s: time after which it is given up; None waits.
        on_iteration: told how far it is.

    Raises:
        InputError: there are too many sightings, too few pairs are connected, it takes too long, or it does not
            converge.
    """
    log = run.log()
    count = sum(frame.landmarks.size for frame in log.frames)
    if count > MOST:
        raise InputError(
            f"the run has {count} sightings, more than the {MOST} that are adjusted in batch with it: "
            "compare it afterwards by rbpf validate RUN --against gtsam"
        )
    return adjust_log(log, run.world_from_camera, limit_s, on_iteration, tolerance=STEREO_TOLERANCE)


def score_stereo_batch(run: StereoRun, batch: Batch) -> dict[str, Any]:
    """Entries of summary.json: the batch's errors as the filter's, and how far the filter is from it."""
    path = batch.trajectory
    ours = Trajectory(path.stamps_ns, run.world_from_camera[batch.frames])
    entries: dict[str, Any] = {
        "batch_frames": int(batch.frames.size),
        "batch_observations": int(sum(frame.landmarks.size for frame in batch.log.frames)),
        "batch_error": float(batch.solution.error),
    }
    truth = true_path(run.truth, path.stamps_ns)
    if truth is not None:
        stamps = path.stamps_ns[truth.rows]
        found = Trajectory(stamps, path.world_from_body[truth.rows])
        reference = Trajectory(stamps, truth.world_from_camera)
        entries["batch_ate_rmse_m"] = ate(found, reference, "rigid").rmse
        entries["batch_ate_sim3_rmse_m"] = ate(found, reference, "similarity").rmse
    return entries | {"filter_minus_batch_rmse_m": ate(ours, path).rmse}
