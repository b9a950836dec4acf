"""Export of a run folder to the formats of other programs.

tum      trajectory.tum: a line `time tx ty tz qx qy qz qw` per pose
kitti    trajectory_kitti.txt: the upper 3 × 4 block of each pose's matrix, without times
ply      map.ply: landmarks, coloured by their standard deviation, which is also the property sigma_m; path.ply: positions
         of the body, joined by lines. Binary little-endian (G. Turk, 1994), for MeshLab, CloudCompare, Blender
colmap   colmap/sparse/0: cameras, images, points and their errors (`cameras`, `images`, `points3D`, `rigs`, `frames`; .bin
         or .txt), with the tracks of the measurements, if the run has them; colmap/images: links to the recording's
         images, or the images of a video or a bag, rectified or resized ones, as PNG files
rerun    run.rrd: path and map for the Rerun viewer
npz      run.npz: stamps_ns (T,), world_from_body (T, E), cov_poses (T, d, d); landmark_ids (M,), landmarks (M, D),
         cov_landmarks (M, D, D)
"""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rbpf.core.checkpoint import save_arrays, whole
from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.runs.files import prepare_folder
from rbpf.runs.measurement_files import OBSERVATIONS
from rbpf.runs.provenance import read_config
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.trajectory import write_kitti, write_tum
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.colmap.model import OVER_IMAGES, Names, build_model, lay_out, recorded_images
from rbpf.validation.gtsam.batch_problem import Problem
from rbpf.validation.gtsam.observations import ObservationTable, observation_table
from rbpf.validation.report.live import AXIS_M, ellipsoids, log_pose, log_time, recording

