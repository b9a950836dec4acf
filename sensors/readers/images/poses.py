"""Poses from files, as matrices or quaternions, and ground truth made of them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.text import read_stamped

#: Tolerance of RᵀR from the identity: rounding to single precision or a few digits is far below, other contents above.
SKEWED = 0.02
LONGEST = 0.01  #: Tolerance of a quaternion's length in a file; it is then scaled to 1.
TUM_POSE = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")  #: Columns of a pose, m, after its time in seconds.


def pose_of_matrix(matrix: Array, error: Callable[[str], InputError]) -> Array:
    """Pose (7,) of a rigid motion (3, 4) or (4, 4), its rotation orthonormalised; `error` makes the exception."""
    rotation = matrix[:3, :3]
    if not (np.abs(rotation.T @ rotation - np.eye(3)).max() <= SKEWED and np.linalg.det(rotation) > 0.0):
        raise error("expected a rotation in the first three rows and columns, found another matrix")
    if len(matrix) == 4 and np.any(matrix[3] != [0.0, 0.0, 0.0, 1.0]):
        raise error("expected the last row of the matrix to be 0 0 0 1")
    return SE3.normalise(SE3.from_matrix(matrix))


def normalised(world_from_body: Array, error: Callable[[int, str], InputError]) -> Array:
    """Poses (T, 7) with their quaternions scaled to length 1; `error` makes the exception for an invalid row."""
    length = np.linalg.norm(world_from_body[:, :4], axis=1)
    wrong = np.flatnonzero(~(np.abs(length - 1.0) <= LONGEST) | ~np.isfinite(world_from_body).all(axis=1))
    if wrong.size:
        raise error(int(wrong[0]), f"expected a quaternion of length 1, found one of length {length[wrong[0]]:.6g}")
    return SE3.normalise(world_from_body)


def truth_between(path: Path, stamps_ns: np.ndarray, world_from_camera: Array, images_ns: np.ndarray) -> Truth:
    """Ground truth in a file, poses (P, 7) at times (P,), that overlaps in time with the images (T,)."""
    if stamps_ns[-1] < images_ns[0] or stamps_ns[0] > images_ns[-1]:
        poses, images = (f"{span[0] / 1e9:.3f} to {span[-1] / 1e9:.3f} s" for span in (stamps_ns, images_ns))
        problem = f"the poses are at {poses} and the images at {images}, which is another clock"
        raise InputError(f"{path}: {problem}; shift the poses to the images' clock, or take the file away.")
    return Truth(stamps_ns, world_from_camera)


def read_tum_truth(path: Path, images_ns: np.ndarray) -> Truth | None:
    """`timestamp tx ty tz qx qy qz qw` [s, m], world_from_camera; None if there is no such file."""
    if not path.exists():
        return None
    rows = read_stamped(path, "poses")
    table = rows.table(TUM_POSE)
    return truth_between(path, rows.stamps_ns, normalised(np.roll(table.values, 4, axis=1), table.error), images_ns)
