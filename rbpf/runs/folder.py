"""Writes a run's folder; its files and their contents are described in docs/run_folder.md."""

import json
import math
import resource
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import save_arrays, whole
from rbpf.lie import SE3
from rbpf.runs import files, measurement_files
from rbpf.runs.plots import FIGURES, VECTORS
from rbpf.runs.provenance import CONFIG, INPUTS, write_config
from rbpf.runs.run import Run
from rbpf.runs.trajectory import in_space, write_tum
from rbpf.runs.truth import TRUTH, write_truth
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.images.calibration import NAME as CAMERA
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.known_map import NAME as KNOWN_MAP
from rbpf.systems.system import DIAGNOSTICS, TIMINGS, TrackingState

#: Names of all files that a run may leave, besides its checkpoint, and its comparisons with their pictures.
RESULTS = (
    files.TRAJECTORY, "trajectory.tum", TRUTH, files.ODOMETRY, files.BATCH, files.MAP, "map.csv", files.POSTERIOR,
    "posterior.tum", KNOWN_MAP, CAMERA, files.GRID, "grid.pgm", "grid.yaml", TIMINGS, DIAGNOSTICS, CONFIG, files.SUMMARY,
    files.VIDEO, files.PAGE, *measurement_files.FILES,
    *(f"{Path(name).stem}.{ending}" for name in (*FIGURES, "ess.png") for ending in ("png", VECTORS)),
)  # fmt: skip
#: Bytes of grid.pgm: occupied, free, unknown.
OCCUPIED, FREE, UNKNOWN = 0, 254, 205
#: Extent of a path, relative to the landmarks' distance, below which depth is hardly observable.
STILL = 0.01
#: Test for dirt on the lens: features that stay within this many px over this many frames, in which others move this far,
#: while the estimated camera stands still or rotates as far; and the least number of them.
STAY_PX, FRAMES, MOVE_PX, FEATURES = 1.5, 30, 5.0, 5


def write_run(run: Run, out: Path, sources: Mapping[str, str | float | bool]) -> dict[str, Any]:
    """Writes all data files of a run, and returns the entries of summary.json; `sources` are the inputs for config.yaml.

    Raises InputError: the folder cannot be written to, or the disk is full.
    """
    files.prepare_folder(out)
    remove_results(out, [Path(str(sources[name])) for name in INPUTS if name in sources])
    log, system = run.log, run.system
    more = {name: log[name] for name in ("correction", "cov_correction") if name in log}
    more |= {"particles": system.particle_poses(), "weights": system.filter.particles.weights}
    write_trajectory(out, log.stamps_ns, log.poses, log.covs, **more)
    write_tum(out / "trajectory.tum", in_space(log.stamps_ns, log.poses))
    if run.truth is not None:
        write_truth(out, run.truth)
    if "odometry" in log:
        write_tum(out / files.ODOMETRY, in_space(log.stamps_ns, log["odometry"]))
    write_map(out, system.map())
    measurement_files.write_measurements(out, system.measurements(run.name, log))
    for table in (TIMINGS, DIAGNOSTICS):
        header, columns = log.table(table)
        files.write_csv(out / table, header, zip(*columns, strict=True))
    for name, arrays in system.files(log).items():
        if isinstance(arrays, str):
            files.write_text(out / name, arrays)
            continue
        save_arrays(out / name, arrays)
        if name == files.POSTERIOR:
            # The mean over the last frame's particles of their whole paths.
            weights = np.exp(arrays["log_weights"])
            (paths,) = (array for key, array in arrays.items() if key.startswith("world_from_"))
            mean = np.array([system.space.mean(poses, weights) for poses in paths])
            write_tum(out / "posterior.tum", in_space(arrays["stamps_ns"], mean))
        if name == files.GRID:
            write_grid(out, arrays)
    write_config(out, system.name, sources, asdict(system.config))
    entries = {"finished": datetime.now(UTC).isoformat(timespec="seconds")} | summarise(run)
    write_summary(out, entries)
    return entries


