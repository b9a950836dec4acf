"""Scalar algebra of unit quaternions (x, y, z, w), for the loops of other compiled functions."""

import math

from numba import njit


@njit(cache=True, error_model="numpy", inline="always")
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


@njit(cache=True, error_model="numpy")
def multiply(a, b):
    """Product of two, renormalised."""
    x = a[3] * b[0] - a[2] * b[1] + a[1] * b[2] + a[0] * b[3]
    y = a[2] * b[0] + a[3] * b[1] - a[0] * b[2] + a[1] * b[3]
    z = -a[1] * b[0] + a[0] * b[1] + a[3] * b[2] + a[2] * b[3]
    w = -a[0] * b[0] - a[1] * b[1] - a[2] * b[2] + a[3] * b[3]
    return unit(x, y, z, w)


@njit(cache=True, error_model="numpy")
def unit(x, y, z, w):
    """Divided by the norm."""
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return x / norm, y / norm, z / norm, w / norm


@njit(cache=True, error_model="numpy")
def turned(q, p):
    """A vector p turned: p + w t + u × t with t = 2 u × p."""
    u = (q[0], q[1], q[2])
    twice = cross(u, (p[0] + p[0], p[1] + p[1], p[2] + p[2]))
    across = cross(u, twice)
    return (
        p[0] + q[3] * twice[0] + across[0],
        p[1] + q[3] * twice[1] + across[1],
        p[2] + q[3] * twice[2] + across[2],
    )


@njit(cache=True, error_model="numpy")
def cross(a, b):
    """Cross product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
