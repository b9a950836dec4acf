"""Skew matrices, and the quaternions of rotation matrices."""

import numpy as np

from rbpf.lie.base import Array


def skew(v: Array) -> Array:
    """Matrix of the cross product, (..., 3) -> (..., 3, 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -v[..., 0], -v[..., 1], -v[..., 2]
    return out


def quat_from_matrix(rotation: Array) -> Array:
    """Unit quaternion with w >= 0 of a rotation matrix, (..., 3, 3) -> (..., 4), order xyzw.

    All of 4 q q^T is linear in the matrix; its row with the largest diagonal loses no digits.
    """
    outer = np.empty((*rotation.shape[:-2], 4, 4))
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    swapped = np.swapaxes(rotation, -1, -2)
    outer[..., :3, :3] = rotation + swapped + (1.0 - trace)[..., None, None] * np.eye(3)
    odd = rotation - swapped
    outer[..., 3, 0] = outer[..., 0, 3] = odd[..., 2, 1]
    outer[..., 3, 1] = outer[..., 1, 3] = odd[..., 0, 2]
    outer[..., 3, 2] = outer[..., 2, 3] = odd[..., 1, 0]
    outer[..., 3, 3] = 1.0 + trace
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    quat = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    quat = quat / np.sqrt(np.square(quat).sum(-1, keepdims=True))
    return np.where(quat[..., 3:] < 0.0, -quat, quat)
