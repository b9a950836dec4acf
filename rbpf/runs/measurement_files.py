"""Measurements in files: what every run leaves behind for the comparison with a batch optimiser.

Two text files in the run's folder, numbers with every digit (reading gives back the same bits):

observations.csv

    # rbpf observations 1
    # recording: NAME
    # space: SE2 | SE3
    # measurement: range_bearing | position
    # pitch_sign: 1 | -1
    # robot_from_sensor: E numbers, SE2 [theta, x, y], SE3 [qx, qy, qz, qw, tx, ty, tz]
    # start: E numbers, the known pose of step 0
    # start_stamp_ns: time of step 0
    # rows: how many lines follow the columns' names
    step,stamp_ns,landmark,z0,z1[,z2],c00,c10,c11[,c20,c21,c22]

one line per measurement, its covariance as the lower triangle by rows; and

observations_odometry.csv

    # rbpf odometry 1
    # recording: NAME
    # space: SE2 | SE3
    # rows: how many lines follow the columns' names
    step,stamp_ns,d0,…,c00,c10,c11,…

one line per step from 1 on: previous_robot_from_robot, and the lower triangle of its covariance in the right
chart there, in the order [omega, v].
"""

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbpf.lie import SE2, SE3, Array, SE2Group, SE3Group
from rbpf.runs.files import whole
from rbpf.runs.headed_table import HeadedTable
from rbpf.runs.measurements import KINDS, Measurements, are_covariances, are_poses, point_dim
from rbpf.sensors.readers.text import quoted

OBSERVATIONS = "observations.csv"
ODOMETRY = "observations_odometry.csv"

_TITLES = {OBSERVATIONS: "rbpf observations 1", ODOMETRY: "rbpf odometry 1"}
_COVARIANCE = "a positive semi-definite covariance"
_HINT = "a file that every filter run writes into its folder"
_SPACES: dict[str, SE2Group | SE3Group] = {"SE2": SE2, "SE3": SE3}


def write_measurements(folder: Path, m: Measurements) -> None:
    """Write both files; they appear under their names when both are complete.

    Args:
        folder: the run's folder; files of these names in it are replaced.
        m: what to write.

    Raises:
        InputError: the folder is missing or cannot be written to, or the disk is full.
    """
    texts = {OBSERVATIONS: _observations_text(m), ODOMETRY: _odometry_text(m)}
    with ExitStack() as both:
        for name, text in texts.items():
            both.enter_context(whole(folder / name)).write_text(text, encoding="utf-8")


def read_measurements(folder: Path) -> Measurements:
    """Read what `write_measurements` wrote.

    Raises:
        InputError: names the file and the line that is not as expected.
    """
    seen, moved = (HeadedTable.read(folder / name, title, _HINT) for name, title in _TITLES.items())
    space = _SPACES[seen.choice("space", tuple(_SPACES))]
    for key in ("recording", "space"):
        if moved.text(key) != seen.text(key):
            problem = f"expected {key} {seen.text(key)} as in {OBSERVATIONS}, found {quoted(moved.text(key))}"
            raise moved.header_error(key, f"{problem}; take both files from one run")
    stamps, deltas, covs = _read_moves(moved, space, seen.whole("start_stamp_ns"))
    steps, landmarks, z, cov_z = _read_sightings(seen, space, stamps)
    return Measurements(
        recording=seen.text("recording"),
        space=space,
        measurement=KINDS[seen.choice("measurement", tuple(KINDS))],
        pitch_sign=float(seen.choice("pitch_sign", ("1", "-1"))),
        robot_from_sensor=_read_pose(seen, "robot_from_sensor", space),
        start=_read_pose(seen, "start", space),
        stamps_ns=stamps,
        deltas=deltas,
        covs=covs,
        steps=steps,
        landmarks=landmarks,
        z=z,
        cov_z=cov_z,
    )


