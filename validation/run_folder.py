"""Everything that a run leaves in its folder. Each file is written under a temporary name, then renamed.

trajectory.tum           online filtered mean at every step
trajectory.npz           the same with its covariance; truth.npz: the ground truth at these steps; see
                         `rbpf.runs.results`
map.npz, map.csv         landmarks: id, mean, covariance (within + between particles)
observations.csv, observations_odometry.csv   the measurements used; see `rbpf.runs.measurement_files`
timings.csv              milliseconds per step
diagnostics.csv          effective sample size, resampling, log-evidence, NIS per step
config.yaml              everything needed to repeat the run
summary.json             the figures
*.png, report.html       pictures, and one page with all of them
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.lie import SE2Group
from rbpf.runs.files import prepare_folder, write_csv
from rbpf.runs.folder import (
    milliseconds_per_frame,
    nis_ratio,
    peak_memory_mb,
    write_map,
    write_summary,
    write_trajectory,
)
from rbpf.runs.measurement_files import write_measurements
from rbpf.runs.provenance import left_out, write_config
from rbpf.runs.trajectory import write_tum
from rbpf.runs.truth import write_truth
from rbpf.sensors.readers.measurements import Measurements
from rbpf.systems.map_estimate import MapEstimate, estimate_map
from rbpf.systems.range_bearing.run import Run
from rbpf.validation.metrics.scores import Scores, as_trajectory, score
from rbpf.validation.run_truth import robot_truth


def write_run(
    run: Run, out: Path, recording: Path, extra: dict[str, Any] | None = None, batch: bool = True
) -> dict[str, Any]:
    """Writes all data files of a run.

    Args:
        run: what was filtered.
        out: the run's folder.
        recording: where the log lies, for config.yaml.
        extra: further entries of summary.json.
        batch: whether the batch optimum is asked for, for config.yaml.

    Returns:
        The entries of summary.json.
    """
    prepare_folder(out)
    log, progress = run.log, run.progress
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    write_tum(out / "trajectory.tum", as_trajectory(log, stamps, progress.mean))
    write_trajectory(out, stamps, progress.mean, progress.cov, (progress.correction, progress.cov_correction))
    write_truth(out, robot_truth(log))
    summary_map = estimate_map(run.filter, run.anchored)
    write_map(out, summary_map)
    write_measurements(out, used_measurements(run))
    write_csv(out / "timings.csv", ["step", "milliseconds"], enumerate(np.round(progress.seconds * 1e3, 4)))
    columns = (
        progress.ess,
        progress.resampled.astype(int),
        progress.log_evidence,
        progress.nis,
        progress.rows,
    )
    write_csv(
        out / "diagnostics.csv",
        ["step", "stamp_ns", "ess", "resampled", "log_evidence", "nis", "nis_dof"],
        zip(range(stamps.size), stamps, *(column.tolist() for column in columns), strict=True),
    )
    write_config(
        out, "range-bearing", {"recording": str(recording)} | left_out(batch=batch), asdict(run.config)
    )
    entries = summarise(run, summary_map) | (extra or {})
    write_summary(out, entries)
    return entries


def used_measurements(run: Run) -> Measurements:
    """The odometry, and every sighting that the filter used or started a landmark from."""
    log = run.log
    keep = [np.flatnonzero(ids >= 0) for ids in run.associations]
    steps = np.repeat(np.arange(len(keep)), [rows.size for rows in keep])

    def gathered(name: str, shape: tuple[int, ...]) -> np.ndarray:
        parts = [getattr(frame, name)[rows] for frame, rows in zip(log.frames, keep, strict=True)]
        return np.concatenate([np.zeros((0, *shape)), *parts])

    p = 2 if isinstance(log.space, SE2Group) else 3
    d, moves = log.space.dim, log.frames[1:]
    return Measurements(
        recording=log.name,
        space=log.space,
        measurement=log.measurement,  # type: ignore[arg-type]
        pitch_sign=log.pitch_sign,
        robot_from_sensor=log.robot_from_sensor,
        start=log.space.identity(),
        stamps_ns=np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64),
        deltas=np.array([frame.delta for frame in moves], dtype=float).reshape(-1, log.space.size),
        covs=np.array([frame.cov_delta for frame in moves], dtype=float).reshape(-1, d, d),
        steps=steps,
        landmarks=np.concatenate([np.zeros(0, dtype=np.int64), *(i[i >= 0] for i in run.associations)]),
        z=gathered("z", (p,)),
        cov_z=gathered("cov_z", (p, p)),
    )


def summarise(run: Run, summary_map: MapEstimate) -> dict[str, Any]:
    """The entries of summary.json."""
    progress, config = run.progress, run.config
    scores = score(run.log, progress.mean, summary_map.named(), config.association == "ml")
    evidence = run.filter.log_evidence
    return {
        "system": "range-bearing",
        "recording": run.log.name,
        "frames": len(run.log.frames),
        "particles": config.particles,
        "seed": config.seed,
        "ms_per_frame": milliseconds_per_frame(progress.seconds),
        "landmarks": int(summary_map.ids.size),
        "observations": int(sum((ids >= 0).sum() for ids in run.associations)),
        "resamplings": int(progress.resampled.sum()),
        "ess_mean": float(progress.ess.mean()),
        "log_evidence": evidence if np.isfinite(evidence) else None,
        "nis_per_dof": nis_ratio(progress.nis, progress.rows),
        "ancestors_of_first_generation": run.filter.history.distinct_first(),
        "map_share_of_dense": _map_share(run),
        "peak_memory_mb": peak_memory_mb(),
        **reported(scores),
        **({"problems": run.problems} if run.problems else {}),
    }


def reported(scores: Scores, prefix: str = "") -> dict[str, Any]:
    """Scores that exist, as entries of summary.json."""
    return {prefix + name: value for name, value in asdict(scores).items() if value is not None}


def _map_share(run: Run) -> float:
    store = run.filter.belief().map.store
    return round(store.stored_bytes / max(store.dense_bytes, 1), 4)