def remove_results(out: Path, inputs: Iterable[Path] = ()) -> None:
    """Removes what an earlier run left in a folder, but for a checkpoint and for the inputs of the present run."""
    if not any((out / name).exists() for name in (files.TRAJECTORY, files.SUMMARY)):
        return
    kept = {place.resolve() for path in inputs for place in (path, path / CAMERA, path.parent / CAMERA)}
    compared = [*out.glob(f"{files.COMPARISON}*.json")]
    about = [path.stem.removeprefix(files.COMPARISON) for path in compared]
    pictures = [path for name in about for path in out.glob(f"{escape(name)}_*.p[nd][gf]")]
    for path in (*(out / name for name in RESULTS), *compared, *pictures):
        if path.resolve() not in kept:
            path.unlink(missing_ok=True)


def summarise(run: Run) -> dict[str, Any]:
    """The entries of summary.json that need no reference."""
    log, config = run.log, run.system.config
    evidence, (median, p95) = log["log_evidence"], np.percentile(1e3 * log["seconds"], [50, 95]).round(3).tolist()
    linearised = np.isfinite(log["nis"]) & (log["nis_dof"] > 0)
    nis, dof = log["nis"][linearised], log["nis_dof"][linearised]
    return {
        "system": run.system.name,
        "recording": run.name,
        "frames": len(log),
        "particles": config.particles,
        "seed": config.seed,
        "ms_per_frame": {"median": median, "p95": p95},
        "resamplings": int(log["resampled"].sum()),
        "ess_mean": float(log["ess"].mean()),
        "log_evidence": float(np.sum(evidence)) if np.isfinite(evidence).all() else None,
        "nis_per_dof": float(nis.sum() / dof.sum()) if nis.size else None,
        "peak_memory_mb": peak_memory_mb(),
        **run.system.summary(log),
        **({"remarks": found} if (found := remarks(run)) else {}),
        **({"problems": run.messages} if run.messages else {}),
        **({} if run.failure is None else {"failure": run.failure}),
    }


def remarks(run: Run) -> list[str]:
    """Warnings before all figures of a run: nothing measured, no motion, or features fixed in the image."""
    log, landmarks = run.log, run.system.map()
    seen = [state in (TrackingState.TRACKED, TrackingState.INITIALISING) for state in log.states]
    if not any(seen):
        frames = f"the {len(log)} {run.system.frame_word}s"
        return [f"None of {frames} could be measured: the path is what was assumed, and nothing was seen of it."]
    at = in_space(log.stamps_ns, log.poses).positions[:, : landmarks.mean.shape[1]]
    if len(log) < 2 or not len(landmarks.ids):
        return []
    reach = float(np.linalg.norm(at - at[0], axis=1).max())
    distance = float(np.median(np.linalg.norm(landmarks.mean - at[0], axis=1)))
    features = run.system.measurements(run.name, log)
    in_image = _in_the_image(features, log.poses, reach <= STILL * distance) if isinstance(features, FeatureLog) else []
    if reach > STILL * distance or in_image:
        return in_image
    depth = ", from which no depth can be measured" if run.system.gauge == "similarity" else ""
    return [
        f"It stood still, or nearly: the path stays within {round(100.0 * reach / distance, 2):g} % of the landmarks' median "
        f"distance from where it begins{depth}."
    ]


