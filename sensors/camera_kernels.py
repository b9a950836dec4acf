"""Compiled twins of the camera's models: one landmark and one measurement at a time, see `camera_points`."""

import math

from numba import njit

from rbpf.kernels.quaternion import rotation
from rbpf.kernels.signature import observation_kernel
from rbpf.sensors.pinhole_kernels import project

GRAZING = 0.2
"""The same as `rbpf.sensors.camera_points.GRAZING`; the tests compare them."""


@njit(cache=True, error_model="numpy", inline="always")
def forward_depth(x, y, z):
    """The depth kept positive."""
    return max(z, GRAZING * math.sqrt(x * x + y * y + z * z))


@njit(cache=True, error_model="numpy", inline="always")
def store_by_state(row, a0, a1, a2, x, y, z, w, jac_state, i):
    """One row (a0, a1, a2) of the slope: a × c by rotation, −w a by translation."""
    jac_state[row, 0, i] = a1 * z - a2 * y
    jac_state[row, 1, i] = a2 * x - a0 * z
    jac_state[row, 2, i] = a0 * y - a1 * x
    jac_state[row, 3, i] = -w * a0
    jac_state[row, 4, i] = -w * a1
    jac_state[row, 5, i] = -w * a2


@observation_kernel
def camera_point(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """A world point; params are the camera's."""
    for i in range(n):
        r = rotation(state[0, i], state[1, i], state[2, i], state[3, i])
        a, b, c = mean[0, i] - state[4, i], mean[1, i] - state[5, i], mean[2, i] - state[6, i]
        x = r[0] * a + r[3] * b + r[6] * c
        y = r[1] * a + r[4] * b + r[7] * c
        depth = forward_depth(x, y, r[2] * a + r[5] * b + r[8] * c)
        px, py, d00, d01, d02, d10, d11, d12 = project(x, y, depth, params)
        nu[0, i] = z[0] - px
        nu[1, i] = z[1] - py
        store_by_state(0, d00, d01, d02, x, y, depth, 1.0, jac_state, i)
        store_by_state(1, d10, d11, d12, x, y, depth, 1.0, jac_state, i)
        for k in range(3):
            jac_landmark[0, k, i] = d00 * r[3 * k] + d01 * r[3 * k + 1] + d02 * r[3 * k + 2]
            jac_landmark[1, k, i] = d10 * r[3 * k] + d11 * r[3 * k + 1] + d12 * r[3 * k + 2]


@observation_kernel
def stereo_point(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """A world point in a rectified pair, z = (u_left, v, u_right); params are fx, fy, cx, cy and the baseline."""
    fx, fy, cx, cy, baseline = params[0], params[1], params[2], params[3], params[4]
    for i in range(n):
        r = rotation(state[0, i], state[1, i], state[2, i], state[3, i])
        a, b, c = mean[0, i] - state[4, i], mean[1, i] - state[5, i], mean[2, i] - state[6, i]
        x = r[0] * a + r[3] * b + r[6] * c
        y = r[1] * a + r[4] * b + r[7] * c
        depth = forward_depth(x, y, r[2] * a + r[5] * b + r[8] * c)
        gx, gy = fx / depth, fy / depth
        left, down, right = gx * x, gy * y, gx * (x - baseline)
        nu[0, i] = z[0] - left - cx
        nu[1, i] = z[1] - down - cy
        nu[2, i] = z[2] - right - cx
        e, f, g = -left / depth, -down / depth, -right / depth
        store_by_state(0, gx, 0.0, e, x, y, depth, 1.0, jac_state, i)
        store_by_state(1, 0.0, gy, f, x, y, depth, 1.0, jac_state, i)
        store_by_state(2, gx, 0.0, g, x, y, depth, 1.0, jac_state, i)
        for k in range(3):
            jac_landmark[0, k, i] = gx * r[3 * k] + e * r[3 * k + 2]
            jac_landmark[1, k, i] = gy * r[3 * k + 1] + f * r[3 * k + 2]
            jac_landmark[2, k, i] = gx * r[3 * k] + g * r[3 * k + 2]


@njit(cache=True, error_model="numpy", inline="always")
def _ray(state, mean, const, z, params, nu, jac_state, jac_landmark, i):
    """Residual and derivatives of the full 2-D measurement of lane i."""
    r = rotation(state[0, i], state[1, i], state[2, i], state[3, i])
    s = rotation(const[0, i], const[1, i], const[2, i], const[3, i])
    u, v, rho = mean[0, i], mean[1, i], mean[2, i]
    ta, tb, tc = const[4, i] - state[4, i], const[5, i] - state[5, i], const[6, i] - state[6, i]
    a = s[0] * u + s[1] * v + s[2] + rho * ta
    b = s[3] * u + s[4] * v + s[5] + rho * tb
    c = s[6] * u + s[7] * v + s[8] + rho * tc
    x = r[0] * a + r[3] * b + r[6] * c
    y = r[1] * a + r[4] * b + r[7] * c
    depth = forward_depth(x, y, r[2] * a + r[5] * b + r[8] * c)
    px, py, d00, d01, d02, d10, d11, d12 = project(x, y, depth, params)
    nu[0, i] = z[0] - px
    nu[1, i] = z[1] - py
    store_by_state(0, d00, d01, d02, x, y, depth, rho, jac_state, i)
    store_by_state(1, d10, d11, d12, x, y, depth, rho, jac_state, i)
    e0 = d00 * r[0] + d01 * r[1] + d02 * r[2]
    e1 = d00 * r[3] + d01 * r[4] + d02 * r[5]
    e2 = d00 * r[6] + d01 * r[7] + d02 * r[8]
    f0 = d10 * r[0] + d11 * r[1] + d12 * r[2]
    f1 = d10 * r[3] + d11 * r[4] + d12 * r[5]
    f2 = d10 * r[6] + d11 * r[7] + d12 * r[8]
    jac_landmark[0, 0, i] = e0 * s[0] + e1 * s[3] + e2 * s[6]
    jac_landmark[0, 1, i] = e0 * s[1] + e1 * s[4] + e2 * s[7]
    jac_landmark[0, 2, i] = e0 * ta + e1 * tb + e2 * tc
    jac_landmark[1, 0, i] = f0 * s[0] + f1 * s[3] + f2 * s[6]
    jac_landmark[1, 1, i] = f0 * s[1] + f1 * s[4] + f2 * s[7]
    jac_landmark[1, 2, i] = f0 * ta + f1 * tb + f2 * tc


@observation_kernel
def camera_ray(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Inverse depth, both dimensions; params are the camera's."""
    for i in range(n):
        _ray(state, mean, const, z, params, nu, jac_state, jac_landmark, i)


@observation_kernel
def epipolar_ray(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Inverse depth, across the epipolar line only; params: the camera's, then the least |∂h/∂q| in px per 1/m."""
    least = params[9] * params[9]
    for i in range(n):
        _ray(state, mean, const, z, params, nu, jac_state, jac_landmark, i)
        a, b = jac_landmark[0, 2, i], jac_landmark[1, 2, i]
        squared = a * a + b * b
        share = 1.0 / squared if squared >= least else 0.0
        along = share * (a * nu[0, i] + b * nu[1, i])
        nu[0, i] -= a * along
        nu[1, i] -= b * along
        for k in range(6):
            along = share * (a * jac_state[0, k, i] + b * jac_state[1, k, i])
            jac_state[0, k, i] -= a * along
            jac_state[1, k, i] -= b * along
        for k in range(3):
            along = share * (a * jac_landmark[0, k, i] + b * jac_landmark[1, k, i])
            jac_landmark[0, k, i] -= a * along
            jac_landmark[1, k, i] -= b * along
