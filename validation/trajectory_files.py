"""Trajectories in files: the TUM format and KITTI odometry's, both read and written.

TUM: a line `timestamp tx ty tz qx qy qz qw` per pose, seconds and metres, # starts a comment.
KITTI: the 12 numbers of world_from_camera's upper 3 x 4 block per line, row by row; no times.
"""

from pathlib import Path

import numpy as np

from rbpf.lie import SE3, Array
from rbpf.sensors.readers.table import read_columns
from rbpf.validation.metrics.trajectory import Trajectory
from rbpf.validation.writing import whole

TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
KITTI_COLUMNS = tuple(f"{name}{row}" for row in "123" for name in ("r1", "r2", "r3", "t"))
UNIT_TOLERANCE = 0.01  # files print few digits; more than this is no rotation
NS_PER_S = 1_000_000_000


def read_tum(path: Path) -> Trajectory:
    """Trajectory of a file in TUM format; quaternions are scaled to unit length.

    Raises:
        InputError: names the file and the line that is not as expected.
    """
    table = read_columns(path, TUM_COLUMNS, "a trajectory in TUM format")
    quat_xyzw = table.block("qx", "qw")
    length = np.sqrt(np.square(quat_xyzw).sum(1))
    wrong = np.abs(length - 1.0) > UNIT_TOLERANCE
    if wrong.any():
        row = int(np.argmax(wrong))
        raise table.error(
            row, f"expected a quaternion qx qy qz qw of length 1, found length {length[row]:.6g}"
        )
    poses = np.concatenate([quat_xyzw, table.block("tx", "tz")], axis=1)
    return Trajectory(table.stamps_ns(), SE3.normalise(poses))


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory in TUM format, with every digit; the file appears under its name when complete.

    Args:
        path: the file; one that is there is replaced.
        trajectory: what to write.

    Raises:
        InputError: the place cannot be written to, or the disk is full.
    """
    rows = zip(trajectory.stamps_ns.tolist(), trajectory.world_from_body.tolist(), strict=True)
    lines = [_tum_line(stamp_ns, numbers) for stamp_ns, numbers in rows]
    _write_whole(path, ["# " + " ".join(TUM_COLUMNS) + "\n", *lines])


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory in KITTI format, with every digit; the file appears under its name when complete.

    Args:
        path: the file; one that is there is replaced.
        trajectory: what to write; its times are lost.
    """
    rows = SE3.matrix(trajectory.world_from_body)[:, :3].reshape(-1, 12).tolist()
    _write_whole(path, [" ".join(map(repr, row)) + "\n" for row in rows])


def read_kitti(path: Path) -> Trajectory:
    """Trajectory of a file in KITTI format, stamped with the number of the row from 0.

    Raises:
        InputError: names the file and the line that is not as expected.
    """
    table = read_columns(path, KITTI_COLUMNS, "a trajectory in KITTI format")
    matrices = table.values.reshape(-1, 3, 4)
    wrong = _distance_from_rotation(matrices[:, :, :3]) > UNIT_TOLERANCE
    if wrong.any():
        problem = "expected a rotation matrix in columns 1-3, 5-7 and 9-11, found one that is not orthonormal"
        raise table.error(int(np.argmax(wrong)), problem)
    return Trajectory(np.arange(len(matrices)), SE3.from_matrix(matrices))


def _write_whole(path: Path, lines: list[str]) -> None:
    with whole(path) as partial:
        partial.write_text("".join(lines), encoding="utf-8")


def _tum_line(stamp_ns: int, pose: list[float]) -> str:
    seconds, fraction = divmod(abs(stamp_ns), NS_PER_S)
    stamp = f"{'-' if stamp_ns < 0 else ''}{seconds}.{fraction:09d}"
    return " ".join([stamp, *map(repr, pose[4:]), *map(repr, pose[:4])]) + "\n"


def _distance_from_rotation(matrices: Array) -> Array:
    gram = np.einsum("nij,nkj->nik", matrices, matrices)
    skewed = np.abs(gram - np.eye(3)).max((1, 2))
    return np.where(np.linalg.det(matrices) > 0.0, skewed, np.inf)
