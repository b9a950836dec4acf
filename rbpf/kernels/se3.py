"""SE(3) row by row, for `rbpf.lie.SE3`: elements [qx, qy, qz, qw, tx, ty, tz], tangents [omega, v].

An argument with one row is broadcast to all rows of the other one. Results go to the last argument. The scalar algebra of
unit quaternions (x, y, z, w) comes first, also for the loops of other compiled functions.

Coefficients of the closed-form Jacobians, accurate down to angle zero, with x = θ² and series below x = 1, where the
closed forms suffer from cancellation:

    b = (1 − cos θ)/θ²                       = Σ_k (−x)^k / (2k + 2)!
    c = (θ − sin θ)/θ³                       = Σ_k (−x)^k / (2k + 3)!
    d = (θ²/2 + cos θ − 1)/θ⁴                = Σ_k (−x)^k / (2k + 4)!
    e = (2θ − 3 sin θ + θ cos θ)/(2θ⁵)       = Σ_k (−x)^k (k + 1) / (2k + 5)!
"""

import math

import numpy as np
from numba import float64, int64, njit, types, void

from rbpf.kernels.signature import CUBE, MATRIX, READ_ONLY

TINY = 1e-300  #: Added to θ² to avoid division by zero: its root is far below any angle that changes a result.

_TERMS = 10
_C = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(_TERMS))
_D = tuple((-1) ** k / math.factorial(2 * k + 4) for k in range(_TERMS))
_E = tuple((-1) ** k * (k + 1) / math.factorial(2 * k + 5) for k in range(_TERMS))

_ONE = void(READ_ONLY, MATRIX)
_TWO = void(READ_ONLY, READ_ONLY, MATRIX)
WEIGHTS = types.Array(float64, 1, "C", readonly=True)


@njit(cache=True, error_model="numpy")
def _horner(coefficients, x):
    total = coefficients[_TERMS - 1]
    for k in range(_TERMS - 2, -1, -1):
        total = total * x + coefficients[k]
    return total


@njit(cache=True, error_model="numpy")
def coefficients(x):
    """The coefficients c, d and e."""
    if x < 1.0:
        return _horner(_C, x), _horner(_D, x), _horner(_E, x)
    theta = math.sqrt(x)
    sine, cosine = math.sin(theta), math.cos(theta)
    e = (2.0 * theta - 3.0 * sine + theta * cosine) / (2.0 * (x * x) * theta)
    return (theta - sine) / (x * theta), (0.5 * x + cosine - 1.0) / (x * x), e


