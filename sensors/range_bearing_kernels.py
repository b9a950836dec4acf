"""Fused kernels of range-bearing and position sensors; see `rbpf.sensors.range_bearing` for the equations."""

import math

from numba import njit

from rbpf.kernels.signature import observation_kernel


@njit(cache=True, error_model="numpy")
def _store_planar(row, d0, d1, x, y, c, s, jac_state, jac_landmark, i):
    """One row D = (d0, d1) in the robot's frame at the point (x, y): ∂/∂ξ and, with the heading, ∂/∂landmark."""
    jac_state[row, 0, i] = d0 * y - d1 * x
    jac_state[row, 1, i] = -d0
    jac_state[row, 2, i] = -d1
    jac_landmark[row, 0, i] = d0 * c - d1 * s
    jac_landmark[row, 1, i] = d0 * s + d1 * c


@observation_kernel
def range_bearing_planar(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """(range, yaw) in the plane; params: rotation by rows (4), translation (2) of the mounting."""
    m00, m01, m10, m11, tx, ty = params[0], params[1], params[2], params[3], params[4], params[5]
    cos_z, sin_z = math.cos(z[1]), math.sin(z[1])
    for i in range(n):
        c, s = math.cos(state[0, i]), math.sin(state[0, i])
        dx, dy = mean[0, i] - state[1, i], mean[1, i] - state[2, i]
        x, y = c * dx + s * dy, c * dy - s * dx
        u, v = m00 * (x - tx) + m10 * (y - ty), m01 * (x - tx) + m11 * (y - ty)
        flat2 = u * u + v * v
        distance = math.sqrt(flat2)
        nu[0, i] = z[0] - distance
        nu[1, i] = math.atan2(sin_z * u - cos_z * v, cos_z * u + sin_z * v)
        a0, a1 = u / distance, v / distance
        b0, b1 = -v / flat2, u / flat2
        _store_planar(0, m00 * a0 + m01 * a1, m10 * a0 + m11 * a1, x, y, c, s, jac_state, jac_landmark, i)
        _store_planar(1, m00 * b0 + m01 * b1, m10 * b0 + m11 * b1, x, y, c, s, jac_state, jac_landmark, i)


@observation_kernel
def position_planar(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """The point in the sensor's frame, in the plane."""
    m00, m01, m10, m11, tx, ty = params[0], params[1], params[2], params[3], params[4], params[5]
    for i in range(n):
        c, s = math.cos(state[0, i]), math.sin(state[0, i])
        dx, dy = mean[0, i] - state[1, i], mean[1, i] - state[2, i]
        x, y = c * dx + s * dy, c * dy - s * dx
        nu[0, i] = z[0] - (m00 * (x - tx) + m10 * (y - ty))
        nu[1, i] = z[1] - (m01 * (x - tx) + m11 * (y - ty))
        _store_planar(0, m00, m10, x, y, c, s, jac_state, jac_landmark, i)
        _store_planar(1, m01, m11, x, y, c, s, jac_state, jac_landmark, i)


@njit(cache=True, error_model="numpy")
def _rotation(qx, qy, qz, qw):
    """Rotation matrix by rows of a unit quaternion."""
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
def _store_spatial(row, a0, a1, a2, params, p, rotation, jac_state, jac_landmark, i):
    """One row (a0, a1, a2) in the sensor's frame: taken to the robot's frame, then ∂/∂ξ and ∂/∂landmark."""
    d0 = params[0] * a0 + params[1] * a1 + params[2] * a2
    d1 = params[3] * a0 + params[4] * a1 + params[5] * a2
    d2 = params[6] * a0 + params[7] * a1 + params[8] * a2
    jac_state[row, 0, i] = d1 * p[2] - d2 * p[1]
    jac_state[row, 1, i] = d2 * p[0] - d0 * p[2]
    jac_state[row, 2, i] = d0 * p[1] - d1 * p[0]
    jac_state[row, 3, i] = -d0
    jac_state[row, 4, i] = -d1
    jac_state[row, 5, i] = -d2
    jac_landmark[row, 0, i] = d0 * rotation[0] + d1 * rotation[1] + d2 * rotation[2]
    jac_landmark[row, 1, i] = d0 * rotation[3] + d1 * rotation[4] + d2 * rotation[5]
    jac_landmark[row, 2, i] = d0 * rotation[6] + d1 * rotation[7] + d2 * rotation[8]


@njit(cache=True, error_model="numpy")
def _points_spatial(state, mean, params, i):
    """Rotation of the robot, and the landmark in the robot's and in the sensor's frame."""
    r = _rotation(state[0, i], state[1, i], state[2, i], state[3, i])
    a, b, c = mean[0, i] - state[4, i], mean[1, i] - state[5, i], mean[2, i] - state[6, i]
    p = (r[0] * a + r[3] * b + r[6] * c, r[1] * a + r[4] * b + r[7] * c, r[2] * a + r[5] * b + r[8] * c)
    a, b, c = p[0] - params[9], p[1] - params[10], p[2] - params[11]
    s = (
        params[0] * a + params[3] * b + params[6] * c,
        params[1] * a + params[4] * b + params[7] * c,
        params[2] * a + params[5] * b + params[8] * c,
    )
    return r, p, s


@observation_kernel
def range_bearing_spatial(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """(range, yaw, pitch) in space; params: rotation by rows (9), translation (3), sign of pitch."""
    sign = params[12]
    cos_yaw, sin_yaw = math.cos(z[1]), math.sin(z[1])
    cos_pitch, sin_pitch = math.cos(z[2]), math.sin(z[2])
    for i in range(n):
        rotation, p, s = _points_spatial(state, mean, params, i)
        x, y, h = s
        flat2 = x * x + y * y
        flat = math.sqrt(flat2)
        distance2 = flat2 + h * h
        distance = math.sqrt(distance2)
        nu[0, i] = z[0] - distance
        nu[1, i] = math.atan2(sin_yaw * x - cos_yaw * y, cos_yaw * x + sin_yaw * y)
        nu[2, i] = math.atan2(
            sin_pitch * flat - cos_pitch * sign * h, cos_pitch * flat + sin_pitch * sign * h
        )
        tilt = sign * h / (flat * distance2)
        _store_spatial(
            0, x / distance, y / distance, h / distance, params, p, rotation, jac_state, jac_landmark, i
        )
        _store_spatial(1, -y / flat2, x / flat2, 0.0, params, p, rotation, jac_state, jac_landmark, i)
        _store_spatial(
            2, -x * tilt, -y * tilt, sign * flat / distance2, params, p, rotation, jac_state, jac_landmark, i
        )


@observation_kernel
def position_spatial(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """The point in the sensor's frame, in space."""
    for i in range(n):
        rotation, p, s = _points_spatial(state, mean, params, i)
        nu[0, i] = z[0] - s[0]
        nu[1, i] = z[1] - s[1]
        nu[2, i] = z[2] - s[2]
        _store_spatial(0, 1.0, 0.0, 0.0, params, p, rotation, jac_state, jac_landmark, i)
        _store_spatial(1, 0.0, 1.0, 0.0, params, p, rotation, jac_state, jac_landmark, i)
        _store_spatial(2, 0.0, 0.0, 1.0, params, p, rotation, jac_state, jac_landmark, i)
