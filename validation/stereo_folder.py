"""Everything that a stereo run leaves in its folder. Each file is written under a temporary name, then renamed.

trajectory.tum           online filtered mean at every pair; the first camera is the world
trajectory.npz           the same with its covariance; truth.npz: the ground truth at these pairs; see
                         `rbpf.runs.results`
odometry.tum             the path by visual odometry alone
batch.tum                the batch optimum of the same measurements
observations*.csv        the measurements used, by odometry or by the map; see `rbpf.runs.measurement_files`
map.npz, map.csv         landmarks: name, mean, covariance (within + between particles); how often each was seen
timings.csv              milliseconds per pair: whole, features, odometry, matching with the map, filter
diagnostics.csv          features, matches that agree with the motion, landmarks; updates, sample size, evidence, NIS
config.yaml              everything needed to repeat the run
checkpoint.npz           what --resume goes on from
summary.json             the figures
*.png                    pictures
annotated.mp4            the left images with their features
report.html              one page with all figures and pictures
"""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

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
from rbpf.systems.stereo.run import StereoRun
from rbpf.validation.metrics.stereo_scores import score_stereo, stereo_truth

_STAGES = "features", "odometry", "matching", "filter"


def write_stereo_run(
    run: StereoRun, mapped: MapEstimate, out: Path, sources: Mapping[str, str | bool]
) -> dict[str, Any]:
    """Writes all data files of a run.

    Args:
        run: what was filtered.
        mapped: its map.
        out: the run's folder.
        sources: what it was filtered from, for config.yaml: recording, calibration; and what was left out.

    Returns:
        The entries of summary.json.
    """
    prepare_folder(out)
    write_tum(out / "trajectory.tum", Trajectory(run.stamps_ns, run.world_from_camera))
    write_tum(out / "odometry.tum", Trajectory(run.stamps_ns, run.odometry))
    write_map(out, mapped)
    write_trajectory(out, run.stamps_ns, run.world_from_camera, run.cov)
    write_truth(out, stereo_truth(run))
    write_measurements(out, run.log())
    _write_tables(run, out)
    write_config(out, "stereo", sources, asdict(run.config))
    entries = summarise_stereo(run, mapped)
    write_summary(out, entries)
    return entries


def summarise_stereo(run: StereoRun, mapped: MapEstimate) -> dict[str, Any]:
    """The entries of summary.json."""
    own = run.summary()
    notes = {"problems": run.notes} if run.notes else {}
    failure = {} if run.failure is None else {"failure": run.failure}
    return {
        "system": "stereo",
        "recording": run.name,
        "frames": int(run.stamps_ns.size),
        "particles": run.config.particles,
        "seed": run.config.seed,
        "ms_per_frame": milliseconds_per_frame(run.seconds),
        "resamplings": int(run.resampled.sum()),
        "nis_per_dof": nis_ratio(run.nis, run.nis_dof),
        "peak_memory_mb": peak_memory_mb(),
        **own,
        **score_stereo(run),
        **notes,
        **failure,
    }


def _write_tables(run: StereoRun, out: Path) -> None:
    """timings.csv and diagnostics.csv."""
    steps = range(run.stamps_ns.size)
    seconds = run.seconds, *(getattr(run, f"seconds_{stage}") for stage in _STAGES)
    columns = ((1e3 * column).round(4).tolist() for column in seconds)
    names = ["step", "milliseconds", *(f"{stage}_ms" for stage in _STAGES)]
    write_csv(out / "timings.csv", names, zip(steps, *columns, strict=True))
    whole = "features", "agreeing", "assumed", "updated", "observed", "resampled", "nis_dof"
    real = "ess", "log_evidence", "nis"
    counts = (getattr(run, name).astype(int).tolist() for name in whole)
    numbers = (getattr(run, name).tolist() for name in real)
    rows = zip(steps, run.stamps_ns.tolist(), *counts, *numbers, strict=True)
    write_csv(out / "diagnostics.csv", ["step", "stamp_ns", *whole, *real], rows)
