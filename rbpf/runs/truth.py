"""Ground truth of a recording at a run's own frames, and the file that keeps it (truth.npz)."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbpf.core.checkpoint import fitting, integers, load_arrays, numbers, read, save_arrays, text
from rbpf.errors import InputError
from rbpf.lie import SE2Group, SE3Group
from rbpf.runs.trajectory import Alignment
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.range_bearing import RelativePosition
from rbpf.systems.system import Gauge

TRUTH = "truth.npz"
#: Truth is interpolated between poses no further apart than this; an instant in a longer gap is not scored.
LONGEST_GAP_NS = 500_000_000
LEAST = 3  #: Least frames with a true pose for a comparison.

_TRUTH = {
    "rows": integers("rows", least=0, below="steps"),
    "poses": numbers("rows", "size"),
    "alignment": text(),
    "ids": integers("landmarks"),
    "landmarks": numbers("landmarks", ""),
}
_ALIGNMENTS: dict[str, Alignment] = {"none": "none", "rigid": "rigid", "similarity": "similarity"}


class Precision(NamedTuple):
    """Standard deviations, per axis, of the ground truth itself: of positions [m] and rotations [rad]."""

    std_m: float = 0.0
    std_rad: float = 0.0


EXACT = Precision()


@dataclass(frozen=True)
class RunTruth:
    """Ground truth at a run's own frames."""

    rows: np.ndarray  #: (R,) frames that have a true pose.
    poses: np.ndarray  #: (R, E) world_from_body.
    landmarks: dict[int, np.ndarray] = field(default_factory=dict)  #: name of a landmark to its (D,) position.
    #: alignment of the estimate to the truth's world; "none" if both are in the same one.
    alignment: Alignment = "none"


def truth_at(space: SE2Group | SE3Group, truth: Truth, stamps_ns: np.ndarray, gauge: Gauge) -> RunTruth | None:
    """The truth at a run's frames (T,); None if fewer than `LEAST` have a true pose.

    If the run's world (`gauge`) starts at the first frame, so does the truth, if it is known there; else only an alignment
    relates the two.
    """
    rows, poses = poses_at(space, truth.stamps_ns, truth.poses, stamps_ns)
    if rows.size < LEAST:
        return None
    landmarks = {name: np.asarray(point, dtype=float)[: space.point_dim] for name, point in truth.landmarks.items()}
    if gauge != "first frame":
        return RunTruth(rows, poses, landmarks, _ALIGNMENTS[gauge])
    if rows[0] != 0:
        return RunTruth(rows, poses, landmarks, "rigid")
    model, start = RelativePosition(space), poses[0]
    moved = {name: model.predict(start, point) for name, point in landmarks.items()}
    return RunTruth(rows, space.between(start, poses), moved, "none")


def poses_at(
    space: SE2Group | SE3Group, true_ns: np.ndarray, poses: np.ndarray, stamps_ns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `stamps_ns` that lie inside true stamps (T,), and the interpolated true poses (T, E) there.

    Stamps that count steps must match exactly; otherwise poses are interpolated along the geodesic.
    """
    if not true_ns.size:  # truth of landmarks only
        return np.zeros(0, dtype=np.intp), poses
    after = np.searchsorted(true_ns, stamps_ns).clip(max=true_ns.size - 1)
    met = true_ns[after] == stamps_ns
    before = np.where(met, after, after - 1).clip(min=0)
    gap = true_ns[after] - true_ns[before]
    inside = (true_ns[before] <= stamps_ns) & (stamps_ns <= true_ns[after])
    rows = np.flatnonzero(met | (inside & (gap <= LONGEST_GAP_NS)))
    fraction = (stamps_ns[rows] - true_ns[before[rows]]) / np.maximum(gap[rows], 1)
    return rows, space.interpolate(poses[before[rows]], poses[after[rows]], fraction)


def write_truth(out: Path, truth: RunTruth) -> None:
    """Writes truth.npz."""
    points = np.array(list(truth.landmarks.values()), dtype=float)
    arrays = {
        "rows": truth.rows,
        "poses": truth.poses,
        "ids": np.array(list(truth.landmarks), dtype=np.int64),
        "landmarks": points.reshape(len(truth.landmarks), points.shape[-1]),
        "alignment": np.array(truth.alignment),
    }
    save_arrays(out / TRUTH, arrays)


def read_truth(folder: Path, steps: int, size: int) -> RunTruth:
    """Reads truth.npz of a run of `steps` steps with poses of `size` numbers; InputError: missing, or not of this run."""
    path = folder / TRUTH
    if not path.is_file():
        raise InputError(f"{folder} has no ground truth: its recording has none; compare it with its batch optimum")
    arrays = load_arrays(path)
    with fitting(path):
        if arrays["rows"].size and arrays["rows"].max() >= steps:
            raise InputError(f"it is of another run, this one has {steps} steps; run the recording again")
        rows, poses, named, ids, points = read(arrays, _TRUTH, steps=steps, size=size).values()
        alignment = _ALIGNMENTS[str(named)]
        landmarks = dict(zip(ids.tolist(), points, strict=True))
    if not rows.size:
        raise InputError(f"{folder}: no step of the run has the time of a true pose")
    return RunTruth(rows, poses, landmarks, alignment)
