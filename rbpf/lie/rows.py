"""Vectors and quaternions stored component first, so that each operation runs along the batch.

A vector is (3, ...), a unit quaternion is (4, ...) in the order x y z w.
"""

import numpy as np
from numpy.typing import ArrayLike

from rbpf.lie.base import Array
from rbpf.lie.series import TINY

_CYCLE = np.array([0, 1, 2, 0, 1])
_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
_LEFT_MATRIX = np.array([[3, 6, 1, 0], [2, 3, 4, 1], [5, 0, 3, 2], [4, 5, 6, 3]])


def to_rows(x: ArrayLike, ndim: int = 0) -> Array:
    """(..., n) -> contiguous (n, ...), with leading axes of length one up to ndim axes in all."""
    x = np.asarray(x, dtype=float)
    if x.ndim < ndim:
        x = x.reshape((1,) * (ndim - x.ndim) + x.shape)
    return np.ascontiguousarray(x.transpose(x.ndim - 1, *range(x.ndim - 1)))


def aligned_rows(x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Both as rows, with as many axes as the longer of the two, so that their batches broadcast."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    ndim = max(x.ndim, y.ndim)
    return to_rows(x, ndim), to_rows(y, ndim)


def from_rows(*parts: Array) -> Array:
    """Inverse of `to_rows` for blocks of rows of one batch: (n_1, ...), (n_2, ...) ... -> (..., sum n)."""
    out = np.empty((*parts[0].shape[1:], sum([len(part) for part in parts])))
    rows = out.transpose(out.ndim - 1, *range(out.ndim - 1))
    start = 0
    for part in parts:
        stop = start + len(part)
        rows[start:stop] = part
        start = stop
    return out


def dot(a: Array, b: Array) -> Array:
    """Scalar product a . b of rows (n, ...) -> (...)."""
    return np.add.reduce(a * b, 0)


def conjugate(q: Array) -> Array:
    """Inverse of a unit quaternion."""
    return _CONJUGATE.reshape(4, *(1,) * (q.ndim - 1)) * q


def unit(q: Array) -> Array:
    """Quaternion divided by its norm."""
    return q / np.sqrt(dot(q, q))


def multiply(a: Array, b: Array) -> Array:
    """Product of two unit quaternions, renormalised."""
    # The matrix of a from the left has entries +-a_i: rows 4 to 7 of the table are -a.
    table = np.concatenate((a, -a)).take(_LEFT_MATRIX, 0)
    return unit(np.einsum("ij...,j...->i...", table, b))


def rotate(q: Array, p: Array) -> Array:
    """Vectors p (3, ...) turned by a unit quaternion: p + w t + u x t with t = 2 u x p."""
    u = _cyclic(q)
    twice = _cross(u, _cyclic(p + p))
    return p + q[3] * twice + _cross(u, _cyclic(twice))


def exp_rows(omega: Array, v: Array) -> tuple[Array, Array]:
    """Quaternion and translation V v of Exp([omega, v]), with V = I + b W + c W^2.

    From s = sin(theta / 2) / theta and k = cos(theta / 2): b = 2 s^2 and c = (1 - 2 s k) / theta^2.
    The cancellation in c needs no series, because W^2 gives back the theta^2 that it divides by.
    """
    squared = dot(omega, omega) + TINY
    theta = np.sqrt(squared)
    half = 0.5 * theta
    s, k = np.sin(half) / theta, np.cos(half)
    twice = s + s
    axis = _cyclic(omega)
    first = _cross(axis, _cyclic(v))
    second = _cross(axis, _cyclic(first))
    translation = v + twice * s * first + (1.0 - twice * k) / squared * second
    return np.concatenate((s * omega, k[None])), translation


def log_rows(q: Array, t: Array) -> tuple[Array, Array]:
    """Tangent (omega, v) of a quaternion of either sign and a translation; the inverse of `exp_rows`."""
    u, w = q[:3], q[3]
    s, k = np.sqrt(dot(u, u) + TINY), np.abs(w)
    half = np.arctan2(s, k)
    omega = np.where(w < 0.0, -2.0, 2.0) * half / s * u
    axis = _cyclic(omega)
    first = _cross(axis, _cyclic(t))
    second = _cross(axis, _cyclic(first))
    return omega, t - 0.5 * first + (1.0 - half * k / s) / (4.0 * half * half) * second


def _cyclic(v: Array) -> Array:
    # Rows x y z x y: the cross product is then two products of slices.
    return v.take(_CYCLE, 0)


def _cross(a: Array, b: Array) -> Array:
    return a[1:4] * b[2:] - a[2:] * b[1:4]