def _observations_text(m: Measurements) -> str:
    header = {
        "recording": m.recording,
        "space": repr(m.space),
        "measurement": m.measurement,
        "pitch_sign": f"{m.pitch_sign:g}",
        "robot_from_sensor": _joined(m.robot_from_sensor, " "),
        "start": _joined(m.start, " "),
        "start_stamp_ns": str(int(m.stamps_ns[0])),
    }
    integers = np.stack([m.steps, m.stamps_ns[m.steps], m.landmarks], axis=1)
    numbers = np.concatenate([m.z, _lower(m.cov_z)], axis=1)
    return _text(_TITLES[OBSERVATIONS], header, _observation_columns(m.space), integers, numbers)


def _odometry_text(m: Measurements) -> str:
    header = {"recording": m.recording, "space": repr(m.space)}
    integers = np.stack([np.arange(1, len(m.stamps_ns)), m.stamps_ns[1:]], axis=1)
    numbers = np.concatenate([m.deltas, _lower(m.covs)], axis=1)
    return _text(_TITLES[ODOMETRY], header, _odometry_columns(m.space), integers, numbers)


def _text(
    title: str, header: dict[str, str], columns: list[str], integers: NDArray[np.int64], numbers: Array
) -> str:
    lines = [f"# {title}", *(f"# {key}: {value}" for key, value in header.items())]
    lines += [f"# rows: {len(integers)}", ",".join(columns)]
    lines += [f"{_joined(i, ',')},{_joined(x, ',')}" for i, x in zip(integers, numbers, strict=True)]
    return "\n".join([*lines, ""])


def _joined(numbers: NDArray[np.int64] | Array, separator: str) -> str:
    return separator.join(map(repr, numbers.tolist()))


def _observation_columns(space: SE2Group | SE3Group) -> list[str]:
    count = point_dim(space)
    return ["step", "stamp_ns", "landmark", *_indexed("z", count), *_triangle(count)]


def _odometry_columns(space: SE2Group | SE3Group) -> list[str]:
    return ["step", "stamp_ns", *_indexed("d", space.size), *_triangle(space.dim)]


def _indexed(name: str, count: int) -> Iterable[str]:
    return (f"{name}{i}" for i in range(count))


def _triangle(count: int) -> Iterable[str]:
    return (f"c{i}{j}" for i in range(count) for j in range(i + 1))


def _read_moves(
    table: HeadedTable, space: SE2Group | SE3Group, start_ns: int
) -> tuple[NDArray[np.int64], Array, Array]:
    integers, numbers = table.body(_odometry_columns(space), 2)
    table.require(integers[:, 0] == np.arange(1, len(integers) + 1), "one row per step, from step 1 in order")
    stamps = np.concatenate([[start_ns], integers[:, 1]])
    table.require(np.diff(stamps) >= 0, "stamps in order of time")
    deltas, covs = numbers[:, : space.size], _symmetric(numbers[:, space.size :], space.dim)
    table.require(are_poses(space, deltas), "an increment that begins with a quaternion of length 1")
    table.require(are_covariances(covs), _COVARIANCE)
    return stamps, deltas, covs


def _read_sightings(
    table: HeadedTable, space: SE2Group | SE3Group, stamps: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    integers, numbers = table.body(_observation_columns(space), 3)
    steps, stamp, landmarks = integers.T
    inside = (steps >= 0) & (steps < len(stamps))
    table.require(inside, f"a step from 0 to {len(stamps) - 1}, the last one in {ODOMETRY}")
    table.require(stamp == stamps[steps], f"the stamp that {ODOMETRY} gives this step")
    dim = point_dim(space)
    cov = _symmetric(numbers[:, dim:], dim)
    table.require(are_covariances(cov), _COVARIANCE)
    return steps, landmarks, numbers[:, :dim], cov


def _read_pose(table: HeadedTable, key: str, space: SE2Group | SE3Group) -> Array:
    pose = table.numbers(key, space.size)
    if not are_poses(space, pose[None])[0]:
        raise table.header_error(key, f"expected {key} to begin with a quaternion of length 1")
    return pose


def _lower(cov: Array) -> Array:
    row, column = np.tril_indices(cov.shape[-1])
    return cov[:, row, column]


def _symmetric(triangle: Array, dim: int) -> Array:
    row, column = np.tril_indices(dim)
    cov = np.empty((len(triangle), dim, dim))
    cov[:, row, column] = cov[:, column, row] = triangle
    return cov
