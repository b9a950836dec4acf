"""SE(2) row by row, for `rbpf.lie.SE2`: elements [theta, x, y], tangents [omega, v]; in complex arithmetic.

An argument with one row is broadcast to all rows of the other one. Results go to the last argument.
"""

import math

import numpy as np
from numba import njit, void

from rbpf.kernels.se3 import coefficients
from rbpf.kernels.signature import CUBE, MATRIX, READ_ONLY


@njit(cache=True, error_model="numpy")
def _wrap(angle):
    """Wraps to (−π, π]; angles in this range are returned unrounded."""
    return min(angle - 2.0 * math.pi * np.ceil(angle / (2.0 * math.pi) - 0.5), math.pi)


@njit(cache=True, error_model="numpy")
def _sinc(angle):
    return math.sin(angle) / angle if angle != 0.0 else 1.0


@njit(cache=True, error_model="numpy")
def _phasor(angle):
    return complex(math.cos(angle), math.sin(angle))


@njit(void(READ_ONLY, READ_ONLY, MATRIX), cache=True, error_model="numpy")
def retract(x, xi, out):
    """The product x Exp(ξ): the rotations exp(iθ) and exp(iω/2) are combined into one."""
    for i in range(out.shape[0]):
        j, k = min(i, len(x) - 1), min(i, len(xi) - 1)
        half = 0.5 * xi[k, 0]
        step = _sinc(half) * _phasor(x[j, 0] + half) * complex(xi[k, 1], xi[k, 2])
        out[i, 0], out[i, 1], out[i, 2] = _wrap(x[j, 0] + xi[k, 0]), x[j, 1] + step.real, x[j, 2] + step.imag


@njit(void(READ_ONLY, READ_ONLY, MATRIX), cache=True, error_model="numpy")
def local(x, y, out):
    """Log(x⁻¹ y)."""
    for i in range(out.shape[0]):
        j, k = min(i, len(x) - 1), min(i, len(y) - 1)
        angle = _wrap(y[k, 0] - x[j, 0])
        half = 0.5 * angle
        step = _phasor(-x[j, 0] - half) * complex(y[k, 1] - x[j, 1], y[k, 2] - x[j, 2]) / _sinc(half)
        out[i, 0], out[i, 1], out[i, 2] = angle, step.real, step.imag


@njit(cache=True, error_model="numpy")
def _blocks(xi, i):
    """V and q of the left Jacobian [[1, 0], [q, V]], q = v (θ c − i b) with b and c as in `rbpf.kernels.se3`."""
    sinc = _sinc(0.5 * xi[i, 0])
    # b = (1 − cos θ)/θ² from the half angle, which avoids cancellation.
    slope = complex(xi[i, 0] * coefficients(xi[i, 0] * xi[i, 0])[0], -0.5 * sinc * sinc)
    return sinc * _phasor(0.5 * xi[i, 0]), complex(xi[i, 1], xi[i, 2]) * slope


@njit(cache=True, error_model="numpy")
def _fill(linear, column, out):
    out[0, 0], out[0, 1], out[0, 2] = 1.0, 0.0, 0.0
    out[1, 0], out[1, 1], out[1, 2] = column.real, linear.real, -linear.imag
    out[2, 0], out[2, 1], out[2, 2] = column.imag, linear.imag, linear.real


@njit(void(READ_ONLY, CUBE), cache=True, error_model="numpy")
def left_jacobian(xi, out):
    """J_l."""
    for i in range(out.shape[0]):
        linear, column = _blocks(xi, i)
        _fill(linear, column, out[i])


@njit(void(READ_ONLY, CUBE), cache=True, error_model="numpy")
def left_jacobian_inverse(xi, out):
    """[[1, 0], [−V⁻¹q, V⁻¹]]."""
    for i in range(out.shape[0]):
        linear, column = _blocks(xi, i)
        _fill(1.0 / linear, -column / linear, out[i])
