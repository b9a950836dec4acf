"""SE(3) row by row, for `rbpf.lie.SE3`: elements [qx, qy, qz, qw, tx, ty, tz], tangents [omega, v].

An argument with one row belongs to all rows of the other one. Results go to the last argument.
"""

import math

from numba import njit, void

from rbpf.kernels.quaternion import cross, multiply, turned
from rbpf.kernels.series import TINY
from rbpf.kernels.signature import MATRIX, READ_ONLY

_ONE = void(READ_ONLY, MATRIX)
_TWO = void(READ_ONLY, READ_ONLY, MATRIX)


@njit(cache=True, error_model="numpy")
def _quat(x, i):
    return x[i, 0], x[i, 1], x[i, 2], x[i, 3]


@njit(cache=True, error_model="numpy")
def _inverse_quat(x, i):
    return -x[i, 0], -x[i, 1], -x[i, 2], x[i, 3]


@njit(cache=True, error_model="numpy")
def _vector(x, i, first):
    return x[i, first], x[i, first + 1], x[i, first + 2]


@njit(cache=True, error_model="numpy")
def _store(q, t, out, i):
    out[i, 0], out[i, 1], out[i, 2], out[i, 3] = q
    out[i, 4], out[i, 5], out[i, 6] = t


@njit(cache=True, error_model="numpy")
def _added(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(cache=True, error_model="numpy")
def exp_pair(w, v):
    """Quaternion and translation V v of Exp([ω, v]), with V = I + b W + c W².

    From s = sin(θ/2)/θ and k = cos(θ/2): b = 2 s² and c = (1 − 2 s k)/θ². The cancellation in c needs no series,
    because W² gives back the θ² that it divides by.
    """
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2] + TINY
    theta = math.sqrt(squared)
    half = 0.5 * theta
    s, k = math.sin(half) / theta, math.cos(half)
    twice = s + s
    b, c = twice * s, (1.0 - twice * k) / squared
    first = cross(w, v)
    second = cross(w, first)
    shift = (
        v[0] + b * first[0] + c * second[0],
        v[1] + b * first[1] + c * second[1],
        v[2] + b * first[2] + c * second[2],
    )
    return (s * w[0], s * w[1], s * w[2], k), shift


@njit(cache=True, error_model="numpy")
def _store_log(q, t, out, i):
    """Tangent of a quaternion of either sign and a translation; the inverse of `exp_pair`."""
    s = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + TINY)
    k = abs(q[3])
    half = math.atan2(s, k)
    scale = (-2.0 if q[3] < 0.0 else 2.0) * half / s
    w = (scale * q[0], scale * q[1], scale * q[2])
    first = cross(w, t)
    second = cross(w, first)
    c = (1.0 - half * k / s) / (4.0 * half * half)
    for j in range(3):
        out[i, j] = w[j]
        out[i, 3 + j] = t[j] - 0.5 * first[j] + c * second[j]


@njit(_ONE, cache=True, error_model="numpy")
def exp(xi, out):
    """Exponential map."""
    for i in range(out.shape[0]):
        q, t = exp_pair(_vector(xi, i, 0), _vector(xi, i, 3))
        _store(q, t, out, i)


@njit(_ONE, cache=True, error_model="numpy")
def log(x, out):
    """Logarithm, with the rotation angle in [0, π]."""
    for i in range(out.shape[0]):
        _store_log(_quat(x, i), _vector(x, i, 4), out, i)


@njit(_ONE, cache=True, error_model="numpy")
def inverse(x, out):
    """Group inverse."""
    for i in range(out.shape[0]):
        q = _inverse_quat(x, i)
        t = turned(q, _vector(x, i, 4))
        _store(q, (-t[0], -t[1], -t[2]), out, i)


@njit(_TWO, cache=True, error_model="numpy")
def compose(a, b, out):
    """Group product."""
    step_a, step_b = int(a.shape[0] > 1), int(b.shape[0] > 1)
    for i in range(out.shape[0]):
        j, k = step_a * i, step_b * i
        q = _quat(a, j)
        t = _added(_vector(a, j, 4), turned(q, _vector(b, k, 4)))
        _store(multiply(q, _quat(b, k)), t, out, i)


@njit(_TWO, cache=True, error_model="numpy")
def retract(x, xi, out):
    """The product x Exp(ξ)."""
    step_x, step_xi = int(x.shape[0] > 1), int(xi.shape[0] > 1)
    for i in range(out.shape[0]):
        j, k = step_x * i, step_xi * i
        q = _quat(x, j)
        turn, shift = exp_pair(_vector(xi, k, 0), _vector(xi, k, 3))
        _store(multiply(q, turn), _added(_vector(x, j, 4), turned(q, shift)), out, i)


@njit(_TWO, cache=True, error_model="numpy")
def local(x, y, out):
    """Log(x⁻¹ y).

    The difference of the translations is taken before the rotation, so that near points far from the origin lose no
    digits.
    """
    step_x, step_y = int(x.shape[0] > 1), int(y.shape[0] > 1)
    for i in range(out.shape[0]):
        j, k = step_x * i, step_y * i
        q = _inverse_quat(x, j)
        apart = (y[k, 4] - x[j, 4], y[k, 5] - x[j, 5], y[k, 6] - x[j, 6])
        _store_log(multiply(q, _quat(y, k)), turned(q, apart), out, i)


@njit(_TWO, cache=True, error_model="numpy")
def transform(a, p, out):
    """World points of body points (K, 3)."""
    step_a, step_p = int(a.shape[0] > 1), int(p.shape[0] > 1)
    for i in range(out.shape[0]):
        j, k = step_a * i, step_p * i
        out[i, 0], out[i, 1], out[i, 2] = _added(_vector(a, j, 4), turned(_quat(a, j), _vector(p, k, 0)))


@njit(_TWO, cache=True, error_model="numpy")
def inverse_transform(a, p, out):
    """Body points of world points (K, 3)."""
    step_a, step_p = int(a.shape[0] > 1), int(p.shape[0] > 1)
    for i in range(out.shape[0]):
        j, k = step_a * i, step_p * i
        apart = (p[k, 0] - a[j, 4], p[k, 1] - a[j, 5], p[k, 2] - a[j, 6])
        out[i, 0], out[i, 1], out[i, 2] = turned(_inverse_quat(a, j), apart)
