"""Everything that a run over images leaves in its folder. Each file is written under a temporary name, then renamed.

trajectory.tum           online filtered mean at every frame, in the world of the known points, else of the first camera
posterior.tum            mean over the last frame's particles of their whole paths, which later frames have sharpened
posterior.npz            these paths (T, N, 7) and the particles' log-weights
batch.tum                batch optimum of the same measurements, of the frames that took part
observations*.csv        the measurements used, and the known points
trajectory.npz           the same with its covariance; truth.npz: the ground truth at these frames; see
                         `rbpf.runs.results`
known_map.npz            the points with what they look like, for --map; see `rbpf.systems.mono.known_map`
map.npz, map.csv         landmarks: id, mean, covariance (within + between particles); whether it is a ray, was known
timings.csv              milliseconds per frame and stage; and waiting for the decoded image
diagnostics.csv          what was looked for and found, whether the camera was lost; sample size, evidence, NIS
config.yaml              everything needed to repeat the run
checkpoint.npz           what --resume goes on from
summary.json             the figures
*.png, annotated.mp4     pictures; every frame with what was looked for in it
report.html              one page with all figures and pictures
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

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
from rbpf.runs.provenance import write_config
from rbpf.runs.trajectory import Trajectory, write_tum
from rbpf.runs.truth import write_truth
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.known_map import NAME, write_known_map
from rbpf.systems.mono.video import VideoRun
from rbpf.validation.metrics.mono_scores import camera_truth, score_camera
from rbpf.validation.mono_log import feature_log
from rbpf.validation.mono_posterior import write_posterior


def write_mono_run(
    run: VideoRun, mapped: MapEstimate, out: Path, sources: dict[str, str | float | bool]
) -> dict[str, Any]:
    """Writes all data files of a run.

    Args:
        run: what was filtered.
        mapped: its map.
        out: the run's folder.
        sources: what it was filtered from, for config.yaml: recording, known_points, board, calibration, known_map.

    Returns:
        The entries of summary.json.
    """
    prepare_folder(out)
    write_tum(out / "trajectory.tum", Trajectory(run.stamps_ns, run.world_from_camera))
    write_trajectory(out, run.stamps_ns, run.world_from_camera, run.cov)
    write_truth(out, camera_truth(run))
    write_map(out, mapped)
    if run.mapped is None:
        write_known_map(out / NAME, run.slam.export_map(run.world_from_camera[~run.lost.astype(bool)]))
    write_posterior(run, out)
    write_measurements(out, feature_log(run))
    _write_tables(run, out)
    write_config(out, "mono", sources, asdict(run.config))
    entries = summarise_camera(run, mapped)
    write_summary(out, entries)
    return entries


def found_at(run: VideoRun) -> int | None:
    """The first frame in which a camera was where the filter believes; None where there is none."""
    tracked = np.flatnonzero(~run.lost.astype(bool))
    return int(tracked[0]) if tracked.size else None


def summarise_camera(run: VideoRun, mapped: MapEstimate) -> dict[str, Any]:
    """The entries of summary.json."""
    lost = run.lost.astype(bool)
    looked = run.searched > 0
    hits = float(run.found[looked].sum() / run.searched[looked].sum()) if looked.any() else 0.0
    problems = {"problems": run.problems} if run.problems else {}
    failure = {} if run.failure is None else {"failure": run.failure}
    return {
        "system": "mono",
        "recording": run.sequence.name,
        "frames": int(run.stamps_ns.size),
        "frames_tracked": int((~lost).sum()),
        "lost_frames": int(lost.sum()),
        "relocalisations": len(run.relocalisations),
        "known_points": run.given,
        **({} if run.mapped is None else {"localized": True, "found_at_frame": found_at(run)}),
        "particles": run.config.particles,
        "seed": run.config.seed,
        "ms_per_frame": milliseconds_per_frame(run.seconds),
        "landmarks_full": int((~mapped.is_ray()).sum()),
        "landmarks_partial": int(mapped.is_ray().sum()),
        "observations_per_frame": float(run.found.mean()),
        "share_found": hits,
        "resamplings": int(run.resampled.sum()),
        "ess_mean": float(run.ess.mean()),
        "log_evidence": float(np.sum(run.log_evidence)) if np.isfinite(run.log_evidence).all() else None,
        "nis_per_dof": nis_ratio(run.nis, run.nis_dof),
        "peak_memory_mb": peak_memory_mb(),
        **score_camera(run),
        **problems,
        **failure,
    }


def _write_tables(run: VideoRun, out: Path) -> None:
    """timings.csv and diagnostics.csv."""
    frames = range(run.stamps_ns.size)
    rest = run.seconds - run.seconds_search - run.seconds_new_landmarks
    seconds = (run.seconds, run.seconds_search, rest, run.seconds_new_landmarks, run.seconds_waiting)
    write_csv(
        out / "timings.csv",
        ["step", "milliseconds", "search_ms", "filter_ms", "new_features_ms", "waiting_for_image_ms"],
        zip(frames, *((1e3 * column).round(4).tolist() for column in seconds), strict=True),
    )
    counts = (run.searched, run.found, run.lost, run.resampled)
    searched, found, lost, resampled = (column.astype(int).tolist() for column in counts)
    ess, evidence, nis, dof = (
        column.tolist() for column in (run.ess, run.log_evidence, run.nis, run.nis_dof.astype(int))
    )
    names = [
        "step",
        "stamp_ns",
        "searched",
        "found",
        "lost",
        "ess",
        "resampled",
        "log_evidence",
        "nis",
        "nis_dof",
    ]
    stamps = run.stamps_ns.tolist()
    rows = zip(frames, stamps, searched, found, lost, ess, resampled, evidence, nis, dof, strict=True)
    write_csv(out / "diagnostics.csv", names, rows)
