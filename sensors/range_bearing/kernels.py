"""Fused kernels of range-bearing and position sensors; see `rbpf.sensors.range_bearing` for the equations."""

import math

from numba import njit

from rbpf.kernels.angles import arctan2, cos_sin
from rbpf.kernels.block import flat, rotation_at, store_by_state
from rbpf.kernels.se3 import back, times
from rbpf.kernels.signature import BLOCK, observation_kernel


@njit(cache=True, error_model="numpy", forceinline=True)
def _face_planar(state, mean, n, point, heading):
    """Writes the landmark in the robot's frame, and cosine and sine of the heading, to the first two rows of each."""
    for i in range(n):
        c, s = cos_sin(state[i])
        dx, dy = mean[i] - state[BLOCK + i], mean[BLOCK + i] - state[2 * BLOCK + i]
        point[i], point[BLOCK + i] = c * dx + s * dy, c * dy - s * dx
        heading[i], heading[BLOCK + i] = c, s


@njit(cache=True, error_model="numpy", forceinline=True)
def _in_sensor(params, x, y):
    """Transforms a planar point from the robot's to the sensor's frame."""
    a, b = x - params[4], y - params[5]
    return params[0] * a + params[2] * b, params[1] * a + params[3] * b


@njit(cache=True, error_model="numpy", forceinline=True)
def _store_planar(row, a0, a1, params, c, s, x, y, jac_state, jac_landmark, i):
    """One row (a0, a1) in the sensor's frame: rotated to the robot's frame, then chained to ∂/∂ξ and ∂/∂landmark."""
    d0, d1 = params[0] * a0 + params[1] * a1, params[2] * a0 + params[3] * a1
    jac_state[3 * row * BLOCK + i] = d0 * y - d1 * x
    jac_state[(3 * row + 1) * BLOCK + i] = -d0
    jac_state[(3 * row + 2) * BLOCK + i] = -d1
    jac_landmark[2 * row * BLOCK + i] = d0 * c - d1 * s
    jac_landmark[(2 * row + 1) * BLOCK + i] = d0 * s + d1 * c