@njit(cache=True, error_model="numpy", forceinline=True)
def rotation(qx, qy, qz, qw):
    """Rotation matrix by rows."""
    return (
        1.0 - 2.0 * (qy * qy + qz * qz),
        2.0 * (qx * qy - qw * qz),
        2.0 * (qx * qz + qw * qy),
        2.0 * (qx * qy + qw * qz),
        1.0 - 2.0 * (qx * qx + qz * qz),
        2.0 * (qy * qz - qw * qx),
        2.0 * (qx * qz - qw * qy),
        2.0 * (qy * qz + qw * qx),
        1.0 - 2.0 * (qx * qx + qy * qy),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def times(r, x, y, z):
    """A rotation matrix by rows times a vector."""
    return r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z


@njit(cache=True, error_model="numpy", forceinline=True)
def back(r, x, y, z):
    """The transpose of a rotation matrix by rows times a vector."""
    return r[0] * x + r[3] * y + r[6] * z, r[1] * x + r[4] * y + r[7] * z, r[2] * x + r[5] * y + r[8] * z


@njit(cache=True, error_model="numpy")
def multiply(a, b):
    """Quaternion product, renormalised."""
    x = a[3] * b[0] - a[2] * b[1] + a[1] * b[2] + a[0] * b[3]
    y = a[2] * b[0] + a[3] * b[1] - a[0] * b[2] + a[1] * b[3]
    z = -a[1] * b[0] + a[0] * b[1] + a[3] * b[2] + a[2] * b[3]
    w = -a[0] * b[0] - a[1] * b[1] - a[2] * b[2] + a[3] * b[3]
    return unit(x, y, z, w)


@njit(cache=True, error_model="numpy")
def unit(x, y, z, w):
    """Normalised quaternion."""
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return x / norm, y / norm, z / norm, w / norm


@njit(cache=True, error_model="numpy")
def quaternion(r):
    """Quaternion of a rotation matrix (3, ≥3): the row of 4 q qᵀ with the largest diagonal avoids cancellation."""
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    most = max(trace, r[0, 0], r[1, 1], r[2, 2])
    if most == trace:
        q = (x, y, z, 1.0 + trace)
    elif most == r[0, 0]:
        q = (r[0, 0] + r[0, 0] + (1.0 - trace), xy, xz, x)
    elif most == r[1, 1]:
        q = (xy, r[1, 1] + r[1, 1] + (1.0 - trace), yz, y)
    else:
        q = (xz, yz, r[2, 2] + r[2, 2] + (1.0 - trace), z)
    return unit(q[0], q[1], q[2], q[3])


@njit(cache=True, error_model="numpy")
def turned(q, p):
    """A rotated vector, p + w t + u × t with t = 2 u × p."""
    u = (q[0], q[1], q[2])
    twice = cross(u, (p[0] + p[0], p[1] + p[1], p[2] + p[2]))
    across = cross(u, twice)
    return (p[0] + q[3] * twice[0] + across[0], p[1] + q[3] * twice[1] + across[1], p[2] + q[3] * twice[2] + across[2])


@njit(cache=True, error_model="numpy")
def cross(a, b):
    """Cross product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


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

    With s = sin(θ/2)/θ and k = cos(θ/2): b = 2 s² and c = (1 − 2 s k)/θ². The cancellation in c needs no series,
    as c is multiplied by W², which is of order θ².
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
def from_matrix(m, out):
    """Elements of matrices (K, 12), 3 × 4 by rows, with qw ≥ 0."""
    for i in range(out.shape[0]):
        x, y, z, w = quaternion(m[i].reshape(3, 4))
        sign = -1.0 if w < 0.0 else 1.0
        _store((sign * x, sign * y, sign * z, sign * w), (m[i, 3], m[i, 7], m[i, 11]), out, i)


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
    for i in range(out.shape[0]):
        j, k = min(i, len(a) - 1), min(i, len(b) - 1)
        q = _quat(a, j)
        t = _added(_vector(a, j, 4), turned(q, _vector(b, k, 4)))
        _store(multiply(q, _quat(b, k)), t, out, i)


@njit(_TWO, cache=True, error_model="numpy")
def retract(x, xi, out):
    """The product x Exp(ξ)."""
    for i in range(out.shape[0]):
        j, k = min(i, len(x) - 1), min(i, len(xi) - 1)
        q = _quat(x, j)
        turn, shift = exp_pair(_vector(xi, k, 0), _vector(xi, k, 3))
        _store(multiply(q, turn), _added(_vector(x, j, 4), turned(q, shift)), out, i)


@njit(_TWO, cache=True, error_model="numpy")
def local(x, y, out):
    """Log(x⁻¹ y).

    Translations are subtracted before the rotation, so that no digits are lost for neighbouring points far from the
    origin.
    """
    for i in range(out.shape[0]):
        j, k = min(i, len(x) - 1), min(i, len(y) - 1)
        q = _inverse_quat(x, j)
        apart = (y[k, 4] - x[j, 4], y[k, 5] - x[j, 5], y[k, 6] - x[j, 6])
        _store_log(multiply(q, _quat(y, k)), turned(q, apart), out, i)


@njit(void(READ_ONLY, WEIGHTS, int64, float64, MATRIX), cache=True, error_model="numpy")
def mean(points, weights, iterations, tolerance, out):
    """Replaces a guess (1, 7) by the weighted Fréchet mean of points (N, 7), Gauss-Newton in the order of the rows."""
    apart, step = np.empty((len(points), 6)), np.empty((1, 6))
    for _ in range(iterations):
        local(out, points, apart)
        step[:] = 0.0
        for i in range(len(points)):
            for j in range(6):
                step[0, j] += weights[i] * apart[i, j]
        retract(out, step, out)
        if np.abs(step).max() <= tolerance:
            break


@njit(_TWO, cache=True, error_model="numpy")
def transform(a, p, out):
    """World points of body points (K, 3)."""
    for i in range(out.shape[0]):
        j, k = min(i, len(a) - 1), min(i, len(p) - 1)
        out[i, 0], out[i, 1], out[i, 2] = _added(_vector(a, j, 4), turned(_quat(a, j), _vector(p, k, 0)))


@njit(_TWO, cache=True, error_model="numpy")
def inverse_transform(a, p, out):
    """Body points of world points (K, 3)."""
    for i in range(out.shape[0]):
        j, k = min(i, len(a) - 1), min(i, len(p) - 1)
        apart = (p[k, 0] - a[j, 4], p[k, 1] - a[j, 5], p[k, 2] - a[j, 6])
        out[i, 0], out[i, 1], out[i, 2] = turned(_inverse_quat(a, j), apart)


@njit(cache=True, error_model="numpy")
def _fill_rotations(w, linear, square, out):
    """Fills both diagonal 3x3 blocks: I + linear W + square W², with W² = ω ωᵀ − θ² I."""
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    for j in range(3):
        for k in range(3):
            out[j, k] = square * (w[j] * w[k])
        out[j, j] += 1.0 - square * squared
    _add_skew(out, linear, w)
    for j in range(3):
        for k in range(3):
            out[3 + j, 3 + k] = out[j, k]


@njit(cache=True, error_model="numpy")
def _add_skew(out, scale, w):
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        out[n, m] += scale * w[k]
        out[m, n] -= scale * w[k]


@njit(cache=True, error_model="numpy")
def _fill_coupling(w, v, c, d, e, out):
    """Fills the block Q of the left Jacobian, Barfoot (2017) (7.86).

    With the skew matrices W and V, Q = V/2 + c (WV + VW + WVW) + d (WWV + VWW − 3 WVW) + e (WVWW + WWVW), and with
    s = ω · v the products are WVW = −s W, WV + VW = ω vᵀ + v ωᵀ − 2 s I, WWV + VWW = −θ² V − s W: none is left.
    """
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    s = w[0] * v[0] + w[1] * v[1] + w[2] * v[2]
    for j in range(3):
        for k in range(3):
            out[j, k] = w[j] * (c * v[k] - (2.0 * e * s) * w[k]) + c * (v[j] * w[k])
        out[j, j] += 2.0 * s * (e * squared - c)
    _add_skew(out, s * (2.0 * d - c), w)
    _add_skew(out, 0.5 - d * squared, v)


@njit(cache=True, error_model="numpy")
def _product(a, b, out):
    for j in range(3):
        for k in range(3):
            out[j, k] = a[j, 0] * b[0, k] + a[j, 1] * b[1, k] + a[j, 2] * b[2, k]


@njit(void(READ_ONLY, CUBE), cache=True, error_model="numpy")
def left_jacobian(xi, out):
    """J_l = [[A, 0], [Q, A]] with A = I + b W + c W²."""
    out[:] = 0.0
    for i in range(out.shape[0]):
        w, v = (xi[i, 0], xi[i, 1], xi[i, 2]), (xi[i, 3], xi[i, 4], xi[i, 5])
        squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        c, d, e = coefficients(squared)
        # (1 − cos θ)/θ² from the half angle, which avoids cancellation.
        theta = math.sqrt(squared + TINY)
        fraction = math.sin(0.5 * theta) / theta
        _fill_rotations(w, 2.0 * (fraction * fraction), c, out[i])
        _fill_coupling(w, v, c, d, e, out[i, 3:, :3])


@njit(void(READ_ONLY, CUBE), cache=True, error_model="numpy")
def left_jacobian_inverse(xi, out):
    """[[A⁻¹, 0], [−A⁻¹ Q A⁻¹, A⁻¹]] with A⁻¹ = I − W/2 + (1 − (θ/2) cot(θ/2))/θ² W²."""
    out[:] = 0.0
    middle, half = np.empty((3, 3)), np.empty((3, 3))
    for i in range(out.shape[0]):
        w, v = (xi[i, 0], xi[i, 1], xi[i, 2]), (xi[i, 3], xi[i, 4], xi[i, 5])
        squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        # (1 − (θ/2) cot(θ/2))/θ², singular at 2π. Its rounding error is that of 1/θ², and every use multiplies it by θ².
        shifted = squared + TINY
        angle = 0.5 * math.sqrt(shifted)
        cotangent = (1.0 - angle * math.cos(angle) / math.sin(angle)) / shifted
        _fill_rotations(w, -0.5, cotangent, out[i])
        c, d, e = coefficients(squared)
        _fill_coupling(w, v, c, d, e, middle)
        _product(out[i, :3, :3], middle, half)
        _product(half, out[i, :3, :3], middle)
        for j in range(3):
            for k in range(3):
                out[i, 3 + j, k] = -middle[j, k]


@njit(void(READ_ONLY, CUBE), cache=True, error_model="numpy")
def rotations(x, out):
    """Rotation matrices of elements."""
    for i in range(out.shape[0]):
        r = rotation(x[i, 0], x[i, 1], x[i, 2], x[i, 3])
        for j in range(3):
            for k in range(3):
                out[i, j, k] = r[3 * j + k]


@njit(void(READ_ONLY, CUBE), cache=True, error_model="numpy")
def adjoint(x, out):
    """[[R, 0], [[t]× R, R]]."""
    out[:] = 0.0
    for i in range(out.shape[0]):
        r = rotation(x[i, 0], x[i, 1], x[i, 2], x[i, 3])
        for k in range(3):
            column = (r[k], r[3 + k], r[6 + k])
            across = cross((x[i, 4], x[i, 5], x[i, 6]), column)
            for j in range(3):
                out[i, j, k] = out[i, 3 + j, 3 + k] = column[j]
                out[i, 3 + j, k] = across[j]
