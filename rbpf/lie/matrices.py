"""Rotation matrices, skew matrices and the blocks of the SE(3) Jacobian."""

import numpy as np

from rbpf.lie.base import Array
from rbpf.lie.series import (
    coefficient_b,
    coefficient_c,
    coefficient_d,
    coefficient_e,
    inverse_coefficient,
)


def skew(v: Array) -> Array:
    """Matrix of the cross product, (..., 3) -> (..., 3, 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -v[..., 0], -v[..., 1], -v[..., 2]
    return out


def matrix_from_quat(quat_xyzw: Array) -> Array:
    """Rotation matrix of a unit quaternion, (..., 4) -> (..., 3, 3)."""
    x, y, z, w = (quat_xyzw[..., i] for i in range(4))
    out = np.empty((*quat_xyzw.shape[:-1], 3, 3))
    out[..., 0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[..., 1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[..., 2, 2] = 1.0 - 2.0 * (x * x + y * y)
    out[..., 0, 1], out[..., 1, 0] = 2.0 * (x * y - z * w), 2.0 * (x * y + z * w)
    out[..., 0, 2], out[..., 2, 0] = 2.0 * (x * z + y * w), 2.0 * (x * z - y * w)
    out[..., 1, 2], out[..., 2, 1] = 2.0 * (y * z - x * w), 2.0 * (y * z + x * w)
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


def product(a: Array, b: Array) -> Array:
    """Matrix product of stacks, without BLAS, so that the bytes do not depend on its threads."""
    return np.einsum("...ij,...jk->...ik", a, b)


def rotation_jacobian(omega: Array) -> Array:
    """Left Jacobian of SO(3), I + b W + c W^2, (..., 3) -> (..., 3, 3)."""
    squared = np.square(omega).sum(-1)
    return _polynomial(omega, coefficient_b(squared), coefficient_c(squared))


def rotation_jacobian_inverse(omega: Array) -> Array:
    """Its inverse, I - W / 2 + (1 - (theta / 2) cot(theta / 2)) / theta^2 W^2, (..., 3) -> (..., 3, 3)."""
    squared = np.square(omega).sum(-1)
    return _polynomial(omega, np.full_like(squared, -0.5), inverse_coefficient(squared))


def coupling(omega: Array, v: Array) -> Array:
    """Block Q of the left Jacobian of SE(3), (..., 3) and (..., 3) -> (..., 3, 3).

    Q = V/2 + c (WV + VW + WVW) + d (WWV + VWW - 3 WVW) + e (WVWW + WWVW), Barfoot (2017) (7.86);
    W and V are the skew matrices of omega and v. With s = omega . v their products are WVW = -s W,
    WV + VW = omega v^T + v omega^T - 2 s I and WWV + VWW = -theta^2 V - s W, which leaves no matrix product.
    """
    squared = np.square(omega).sum(-1)
    c, d, e = (
        coefficient(squared)[..., None, None] for coefficient in (coefficient_c, coefficient_d, coefficient_e)
    )
    s = (omega * v).sum(-1)[..., None, None]
    theta_squared = squared[..., None, None]
    mixed = omega[..., :, None] * (c * v[..., None, :] - (2.0 * e * s) * omega[..., None, :])
    mixed = mixed + c * (v[..., :, None] * omega[..., None, :])
    turned = skew(omega) * (s * (2.0 * d - c)) + skew(v) * (0.5 - d * theta_squared)
    return mixed + turned + (2.0 * s * (e * theta_squared - c)) * np.eye(3)


def lower_blocks(diagonal: Array, coupling_block: Array) -> Array:
    """[[A, 0], [Q, A]], (..., 3, 3) and (..., 3, 3) -> (..., 6, 6)."""
    out = np.zeros((*diagonal.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = diagonal
    out[..., 3:, :3] = coupling_block
    return out


def _polynomial(omega: Array, linear: Array, square: Array) -> Array:
    # I + linear W + square W^2
    w_hat = skew(omega)
    terms = linear[..., None, None] * w_hat + square[..., None, None] * product(w_hat, w_hat)
    return np.eye(3) + terms
