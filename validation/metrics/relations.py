"""Error of a path by manually verified relations between pairs of its poses, for recordings without other truth.

R. Kümmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27, 2009: the error of a relation is
relation⁻¹ · (pose at t1)⁻¹ (pose at t2), reported as translation length and rotation angle. No
alignment is needed, and a local deformation of the path counts only once.

A file of relations is a table, blank-separated, `#` starting a comment:

    t1 t2 x y z roll pitch yaw

with the pose at t2 relative to that at t1 (Unix seconds, metres, radians). Paths are interpolated: between
two poses, linearly in position and along the shortest rotation.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.runs.files import ODOMETRY
from rbpf.runs.trajectory import MAX_DIFFERENCE_NS, Trajectory
from rbpf.sensors.readers.text import parse_time, read_columns
from rbpf.validation.metrics.accuracy import RelativeError

#: Times (R, 2) of both ends, and poses (R, 7) at the second time, relative to that at the first.
Relations = tuple[NDArray[np.int64], Array]
_COLUMNS = ("t1", "t2", "x", "y", "z", "roll", "pitch", "yaw")
#: Files of a run's paths, by prefix: "" of the filter, "final_" of its last particles, "odometry_" without it.
PATHS = {"": "trajectory.tum", "final_": "posterior.tum", "odometry_": ODOMETRY}


def entries(errors: RelativeError) -> dict[str, float]:
    """Number, means and standard deviations, by names for summary.json."""
    return {
        "relations": len(errors.translations),
        "relations_translation_mean_m": float(errors.translations.mean()),
        "relations_translation_std_m": float(errors.translations.std()),
        "relations_rotation_mean_deg": float(errors.rotations_deg.mean()),
        "relations_rotation_std_deg": float(errors.rotations_deg.std()),
    }


def sentence(errors: RelativeError, total: int) -> str:
    """The result in words, given the number of relations in the file."""
    count, *figures = entries(errors).values()
    part = "" if count == total else f" of {total} (the others end outside of its time)"
    misses = "{:.3f} ± {:.3f} m and {:.1f} ± {:.1f} degrees".format(*figures)
    return f"The path misses {count} relations{part} by {misses} (mean ± standard deviation)."


def read_relations(path: Path) -> Relations:
    """Relations of a file. An InputError names file and line."""
    table = read_columns(path, _COLUMNS, "a table of relations, " + " ".join(_COLUMNS))
    rows = zip(table.lines, table.rows, strict=True)
    ends = [[parse_time(path, line, word) for word in row.split()[:2]] for line, row in rows]
    poses = SE3.from_ypr(table.block("x", "z"), table["yaw"], table["pitch"], table["roll"])
    return np.array(ends, dtype=np.int64), poses


def relation_errors(estimate: Trajectory, relations: Relations) -> RelativeError:
    """Errors of a path by the relations with both ends within it; at least one is required."""
    if not len(estimate):
        raise InputError("Expected a path with poses to score by relations, found an empty one.")
    first, last = estimate.stamps_ns[[0, -1]] + [-MAX_DIFFERENCE_NS, MAX_DIFFERENCE_NS]
    stamps_ns, first_from_second = relations
    inside = ((stamps_ns >= first) & (stamps_ns <= last)).all(axis=1)
    if not inside.any():
        raise InputError("None of the relations has both ends within the path; expected times of the same clock.")
    ends = [_at(estimate, column) for column in stamps_ns[inside].T]
    return RelativeError.of(first_from_second[inside], SE3.between(*ends))


def _at(path: Trajectory, stamps_ns: NDArray[np.int64]) -> Array:
    """Poses (S, 7) at times within a path."""
    after = np.searchsorted(path.stamps_ns, stamps_ns, side="right").clip(1, max(len(path) - 1, 1))
    before, after = after - 1, after.clip(max=len(path) - 1)
    gap = np.maximum(path.stamps_ns[after] - path.stamps_ns[before], 1)
    fraction = ((stamps_ns - path.stamps_ns[before]) / gap).clip(0.0, 1.0)
    a, b = path.world_from_body[before], path.world_from_body[after]
    turning = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    at = SE3.interpolate(a * turning, b * turning, fraction)
    at[:, 4:] = a[:, 4:] + fraction[:, None] * (b - a)[:, 4:]
    return at
