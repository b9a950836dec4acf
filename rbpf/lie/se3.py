"""SE(3), rigid motions of space; storage [qx, qy, qz, qw, tx, ty, tz], tangent [omega, v]."""

from typing import final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.lie.base import Array, LieGroup, join
from rbpf.lie.matrices import (
    coupling,
    lower_blocks,
    matrix_from_quat,
    product,
    quat_from_matrix,
    rotation_jacobian,
    rotation_jacobian_inverse,
    skew,
)
from rbpf.lie.rows import (
    aligned_rows,
    conjugate,
    exp_rows,
    from_rows,
    log_rows,
    multiply,
    rotate,
    to_rows,
    unit,
)


@final
class SE3Group(LieGroup):
    """SE(3); element world_from_body = [quat_xyzw, translation], where q and -q are one rotation."""

    size = 7
    dim = 6

    def __repr__(self) -> str:
        return "SE3"

    def identity(self, shape: tuple[int, ...] = ()) -> Array:
        out = np.zeros((*shape, 7))
        out[..., 3] = 1.0
        return out

    def exp(self, xi: ArrayLike) -> Array:
        rows = to_rows(xi)
        return from_rows(*exp_rows(rows[:3], rows[3:]))

    def log(self, x: ArrayLike) -> Array:
        rows = to_rows(x)
        return from_rows(*log_rows(rows[:4], rows[4:]))

    def compose(self, a: ArrayLike, b: ArrayLike) -> Array:
        left, right = aligned_rows(a, b)
        quat = left[:4]
        return from_rows(multiply(quat, right[:4]), left[4:] + rotate(quat, right[4:]))

    def inverse(self, a: ArrayLike) -> Array:
        rows = to_rows(a)
        quat = conjugate(rows[:4])
        return from_rows(quat, -rotate(quat, rows[4:]))

    def retract(self, x: ArrayLike, xi: ArrayLike) -> Array:
        left, step = aligned_rows(x, xi)
        quat = left[:4]
        turn, shift = exp_rows(step[:3], step[3:])
        return from_rows(multiply(quat, turn), left[4:] + rotate(quat, shift))

    def local(self, x: ArrayLike, y: ArrayLike) -> Array:
        # The difference of the translations is taken before the rotation, so that near points far
        # from the origin lose no digits.
        left, right = aligned_rows(x, y)
        quat = conjugate(left[:4])
        return from_rows(*log_rows(multiply(quat, right[:4]), rotate(quat, right[4:] - left[4:])))

    def normalise(self, x: ArrayLike) -> Array:
        rows = to_rows(x)
        return from_rows(unit(rows[:4]), rows[4:])

    def adjoint(self, a: ArrayLike) -> Array:
        a = np.asarray(a, dtype=float)
        rotation = matrix_from_quat(a[..., :4])
        return lower_blocks(rotation, product(skew(a[..., 4:]), rotation))

    def left_jacobian(self, xi: ArrayLike) -> Array:
        xi = np.asarray(xi, dtype=float)
        omega, v = xi[..., :3], xi[..., 3:]
        return lower_blocks(rotation_jacobian(omega), coupling(omega, v))

    def left_jacobian_inverse(self, xi: ArrayLike) -> Array:
        xi = np.asarray(xi, dtype=float)
        omega, v = xi[..., :3], xi[..., 3:]
        inverse = rotation_jacobian_inverse(omega)
        return lower_blocks(inverse, -product(product(inverse, coupling(omega, v)), inverse))

    def transform(self, a: ArrayLike, p: ArrayLike) -> Array:
        """World points of body points.

        Args:
            a: (..., 7), world_from_body.
            p: (..., 3), in the body's frame [m].

        Returns:
            (..., 3), in the world [m].
        """
        rows, points = aligned_rows(a, p)
        return from_rows(rows[4:] + rotate(rows[:4], points))

    def inverse_transform(self, a: ArrayLike, p: ArrayLike) -> Array:
        """Body points of world points; arguments as in `transform`, the frames of p exchanged."""
        rows, points = aligned_rows(a, p)
        return from_rows(rotate(conjugate(rows[:4]), points - rows[4:]))

    def translation(self, a: ArrayLike) -> Array:
        """View of the translation, (..., 7) -> (..., 3)."""
        return np.asarray(a, dtype=float)[..., 4:]

    def rotation(self, a: ArrayLike) -> Array:
        """Rotation matrix, (..., 7) -> (..., 3, 3)."""
        return matrix_from_quat(np.asarray(a, dtype=float)[..., :4])

    def matrix(self, a: ArrayLike) -> Array:
        """Homogeneous matrix, (..., 7) -> (..., 4, 4)."""
        a = np.asarray(a, dtype=float)
        out = np.zeros((*a.shape[:-1], 4, 4))
        out[..., :3, :3] = matrix_from_quat(a[..., :4])
        out[..., :3, 3] = a[..., 4:]
        out[..., 3, 3] = 1.0
        return out

    def from_matrix(self, m: ArrayLike) -> Array:
        """Element of a homogeneous (or 3 x 4) matrix, (..., 4, 4) -> (..., 7), with qw >= 0."""
        m = np.asarray(m, dtype=float)
        return np.concatenate([quat_from_matrix(m[..., :3, :3]), m[..., :3, 3]], axis=-1)

    def from_ypr(self, t: ArrayLike, yaw: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> Array:
        """Element with the rotation Rz(yaw) Ry(pitch) Rx(roll).

        Args:
            t: (..., 3), translation [m].
            yaw: (...) [rad].
            pitch: (...) [rad].
            roll: (...) [rad].

        Returns:
            (..., 7).
        """
        (cz, sz), (cy, sy), (cx, sx) = (_half_angle(angle) for angle in (yaw, pitch, roll))
        x = cz * cy * sx - sz * sy * cx
        y = cz * sy * cx + sz * cy * sx
        z = sz * cy * cx - cz * sy * sx
        w = cz * cy * cx + sz * sy * sx
        quat = np.stack(np.broadcast_arrays(x, y, z, w), axis=-1)
        return join([quat, np.asarray(t, dtype=float)])

    def ypr(self, a: ArrayLike) -> tuple[Array, Array, Array]:
        """Yaw, pitch and roll [rad], each (...); at a pitch of +-pi/2 only yaw -+ roll is defined."""
        rotation = self.rotation(a)
        yaw = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
        pitch = np.arctan2(-rotation[..., 2, 0], np.hypot(rotation[..., 0, 0], rotation[..., 1, 0]))
        roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
        return yaw, pitch, roll


def _half_angle(angle: ArrayLike) -> tuple[Array, Array]:
    half = 0.5 * np.asarray(angle, dtype=float)
    return np.asarray(np.cos(half)), np.asarray(np.sin(half))
