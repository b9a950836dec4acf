"""A run folder in the formats of other programs.

tum      trajectory.tum: a line `time tx ty tz qx qy qz qw` per pose
kitti    trajectory_kitti.txt: the upper 3 × 4 block of each pose's matrix, without times
ply      map.ply and path.ply
colmap   colmap/: a model with the tracks of what was measured, where the run left them
rerun    run.rrd: path and map for the Rerun viewer
npz      run.npz: stamps_ns (T,), world_from_body (T, E), cov_poses (T, d, d); landmark_ids (M,), landmarks (M, D),
         cov_landmarks (M, D, D)
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from rbpf.core.checkpoint import save_arrays
from rbpf.errors import InputError
from rbpf.runs.files import prepare_folder
from rbpf.runs.measurement_files import OBSERVATIONS
from rbpf.runs.path_and_map import PathAndMap
from rbpf.runs.reading import RunFolder
from rbpf.runs.trajectory import write_kitti, write_tum
from rbpf.validation.export import MODEL, export_colmap, export_ply, raised
from rbpf.validation.gtsam.batch_problem import read_problem
from rbpf.validation.report.rerun import AXIS_M, ellipsoids, log_pose, log_time, recording


def export_run(run: Path, formats: Sequence[str], out: Path) -> list[Path]:
    """Writes a run in other formats.

    Args:
        run: folder that `rbpf run` left.
        formats: names in `FORMATS`.
        out: folder for the files.

    Returns:
        What was written.

    Raises:
        InputError: it is no run folder, a format is not known, or its library is not installed.
    """
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise InputError(f"a run is exported as {', '.join(FORMATS)}, not as {unknown[0]}")
    estimate = RunFolder.open(run).estimate
    prepare_folder(out)
    return [path for name in dict.fromkeys(formats) for path in FORMATS[name](run, estimate, out)]


def _tum(_run: Path, estimate: PathAndMap, out: Path) -> list[Path]:
    write_tum(out / "trajectory.tum", estimate.trajectory)
    return [out / "trajectory.tum"]


def _kitti(_run: Path, estimate: PathAndMap, out: Path) -> list[Path]:
    write_kitti(out / "trajectory_kitti.txt", estimate.trajectory)
    return [out / "trajectory_kitti.txt"]


def _ply(_run: Path, estimate: PathAndMap, out: Path) -> list[Path]:
    return [out / name for name in export_ply(estimate, out)]


def _colmap(run: Path, estimate: PathAndMap, out: Path) -> list[Path]:
    problem = read_problem(run) if (run / OBSERVATIONS).exists() else None
    export_colmap(estimate, problem, out / MODEL)
    return [out / MODEL]


def _npz(_run: Path, estimate: PathAndMap, out: Path) -> list[Path]:
    landmarks = estimate.landmarks
    arrays = {
        "stamps_ns": estimate.stamps_ns,
        "world_from_body": estimate.world_from_body,
        "cov_poses": estimate.cov_poses,
        "landmark_ids": landmarks.ids,
        "landmarks": landmarks.mean,
        "cov_landmarks": landmarks.cov,
    }
    save_arrays(out / "run.npz", arrays)
    return [out / "run.npz"]


def _rerun(run: Path, estimate: PathAndMap, out: Path) -> list[Path]:
    path, trajectory = out / "run.rrd", estimate.trajectory
    with recording(path, run.resolve().name) as (rr, stream):
        stream.log("world/path", rr.LineStrips3D([trajectory.positions]), static=True)
        stream.log("world/map", ellipsoids(rr, raised(estimate.landmarks)), static=True)
        for t, pose in enumerate(trajectory.world_from_body):
            log_time(stream, t, int(estimate.stamps_ns[t] - estimate.stamps_ns[0]))
            log_pose(rr, stream, "body", pose)
            stream.log("world/body", rr.TransformAxes3D(AXIS_M))
    return [path]


FORMATS: dict[str, Callable[[Path, PathAndMap, Path], list[Path]]] = {
    "tum": _tum,
    "kitti": _kitti,
    "ply": _ply,
    "colmap": _colmap,
    "rerun": _rerun,
    "npz": _npz,
}
"""How each is written."""
