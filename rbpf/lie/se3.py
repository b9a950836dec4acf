"""SE(3), rigid motions of space; storage [qx, qy, qz, qw, tx, ty, tz], tangent [omega, v]."""

from typing import final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.arrays import Array, Float, Like
from rbpf.kernels import se3 as kernels
from rbpf.lie.base import LieGroup, StateArray, States, TangentArray, TangentMatrix, Tangents, join, of_pairs, of_rows


@final
class SE3Group(LieGroup):
    """SE(3); element world_from_body = [quat_xyzw, translation], where q and -q are the same rotation."""

    size = 7
    dim = 6
    point_dim = 3  #: Coordinates of a point, D.

    def __repr__(self) -> str:
        return "SE3"

    def identity(self, shape: tuple[int, ...] = ()) -> Float[np.ndarray, "*shape 7"]:
        out = np.zeros((*shape, 7))
        out[..., 3] = 1.0
        return out

    def exp(self, xi: Tangents) -> StateArray:
        return of_rows(kernels.exp, xi, 6, (7,))

    def log(self, x: States) -> TangentArray:
        return of_rows(kernels.log, x, 7, (6,))

    def compose(self, a: States, b: States) -> StateArray:
        return of_pairs(kernels.compose, a, b, (7, 7, 7))

    def inverse(self, a: States) -> StateArray:
        return of_rows(kernels.inverse, a, 7, (7,))

    def retract(self, x: States, xi: Tangents) -> StateArray:
        return of_pairs(kernels.retract, x, xi, (7, 6, 7))

    def local(self, x: States, y: States) -> TangentArray:
        return of_pairs(kernels.local, x, y, (7, 7, 6))

    def _mean_from(self, mean: Array, points: Array, weights: Array) -> Array:
        mean = np.array(mean)[None]
        kernels.mean(np.ascontiguousarray(points), np.ascontiguousarray(weights), *self.mean_rule, mean)
        return mean[0]

    def normalise(self, x: States) -> StateArray:
        out = np.array(x, dtype=float)
        out[..., :4] /= np.sqrt(np.square(out[..., :4]).sum(axis=-1, keepdims=True))
        return out

    def adjoint(self, a: States) -> TangentMatrix:
        return of_rows(kernels.adjoint, a, 7, (6, 6))

    def left_jacobian(self, xi: Tangents) -> TangentMatrix:
        return of_rows(kernels.left_jacobian, xi, 6, (6, 6))

    def left_jacobian_inverse(self, xi: Tangents) -> TangentMatrix:
        return of_rows(kernels.left_jacobian_inverse, xi, 6, (6, 6))

    def transform(self, a: States, p: Like[ArrayLike, "*#batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """World points [m] of body points, with a = world_from_body."""
        return of_pairs(kernels.transform, a, p, (7, 3, 3))

    def inverse_transform(self, a: States, p: Like[ArrayLike, "*#batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        return of_pairs(kernels.inverse_transform, a, p, (7, 3, 3))

    def transform_jacobian(self, p: Like[ArrayLike, "*batch 3"]) -> Float[np.ndarray, "*batch 3 6"]:
        """∂(Exp(ε) p)/∂ε at ε = 0, of points p [m]: −[p]×, then I."""
        p = np.asarray(p, dtype=float)
        return np.concatenate([-skew(p), np.broadcast_to(np.eye(3), (*p.shape, 3))], axis=-1)

    def translation(self, a: States) -> Float[np.ndarray, "*batch 3"]:
        """View of the translation, (..., 7) -> (..., 3)."""
        return np.asarray(a, dtype=float)[..., 4:]

    def rotation(self, a: States) -> Float[np.ndarray, "*batch 3 3"]:
        """Rotation matrix, (..., 7) -> (..., 3, 3)."""
        return of_rows(kernels.rotations, a, 7, (3, 3))

    def matrix(self, a: States) -> Float[np.ndarray, "*batch 4 4"]:
        """Homogeneous matrix, (..., 7) -> (..., 4, 4)."""
        a = np.asarray(a, dtype=float)
        out = np.zeros((*a.shape[:-1], 4, 4))
        out[..., :3, :3] = self.rotation(a)
        out[..., :3, 3] = a[..., 4:]
        out[..., 3, 3] = 1.0
        return out

    def from_matrix(self, m: Like[ArrayLike, "*batch row 4"]) -> Float[np.ndarray, "*batch 7"]:
        """Element of a homogeneous (or 3 x 4) matrix, (..., 4, 4) -> (..., 7), with qw >= 0."""
        m = np.asarray(m, dtype=float)
        # Raises IndexError without a translation column, as for a 3 x 3 rotation matrix.
        rows = np.concatenate([m[..., :3, :3], m[..., :3, 3][..., None]], axis=-1)
        return of_rows(kernels.from_matrix, rows.reshape(*m.shape[:-2], 12), 12, (7,))

    def from_ypr(
        self,
        t: Like[ArrayLike, "*#batch 3"],
        yaw: Like[ArrayLike, "*#batch"],
        pitch: Like[ArrayLike, "*#batch"],
        roll: Like[ArrayLike, "*#batch"],
    ) -> Float[np.ndarray, "*batch 7"]:
        """Element with the translation t [m] and the rotation Rz(yaw) Ry(pitch) Rx(roll) [rad]."""
        halves = [0.5 * np.asarray(angle, dtype=float) for angle in (yaw, pitch, roll)]
        (cz, sz), (cy, sy), (cx, sx) = ((np.cos(half), np.sin(half)) for half in halves)
        x = cz * cy * sx - sz * sy * cx
        y = cz * sy * cx + sz * cy * sx
        z = sz * cy * cx - cz * sy * sx
        w = cz * cy * cx + sz * sy * sx
        return join([np.stack(np.broadcast_arrays(x, y, z, w), axis=-1), np.asarray(t, dtype=float)])

    def ypr(
        self, a: States
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """Yaw, pitch and roll [rad], each (...); at a pitch of +-pi/2 only yaw -+ roll is defined."""
        rotation = self.rotation(a)
        yaw = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
        pitch = np.arctan2(-rotation[..., 2, 0], np.hypot(rotation[..., 0, 0], rotation[..., 1, 0]))
        roll = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])
        return yaw, pitch, roll

    def closest(self, given: ArrayLike, world: ArrayLike, weights: ArrayLike | None = None) -> Array:
        """Poses (…, 7) that bring points (M, 3) closest to points (…, M, 3), by least squares (S. Umeyama, 1991).

        `weights` (M,) sum to one; by default they are equal.
        """
        given, world = np.asarray(given, dtype=float), np.asarray(world, dtype=float)
        if weights is None:
            centre, middle = given.mean(axis=0), world.mean(axis=-2)
            apart = given - centre
        else:
            weights = np.asarray(weights, dtype=float)
            centre, middle = weights @ given, weights @ world
            apart = weights[:, None] * (given - centre)
        u, _, vt = np.linalg.svd(np.swapaxes(world - middle[..., None, :], -1, -2) @ apart)
        sign = np.ones(middle.shape)
        sign[..., 2] = np.sign(np.linalg.det(u @ vt))
        rotation = (u * sign[..., None, :]) @ vt
        return self.from_matrix(np.concatenate([rotation, (middle - rotation @ centre)[..., None]], axis=-1))


def skew(v: Array) -> Array:
    """Matrix of the cross product, (..., 3) -> (..., 3, 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -v[..., 0], -v[..., 1], -v[..., 2]
    return out
