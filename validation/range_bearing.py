"""A range-bearing run from recording to report: filter, batch optimum, scores, files, pictures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.runs.files import prepare_folder
from rbpf.runs.trajectory import write_tum
from rbpf.sensors.readers import open_log
from rbpf.sensors.readers.measurements import dead_reckoning
from rbpf.systems.map_estimate import estimate_map
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.run import Run, run
from rbpf.validation.consistency.validate import report_run
from rbpf.validation.metrics.scores import as_trajectory, score
from rbpf.validation.report.plots import plot_run
from rbpf.validation.run_folder import reported, used_measurements, write_run

_SHORT = 300
"""Steps up to which dead reckoning is a good enough start for the batch problem."""


def start_run(
    recording: Path,
    config: RangeBearingConfig,
    out: Path | None = None,
    resume: bool = False,
    on_step: Callable[[int, int], None] | None = None,
) -> Run:
    """Reads a log and filters it.

    Args:
        recording: folder or file of a known kind.
        config: all settings.
        out: folder for checkpoints, created where it does not exist; None keeps none.
        resume: go on from the checkpoint in `out`.
        on_step: called with the steps done and their number.

    Raises:
        InputError: the recording or a setting is wrong.
    """
    log = open_log(recording, config.noise)
    if out is not None:
        prepare_folder(out)
    return run(log, config, out, resume, on_step)


def finish_run(finished: Run, recording: Path, out: Path, batch: bool = True) -> dict[str, Any]:
    """Writes all files, pictures and the report of a run; returns the entries of summary.json and the verdict.

    Args:
        finished: what was filtered.
        recording: where the log lies.
        out: the run's folder.
        batch: also solve for the batch optimum of the same measurements, and score it.
    """
    log = finished.log
    measurements = used_measurements(finished)
    paths = {"odometry": dead_reckoning(measurements)}
    extra = reported(score(log, paths["odometry"]), "odometry_")
    if batch:
        path, extra_batch = _solve_batch(finished)
        paths["batch"] = path
        extra |= extra_batch
        stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
        write_tum(out / "batch.tum", as_trajectory(log, stamps, path))
    entries = write_run(finished, out, recording, extra, batch)
    plot_run(finished, estimate_map(finished.filter, finished.anchored), out, paths)
    verdict = report_run(out)
    return entries | {"verdict": verdict.trust, "sentences": verdict.said}


def _solve_batch(finished: Run) -> tuple[np.ndarray, dict[str, Any]]:
    """The batch optimum (T, E), its scores, and how far the filter is from it."""
    from rbpf.validation.gtsam.robot import solve

    log = finished.log
    measurements = used_measurements(finished)
    solution = solve(measurements, marginals=False, incremental=len(measurements.stamps_ns) > _SHORT)
    anonymous = finished.config.association == "ml"
    entries = reported(score(log, solution.world_from_robot, solution.landmarks, anonymous), "batch_")
    at = as_trajectory(log, measurements.stamps_ns, solution.world_from_robot).positions
    ours = as_trajectory(log, measurements.stamps_ns, finished.progress.mean).positions
    entries["batch_error"] = float(solution.error)
    entries["filter_minus_batch_rmse_m"] = float(np.sqrt(np.square(at - ours).sum(axis=1).mean()))
    return solution.world_from_robot, entries
