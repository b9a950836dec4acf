"""Two files that every system's run leaves behind, so that it can be judged later without its recording.

trajectory.npz   stamps_ns (T,), mean (T, E) and cov (T, d, d) in the right chart at it: the online filtered poses;
                 correction (T, r), cov_correction (T, r, r) of the motions, see `rbpf.core.diagnostics.Correction`, r = 0
                 where the system does not tell them; version
truth.npz        rows (R,) of the steps with a true pose, poses (R, E); ids (M,) and landmarks (M, D);
                 alignment: what brings the estimate into the truth's world, "none" where it is the same one;
                 only where the recording has ground truth
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rbpf.core.archive import checked, load_arrays, save_arrays
from rbpf.core.checkpoint import fitting
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, SE2Group, SE3Group
from rbpf.runs.alignment import Alignment
from rbpf.runs.trajectory import Trajectory

TRAJECTORY = "trajectory.npz"
TRUTH = "truth.npz"
VERSION = 1

_ALIGNMENTS: dict[str, Alignment] = {"none": "none", "rigid": "rigid", "similarity": "similarity"}


@dataclass(frozen=True)
class FilteredPath:
    """Filtered poses of a run.

    Attributes:
        stamps_ns: (T,).
        mean: (T, E) in SE2 or SE3.
        cov: (T, d, d) in the right chart at the mean.
        correction: (T, r) of the motions, r = 0 where the system does not tell them.
        cov_correction: (T, r, r).
    """

    stamps_ns: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    correction: np.ndarray
    cov_correction: np.ndarray

    @property
    def space(self) -> SE2Group | SE3Group:
        """The group of the poses."""
        return SE2 if self.mean.shape[1] == SE2.size else SE3

    def trajectory(self, rows: np.ndarray | slice = slice(None)) -> Trajectory:
        """Some of the poses, in space."""
        return in_space(self.stamps_ns[rows], self.mean[rows])


@dataclass(frozen=True)
class RunTruth:
    """Ground truth at a run's own steps.

    Attributes:
        rows: (R,) steps that have a true pose.
        poses: (R, E).
        landmarks: name of a landmark to its (D,) position.
        alignment: what brings the estimate into the truth's world; "none" where both are told in the same one.
    """

    rows: np.ndarray
    poses: np.ndarray
    landmarks: dict[int, np.ndarray] = field(default_factory=dict)
    alignment: Alignment = "none"


def in_space(stamps_ns: np.ndarray, poses: np.ndarray) -> Trajectory:
    """Poses (T, E) of SE2 or SE3 as a trajectory in space."""
    if poses.shape[1] == SE2.size:
        return Trajectory.from_planar(stamps_ns, poses)
    return Trajectory(stamps_ns, poses)


def write_path(
    out: Path,
    stamps_ns: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
    correction: np.ndarray | None = None,
    cov_correction: np.ndarray | None = None,
) -> None:
    """Writes trajectory.npz; the arguments are those of `FilteredPath`."""
    steps = len(mean)
    arrays = {
        "version": np.array(VERSION),
        "stamps_ns": stamps_ns,
        "mean": mean,
        "cov": cov,
        "correction": np.zeros((steps, 0)) if correction is None else correction,
        "cov_correction": np.zeros((steps, 0, 0)) if cov_correction is None else cov_correction,
    }
    save_arrays(out / TRAJECTORY, arrays)


def write_truth(out: Path, truth: RunTruth | None) -> None:
    """Writes truth.npz, or removes one of an earlier run where there is no truth."""
    if truth is None:
        (out / TRUTH).unlink(missing_ok=True)
        return
    points = np.array(list(truth.landmarks.values()), dtype=float)
    arrays = {
        "rows": truth.rows,
        "poses": truth.poses,
        "ids": np.array(list(truth.landmarks), dtype=np.int64),
        "landmarks": points.reshape(len(truth.landmarks), points.shape[-1]),
        "alignment": np.array(truth.alignment),
    }
    save_arrays(out / TRUTH, arrays)


def read_path(folder: Path) -> FilteredPath:
    """Reads trajectory.npz.

    Raises:
        InputError: it is missing, damaged or of another version of the program.
    """
    again = f"repeat the run with --config {folder / 'config.yaml'}"
    if not (folder / TRAJECTORY).is_file():
        raise InputError(f"{folder} has no {TRAJECTORY}: it was left by another version of rbpf; {again}")
    arrays = load_arrays(folder / TRAJECTORY)
    version = arrays.get("version", np.array(0))
    if version.shape or version.dtype.kind != "i" or int(version) != VERSION:
        raise InputError(
            f"{folder / TRAJECTORY} has version {version}, this program reads version {VERSION}; {again}"
        )
    try:
        stamps, mean, cov = path_of(folder / TRAJECTORY, arrays)
        correction = checked(arrays, "correction", (stamps.size, None), "f")
        cov_correction = checked(arrays, "cov_correction", (stamps.size, *2 * correction.shape[1:]), "f")
    except InputError as error:
        raise InputError(
            f"{folder / TRAJECTORY} does not hold the poses of a run ({error}); {again}"
        ) from error
    return FilteredPath(stamps, mean, cov, correction, cov_correction)


def path_of(path: Path, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (T,), poses (T, E) and covariances (T, d, d) of a trajectory.npz.

    Args:
        path: of the file, for messages.
        arrays: what it holds.

    Raises:
        InputError: an array is missing, or is not what it should be.
    """
    with fitting(path):
        stamps = checked(arrays, "stamps_ns", (None,), "i")
        mean = checked(arrays, "mean", (stamps.size, None), "f")
        dim = {SE2.size: SE2.dim, SE3.size: SE3.dim}.get(mean.shape[1])
        if dim is None:
            raise InputError(f"the array mean must have poses in the plane or in space, got {mean.shape}")
        return stamps, mean, checked(arrays, "cov", (stamps.size, dim, dim), "f")


def read_truth(folder: Path, path: FilteredPath) -> RunTruth:
    """Reads truth.npz.

    Raises:
        InputError: there is none, it is damaged, or no step has a true pose.
    """
    if not (folder / TRUTH).is_file():
        raise InputError(
            f"{folder} has no ground truth: its recording has none; compare it with its batch optimum instead"
        )
    arrays = load_arrays(folder / TRUTH)
    with fitting(folder / TRUTH):
        rows = checked(arrays, "rows", (None,), "i")
        poses = checked(arrays, "poses", (rows.size, None), "f")
        alignment = _ALIGNMENTS[str(checked(arrays, "alignment", (), "U"))]
        ids = checked(arrays, "ids", (None,), "i")
        landmarks = dict(zip(ids.tolist(), checked(arrays, "landmarks", (ids.size, None), "f"), strict=True))
    fits = poses.shape[1] == path.mean.shape[1]
    if not fits or (rows.size and not 0 <= rows.min() <= rows.max() < len(path.mean)):
        raise InputError(f"{folder / TRUTH} belongs to another run than {folder / TRAJECTORY}")
    if not rows.size:
        raise InputError(f"{folder}: no step of the run has the time of a true pose")
    return RunTruth(rows, poses, landmarks, alignment)
