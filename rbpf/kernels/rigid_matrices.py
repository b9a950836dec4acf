"""Matrices of SE(3) row by row, for `rbpf.lie.SE3`; storage and tangent as in `rbpf.kernels.rigid`."""

import numpy as np
from numba import njit, void

from rbpf.kernels.quaternion import cross, rotation
from rbpf.kernels.series import (
    coefficient_b,
    coefficient_c,
    coefficient_d,
    coefficient_e,
    inverse_coefficient,
)
from rbpf.kernels.signature import CUBE, READ_ONLY


@njit(cache=True, error_model="numpy")
def _fill_rotation(w, linear, square, out):
    """I + linear W + square W², with W² = ω ωᵀ − θ² I."""
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    for j in range(3):
        for k in range(3):
            out[j, k] = square * (w[j] * w[k])
        out[j, j] += 1.0 - square * squared
    _add_skew(out, linear, w)


@njit(cache=True, error_model="numpy")
def _add_skew(out, scale, w):
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        out[n, m] += scale * w[k]
        out[m, n] -= scale * w[k]


@njit(cache=True, error_model="numpy")
def _fill_coupling(w, v, out):
    """The block Q of the left Jacobian, Barfoot (2017) (7.86).

    With the skew matrices W and V, Q = V/2 + c (WV + VW + WVW) + d (WWV + VWW − 3 WVW) + e (WVWW + WWVW), and with
    s = ω · v the products are WVW = −s W, WV + VW = ω vᵀ + v ωᵀ − 2 s I, WWV + VWW = −θ² V − s W: none is left.
    """
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    s = w[0] * v[0] + w[1] * v[1] + w[2] * v[2]
    c, d, e = coefficient_c(squared), coefficient_d(squared), coefficient_e(squared)
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
        _fill_rotation(w, coefficient_b(squared), coefficient_c(squared), out[i, :3, :3])
        out[i, 3:, 3:] = out[i, :3, :3]
        _fill_coupling(w, v, out[i, 3:, :3])


@njit(void(READ_ONLY, CUBE), cache=True, error_model="numpy")
def left_jacobian_inverse(xi, out):
    """[[A⁻¹, 0], [−A⁻¹ Q A⁻¹, A⁻¹]] with A⁻¹ = I − W/2 + (1 − (θ/2) cot(θ/2))/θ² W²."""
    out[:] = 0.0
    middle, half = np.empty((3, 3)), np.empty((3, 3))
    for i in range(out.shape[0]):
        w, v = (xi[i, 0], xi[i, 1], xi[i, 2]), (xi[i, 3], xi[i, 4], xi[i, 5])
        squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        _fill_rotation(w, -0.5, inverse_coefficient(squared), out[i, :3, :3])
        out[i, 3:, 3:] = out[i, :3, :3]
        _fill_coupling(w, v, middle)
        _product(out[i, :3, :3], middle, half)
        _product(half, out[i, :3, :3], middle)
        out[i, 3:, :3] = -middle


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
