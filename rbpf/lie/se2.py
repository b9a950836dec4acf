"""SE(2), rigid motions of the plane; storage [theta, x, y], tangent [omega, vx, vy].

In complex numbers a rotation is the factor exp(i theta), and Exp([omega, v]) has the translation V v with
V = sin(h) / h exp(i h), h = omega / 2.
"""

from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbpf.arrays import Array, Float, Like
from rbpf.kernels import se2 as kernels
from rbpf.lie.base import LieGroup, StateArray, States, TangentArray, TangentMatrix, Tangents, of_pairs, of_rows

Complex = NDArray[np.complex128]

_TURN = 2.0 * np.pi


@final
class SE2Group(LieGroup):
    """SE(2); element world_from_body = [theta, x, y], theta in (-pi, pi]."""

    size = 3
    dim = 3
    point_dim = 2  #: Coordinates of a point, D.

    def __repr__(self) -> str:
        return "SE2"

    def identity(self, shape: tuple[int, ...] = ()) -> Float[np.ndarray, "*shape 3"]:
        return np.zeros((*shape, 3))

    def exp(self, xi: Tangents) -> StateArray:
        xi = _contiguous(xi)
        half = 0.5 * xi[..., 0]
        return _pack(_wrap(xi[..., 0]), _sinc(half) * _phasor(half) * _planar(xi))

    def log(self, x: States) -> TangentArray:
        x = _contiguous(x)
        angle = _wrap(x[..., 0])
        half = 0.5 * angle
        return _pack(angle, _phasor(-half) * _planar(x) / _sinc(half))

    def compose(self, a: States, b: States) -> StateArray:
        a, b = _contiguous(a), _contiguous(b)
        return _pack(_wrap(a[..., 0] + b[..., 0]), _planar(a) + _phasor(a[..., 0]) * _planar(b))

    def inverse(self, a: States) -> StateArray:
        a = _contiguous(a)
        return _pack(_wrap(-a[..., 0]), -_phasor(-a[..., 0]) * _planar(a))

    def retract(self, x: States, xi: Tangents) -> StateArray:
        return of_pairs(kernels.retract, x, xi, (3, 3, 3))

    def local(self, x: States, y: States) -> TangentArray:
        return of_pairs(kernels.local, x, y, (3, 3, 3))

    def _mean_from(self, mean: Array, points: Array, weights: Array) -> Array:
        # The angle does not depend on the position; given the angle, the rest is linear in the position.
        mean, points, angle = _contiguous(mean), _contiguous(points), float(mean[0])
        iterations, tolerance = self.mean_rule
        for _ in range(iterations):
            half = 0.5 * _wrap(points[:, 0] - angle)
            step = 2.0 * float((weights * half).sum())
            angle += step
            if abs(step) <= tolerance:
                break
        pull = weights / _sinc(half) * _phasor(-half)
        apart = (pull * (_planar(points) - _planar(mean))).sum() / pull.sum()
        return _pack(_wrap(np.asarray(angle)), _planar(mean) + apart)

    def normalise(self, x: States) -> StateArray:
        x = _contiguous(x)
        return _pack(_wrap(x[..., 0]), _planar(x))

    def adjoint(self, a: States) -> TangentMatrix:
        a = _contiguous(a)
        out = np.zeros((*a.shape, 3))
        out[..., 0, 0], out[..., 1, 0], out[..., 2, 0] = 1.0, a[..., 2], -a[..., 1]
        out[..., 1:, 1:] = self.rotation(a)
        return out

    def left_jacobian(self, xi: Tangents) -> TangentMatrix:
        return of_rows(kernels.left_jacobian, xi, 3, (3, 3))

    def left_jacobian_inverse(self, xi: Tangents) -> TangentMatrix:
        return of_rows(kernels.left_jacobian_inverse, xi, 3, (3, 3))

    def transform(self, a: States, p: Like[ArrayLike, "*#batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """World points [m] of body points, with a = world_from_body."""
        a, p = _contiguous(a), np.asarray(p, dtype=float)
        return _pair(_planar(a) + _phasor(a[..., 0]) * (p[..., 0] + 1j * p[..., 1]))

    def inverse_transform(self, a: States, p: Like[ArrayLike, "*#batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        a, p = _contiguous(a), np.asarray(p, dtype=float)
        return _pair(_phasor(-a[..., 0]) * (p[..., 0] + 1j * p[..., 1] - _planar(a)))

    def transform_jacobian(self, p: Like[ArrayLike, "*batch 2"]) -> Float[np.ndarray, "*batch 2 3"]:
        """∂(Exp(ε) p)/∂ε at ε = 0, of points p [m]: a quarter turn of p, then I."""
        p = np.asarray(p, dtype=float)
        turned = np.stack([-p[..., 1:2], p[..., :1]], axis=-2)
        return np.concatenate([turned, np.broadcast_to(np.eye(2), (*p.shape, 2))], axis=-1)

    def translation(self, a: States) -> Float[np.ndarray, "*batch 2"]:
        """View of the translation, (..., 3) -> (..., 2)."""
        return np.asarray(a, dtype=float)[..., 1:]

    def rotation(self, a: States) -> Float[np.ndarray, "*batch 2 2"]:
        """Rotation matrix, (..., 3) -> (..., 2, 2)."""
        z = _phasor(_contiguous(a)[..., 0])
        out = np.empty((*np.shape(z), 2, 2))
        out[..., 0, 0] = out[..., 1, 1] = z.real
        out[..., 1, 0], out[..., 0, 1] = z.imag, -z.imag
        return out


def _wrap(angle: Array) -> Array:
    # An angle already in (-pi, pi] must be returned unrounded; the minimum catches pi + 1 ulp.
    return np.minimum(angle - _TURN * np.ceil(angle / _TURN - 0.5), np.pi)


def _sinc(angle: Array) -> Array:
    positive = np.maximum(np.abs(angle), 1e-300)
    return np.sin(positive) / positive


def _phasor(angle: Array) -> Complex:
    out = np.empty(np.shape(angle), dtype=complex)
    out.real = np.cos(angle)
    out.imag = np.sin(angle)
    return out


def _contiguous(x: ArrayLike) -> Array:
    return np.ascontiguousarray(x, dtype=float)


def _planar(x: Array) -> Complex:
    return x[..., 1:].view(complex)[..., 0]


def _pair(z: Complex) -> Array:
    return np.stack([z.real, z.imag], axis=-1)


def _pack(angle: Array, z: Complex) -> Array:
    out = np.empty((*np.shape(z), 3))
    out[..., 0] = angle
    _planar(out)[...] = z
    return out