@observation_kernel
def range_bearing_planar(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """(range, yaw) in the plane; params: rotation by rows (4), translation (2) of the mounting."""
    out, by_state, by_landmark = flat(nu), flat(jac_state), flat(jac_landmark)
    cos_z, sin_z, range_z = math.cos(z[1]), math.sin(z[1]), z[0]
    _face_planar(flat(state), flat(mean), n, out, by_landmark)
    for i in range(n):
        x, y, c, s = out[i], out[BLOCK + i], by_landmark[i], by_landmark[BLOCK + i]
        u, v = _in_sensor(params, x, y)
        inverse = 1.0 / math.sqrt(u * u + v * v)
        a0, a1 = u * inverse, v * inverse
        _store_planar(0, a0, a1, params, c, s, x, y, by_state, by_landmark, i)
        _store_planar(1, -a1 * inverse, a0 * inverse, params, c, s, x, y, by_state, by_landmark, i)
    for i in range(n):
        u, v = _in_sensor(params, out[i], out[BLOCK + i])
        out[i] = range_z - math.sqrt(u * u + v * v)
        out[BLOCK + i] = arctan2(sin_z * u - cos_z * v, cos_z * u + sin_z * v)


@observation_kernel
def position_planar(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """The point in the sensor's frame, in the plane."""
    out, by_state, by_landmark = flat(nu), flat(jac_state), flat(jac_landmark)
    z0, z1 = z[0], z[1]
    _face_planar(flat(state), flat(mean), n, out, by_landmark)
    for i in range(n):
        x, y, c, s = out[i], out[BLOCK + i], by_landmark[i], by_landmark[BLOCK + i]
        _store_planar(0, 1.0, 0.0, params, c, s, x, y, by_state, by_landmark, i)
        _store_planar(1, 0.0, 1.0, params, c, s, x, y, by_state, by_landmark, i)
    for i in range(n):
        u, v = _in_sensor(params, out[i], out[BLOCK + i])
        out[i], out[BLOCK + i] = z0 - u, z1 - v


@njit(cache=True, error_model="numpy", forceinline=True)
def _store_spatial(row, a0, a1, a2, params, p, rotation, jac_state, jac_landmark, i):
    """One row (a0, a1, a2) in the sensor's frame: rotated to the robot's frame, then chained to ∂/∂ξ and ∂/∂landmark."""
    d0, d1, d2 = times(params, a0, a1, a2)
    store_by_state(d0, d1, d2, p[0], p[1], p[2], jac_state, 6 * row * BLOCK + i)
    start = 3 * row * BLOCK + i
    jac_landmark[start], jac_landmark[start + BLOCK], jac_landmark[start + 2 * BLOCK] = times(rotation, d0, d1, d2)


@njit(cache=True, error_model="numpy", forceinline=True)
def _locate(state, mean, params, n, point):
    """Writes the landmark in the sensor's frame to the rows of `point`."""
    for i in range(n):
        r = rotation_at(state, i)
        a, b = mean[i] - state[4 * BLOCK + i], mean[BLOCK + i] - state[5 * BLOCK + i]
        c = mean[2 * BLOCK + i] - state[6 * BLOCK + i]
        x, y, z = back(r, a, b, c)
        x, y, z = back(params, x - params[9], y - params[10], z - params[11])
        point[i], point[BLOCK + i], point[2 * BLOCK + i] = x, y, z


@njit(cache=True, error_model="numpy", forceinline=True)
def _in_robot(params, a, b, c):
    """Transforms a point from the sensor's to the robot's frame."""
    x, y, z = times(params, a, b, c)
    return x + params[9], y + params[10], z + params[11]


@observation_kernel
def range_bearing_spatial(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """(range, yaw, pitch) in space; params: rotation by rows (9), translation (3), sign of pitch."""
    pose, out, by_state, by_landmark = flat(state), flat(nu), flat(jac_state), flat(jac_landmark)
    sign, range_z = params[12], z[0]
    cos_yaw, sin_yaw = math.cos(z[1]), math.sin(z[1])
    cos_pitch, sin_pitch = math.cos(z[2]), math.sin(z[2])
    _locate(pose, flat(mean), params, n, out)
    for i in range(n):
        x, y, h = out[i], out[BLOCK + i], out[2 * BLOCK + i]
        rotation, p = rotation_at(pose, i), _in_robot(params, x, y, h)
        flat2 = x * x + y * y
        distance2 = flat2 + h * h
        per_flat, per_distance = 1.0 / math.sqrt(flat2), 1.0 / math.sqrt(distance2)
        per_flat2, per_distance2 = per_flat * per_flat, per_distance * per_distance
        tilt = sign * h * per_flat * per_distance2
        rise = sign * flat2 * per_flat * per_distance2
        a, b, c = x * per_distance, y * per_distance, h * per_distance
        _store_spatial(0, a, b, c, params, p, rotation, by_state, by_landmark, i)
        _store_spatial(1, -y * per_flat2, x * per_flat2, 0.0, params, p, rotation, by_state, by_landmark, i)
        _store_spatial(2, -x * tilt, -y * tilt, rise, params, p, rotation, by_state, by_landmark, i)
    for i in range(n):
        x, y, h = out[i], out[BLOCK + i], sign * out[2 * BLOCK + i]
        flat2 = x * x + y * y
        across = math.sqrt(flat2)
        out[i] = range_z - math.sqrt(flat2 + h * h)
        out[BLOCK + i] = arctan2(sin_yaw * x - cos_yaw * y, cos_yaw * x + sin_yaw * y)
        out[2 * BLOCK + i] = arctan2(sin_pitch * across - cos_pitch * h, cos_pitch * across + sin_pitch * h)


@observation_kernel
def position_spatial(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """The point in the sensor's frame, in space."""
    pose, out, by_state, by_landmark = flat(state), flat(nu), flat(jac_state), flat(jac_landmark)
    z0, z1, z2 = z[0], z[1], z[2]
    _locate(pose, flat(mean), params, n, out)
    for i in range(n):
        p = _in_robot(params, out[i], out[BLOCK + i], out[2 * BLOCK + i])
        rotation = rotation_at(pose, i)
        _store_spatial(0, 1.0, 0.0, 0.0, params, p, rotation, by_state, by_landmark, i)
        _store_spatial(1, 0.0, 1.0, 0.0, params, p, rotation, by_state, by_landmark, i)
        _store_spatial(2, 0.0, 0.0, 1.0, params, p, rotation, by_state, by_landmark, i)
    for i in range(n):
        out[i] = z0 - out[i]
        out[BLOCK + i] = z1 - out[BLOCK + i]
        out[2 * BLOCK + i] = z2 - out[2 * BLOCK + i]
