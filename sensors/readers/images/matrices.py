"""Poses that files write as matrices."""

import numpy as np

from rbpf.lie import SE3, Array

SKEWED = 0.02
"""How far RᵀR may be from the identity: single precision and a few digits leave less, another meaning far more."""


def rigid_motion_error(matrix: Array) -> str | None:
    """What a matrix (3, 4) or (4, 4) lacks to be a rigid motion; None where it is one."""
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > SKEWED or np.linalg.det(rotation) < 0.0:
        return "expected a rotation in the first three rows and columns, found a matrix that is none"
    if len(matrix) == 4 and np.any(matrix[3] != [0.0, 0.0, 0.0, 1.0]):
        return "expected the last row of the matrix to be 0 0 0 1"
    return None


def pose_of_matrix(matrix: Array) -> Array:
    """Pose (..., 7) of a matrix (..., 3, 4) or (..., 4, 4) without a rigid_motion_error; its rotation is made exact."""
    return SE3.normalise(SE3.from_matrix(matrix))