_log = logging.getLogger(__name__)
MAP, PATH, MODEL = "map.ply", "path.ply", "colmap"
#: Camera that represents a robot's sensor in a COLMAP model: it looks along the robot's x axis, without measurements.
NOMINAL = Pinhole(640, 480, 500.0, 500.0, 319.5, 239.5)
_PATH_COLOUR = np.array([[31, 119, 180]], dtype=np.uint8)
_BODY_FROM_CAMERA = SE3.from_matrix(np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]]))
_VERTEX = [*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue")), ("sigma_m", "<f4")]
_EDGE = [("vertex1", "<i4"), ("vertex2", "<i4")]
_NAMES = {"<f4": "float", "u1": "uchar", "<i4": "int"}


def export_run(run: Path, formats: Sequence[str], out: Path) -> list[Path]:
    """Writes a run, a folder written by `rbpf run`, in some of the `FORMATS` to a folder; returns the files.

    Raises InputError: not a run folder, a format is unknown, or its library is not installed.
    """
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise InputError(f"a run is exported as {', '.join(FORMATS)}, not as {unknown[0]}")
    estimate = RunFolder.open(run).estimate
    prepare_folder(out)
    chosen = [FORMATS[name] for name in dict.fromkeys(formats)]
    for files, write in chosen:
        write(run, estimate, out / files[0])
    return [out / file for files, _ in chosen for file in files]


def _colmap(run: Path, estimate: PathAndMap, path: Path) -> None:
    problem = RunFolder.open(run).measurements if (run / OBSERVATIONS).exists() else None
    names: Names | None = None
    if (config := read_config(run))["system"] in OVER_IMAGES:
        try:
            names = lay_out(recorded_images(config), path / "images", len(estimate.stamps_ns))
        except InputError as error:
            _log.warning("%s: the images of the run are not exported: %s", run, error)
    export_colmap(estimate, problem, path / "sparse" / "0", names=names)


def _npz(_run: Path, estimate: PathAndMap, path: Path) -> None:
    landmarks = estimate.landmarks
    arrays = {name: getattr(estimate, name) for name in ("stamps_ns", "world_from_body", "cov_poses")}
    arrays |= {"landmark_ids": landmarks.ids, "landmarks": landmarks.mean, "cov_landmarks": landmarks.cov}
    save_arrays(path, arrays)


def _rerun(run: Path, estimate: PathAndMap, path: Path) -> None:
    trajectory = estimate.trajectory
    with recording(path, run.resolve().name) as (rr, stream):
        stream.log("world/path", rr.LineStrips3D([trajectory.positions]), static=True)
        stream.log("world/map", ellipsoids(rr, estimate.landmarks), static=True)
        for t, pose in enumerate(trajectory.world_from_body):
            log_time(stream, t, int(estimate.stamps_ns[t] - estimate.stamps_ns[0]))
            log_pose(rr, stream, "body", pose)
            stream.log("world/body", rr.TransformAxes3D(AXIS_M))


#: Files of each format, and the function that writes them from the run's folder, path and map, given the first file.
FORMATS: dict[str, tuple[tuple[str, ...], Callable[[Path, PathAndMap, Path], object]]] = {
    "tum": (("trajectory.tum",), lambda _run, estimate, path: write_tum(path, estimate.trajectory)),
    "kitti": (("trajectory_kitti.txt",), lambda _run, estimate, path: write_kitti(path, estimate.trajectory)),
    "ply": ((MAP, PATH), lambda _run, estimate, path: export_ply(estimate, path.parent)),
    "colmap": ((MODEL,), _colmap),
    "rerun": (("run.rrd",), _rerun),
    "npz": (("run.npz",), _npz),
}


def export_colmap(
    estimate: PathAndMap,
    problem: Problem | None,
    folder: Path,
    kind: Literal["binary", "text"] = "binary",
    names: Names | None = None,
) -> Any:
    """Writes a run as a COLMAP model, binary or text, and returns the `pycolmap.Reconstruction`.

    Without `names`, see `lay_out`, a camera's images are named by their frame; images missing in `names` are left out.
    Without a camera the poses are those of `NOMINAL` on the robot; without a problem, which has the camera and the tracks,
    points have no tracks.

    Raises InputError: path and measurements are not of one run.
    """
    colours, ids = colours_by_sigma(standard_deviations(estimate.landmarks.cov)), estimate.landmarks.ids
    if isinstance(problem, FeatureLog):
        if len(problem.frames) != len(estimate.stamps_ns):
            counts = f"{len(estimate.stamps_ns)} poses and {len(problem.frames)} frames"
            raise InputError(f"{problem.name}: expected a pose for each frame, found {counts}; take both from one run.")
        # The observations of the map's landmarks, with their rows in the map.
        table, poses = observation_table(problem), estimate.world_from_body
        order, kept = np.argsort(ids, kind="stable"), np.isin(table.names, ids)[table.index]
        place = order[np.searchsorted(ids, table.names[table.index[kept]], sorter=order)]
        shown = ObservationTable(table.camera, table.steps[kept], place, ids, table.z[kept], table.cov_z[kept])
    else:
        none, names = np.zeros(0, dtype=np.intp), None
        shown = ObservationTable(NOMINAL, none, none, ids, np.zeros((0, 2)), np.zeros((0, 2, 2)))
        poses = SE3.compose(estimate.trajectory.world_from_body, _BODY_FROM_CAMERA)
    model = build_model(shown, poses, estimate.landmarks.in_space()[0], colours, names)
    prepare_folder(folder)
    (model.write_text if kind == "text" else model.write_binary)(folder)
    return model


def export_ply(estimate: PathAndMap, folder: Path) -> None:
    """Writes map.ply and path.ply."""
    prepare_folder(folder)
    std = standard_deviations(estimate.landmarks.cov)
    write_ply(folder / MAP, estimate.landmarks.in_space()[0], colours_by_sigma(std), std)
    at = estimate.trajectory.positions
    steps = np.arange(max(len(at) - 1, 0))
    edges = np.stack([steps, steps + 1], axis=1)
    write_ply(folder / PATH, at, np.repeat(_PATH_COLOUR, len(at), axis=0), edges=edges)


def standard_deviations(cov: Array) -> Array:
    """Root of the mean variance per axis of covariances (…, n, n) [m]: (…)."""
    return np.sqrt(np.trace(cov, axis1=-2, axis2=-1) / cov.shape[-1])


def colours_by_sigma(std: Array) -> NDArray[np.uint8]:
    """RGB (M, 3) of standard deviations (M,): dark blue (certain) to yellow (uncertain), on a logarithmic scale.

    It reaches from their 5 % to their 95 % quantile.
    """
    from matplotlib import colormaps

    if not len(std):
        return np.zeros((0, 3), dtype=np.uint8)
    logs = np.log(np.maximum(std, np.finfo(float).tiny))
    low, high = np.quantile(logs, (0.05, 0.95))
    fraction = np.clip((logs - low) / max(float(high - low), np.finfo(float).tiny), 0.0, 1.0)
    return np.asarray(colormaps["plasma"](fraction, bytes=True)[:, :3], dtype=np.uint8)


def write_ply(
    path: Path, points: Array, colours: np.ndarray, sigmas: Array | None = None, edges: np.ndarray | None = None
) -> None:
    """Writes finite points (M, 3) [m] with colours (M, 3) uint8, and lines between them; writes atomically.

    `sigmas` (M,) are a further property sigma_m of each point, `edges` (L, 2) rows of points connected by lines.
    """
    if not np.isfinite(points).all():
        row = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise InputError(f"{path}: expected finite coordinates, found others in row {row}.")
    columns = [*points.T, *colours.T, *([] if sigmas is None else [sigmas])]
    vertices = np.rec.fromarrays(columns, dtype=_VERTEX[: len(columns)])
    lines = np.rec.fromarrays((np.zeros((0, 2), dtype=int) if edges is None else edges).T, dtype=_EDGE)
    header = ["ply", "format binary_little_endian 1.0"]
    for name, elements in (("vertex", vertices), *([("edge", lines)] if len(lines) else [])):
        header.append(f"element {name} {len(elements)}")
        kinds = ((field, elements.dtype[field].str.replace("|", "")) for field in elements.dtype.names or ())
        header += [f"property {_NAMES[kind]} {field}" for field, kind in kinds]
    text = "\n".join([*header, "end_header", ""])
    with whole(path) as partial:
        partial.write_bytes(text.encode("ascii") + vertices.tobytes() + lines.tobytes())