def _in_the_image(features: FeatureLog, poses: np.ndarray, is_still: bool) -> list[str]:
    """A warning if features stay at their pixels while others move, as with dirt on the lens; else empty."""
    names = np.concatenate([frame.landmarks for frame in features.frames])
    steps = np.repeat(np.arange(len(features.frames)), [frame.landmarks.size for frame in features.frames])
    order = np.argsort(names, kind="stable")
    px, steps = np.concatenate([frame.z[:, :2] for frame in features.frames])[order], steps[order]
    _, begin, count = np.unique(names[order], return_index=True, return_counts=True)
    if not count.size:
        return []
    reach = (np.maximum.reduceat(px, begin) - np.minimum.reduceat(px, begin)).max(axis=1)
    lens = features.camera if isinstance(features.camera, Pinhole) else features.camera.camera
    stay = (reach <= STAY_PX) & (count >= FRAMES)
    for row in np.flatnonzero(stay) if not is_still else ():
        seen = poses[steps[begin[row] : begin[row] + count[row]]]
        turn = np.linalg.norm(SE3.log(SE3.between(seen[0], seen))[:, :3], axis=1)
        stay[row] = lens.fx * turn.max() > MOVE_PX
    moved = reach[~stay & (count >= FRAMES // 3)]
    if stay.sum() < FEATURES or moved.size < FEATURES or np.median(moved) < MOVE_PX:
        return []
    return [
        f"{stay.sum()} features stay at their pixels while others move by {np.median(moved):.0f} px: unless something moves "
        "before a camera that stands still, they are dirt on the lens, a border or writing in the images, which take the "
        "camera along; crop or mask them."
    ]


def write_summary(out: Path, entries: Mapping[str, Any]) -> None:
    """summary.json; non-finite numbers become null."""
    plain = {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in entries.items()}
    files.write_text(out / files.SUMMARY, json.dumps(plain, indent=2, allow_nan=False) + "\n")


def write_map(out: Path, found: MapEstimate) -> None:
    """map.npz and map.csv."""
    arrays = {"id": found.ids, "mean": found.mean, "cov": found.cov, **found.columns}
    if found.ray_ends is not None:
        arrays["ray_ends"] = found.ray_ends
    save_arrays(out / files.MAP, arrays)
    axes = "xyz"[: found.mean.shape[1]]
    cov_names = [f"c{axes[a]}{axes[b]}" for a in range(len(axes)) for b in range(a + 1)]
    numbers = np.concatenate([found.mean, gaussian.pack(found.cov)], axis=1).tolist()
    columns = [column.tolist() for column in found.columns.values()]
    rows = ([name, *row, *more] for name, row, *more in zip(found.ids, numbers, *columns, strict=True))
    files.write_csv(out / "map.csv", ["id", *(f"{axis}_m" for axis in axes), *cov_names, *found.columns], rows)


def write_grid(out: Path, grid: Mapping[str, np.ndarray]) -> None:
    """grid.pgm and grid.yaml of grid.npz: one byte per cell, the highest y in the first row."""
    log_odds, (x, y) = grid["log_odds"], grid["corner"].tolist()
    cells = np.select([log_odds > 0.0, log_odds < 0.0], [OCCUPIED, FREE], UNKNOWN).astype(np.uint8)
    height, width = cells.shape
    with whole(out / "grid.pgm") as temporary:
        temporary.write_bytes(f"P5\n{width} {height}\n255\n".encode() + cells[::-1].tobytes())
    place = f"resolution: {float(grid['cell_m']):g}\norigin: [{x:.6f}, {y:.6f}, 0.0]\n"
    limits = "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    files.write_text(out / "grid.yaml", f"image: grid.pgm\nmode: trinary\n{place}{limits}")


def peak_memory_mb() -> float:
    """Peak resident memory of this process."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


def write_trajectory(out: Path, stamps_ns: np.ndarray, mean: np.ndarray, cov: np.ndarray, **more: np.ndarray) -> None:
    """trajectory.npz: poses (T, E), covariances (T, d, d), and further arrays, see `rbpf.runs.reading`; none by default."""
    steps, size = mean.shape
    path = {"version": np.array(files.VERSION), "stamps_ns": stamps_ns, "mean": mean, "cov": cov}
    corrections = {"correction": np.zeros((steps, 0)), "cov_correction": np.zeros((steps, 0, 0))}
    particles = {"particles": np.zeros((0, size)), "weights": np.zeros(0)}
    save_arrays(out / files.TRAJECTORY, path | corrections | particles | more)
