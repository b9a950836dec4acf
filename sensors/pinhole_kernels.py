"""Compiled twin of `rbpf.sensors.pinhole.Pinhole`: one point, plain numbers. See there for the equations."""

import math

import numpy as np
from numba import njit

from rbpf.sensors.equidistant import NEAR

KIND = 9
"""Place of the lens in `Pinhole.params`, the last one: 0 radial-tangential, 1 equidistant."""

Projected = tuple[float, float, float, float, float, float, float, float]
"""Pixel of a point and its slope by rows: (px, py, d00, d01, d02, d10, d11, d12)."""


@njit(cache=True, error_model="numpy", inline="always")
def project(x: float, y: float, z: float, params: np.ndarray) -> Projected:
    """Pixel of a point and its slope.

    Args:
        x: to the right, in the camera's frame.
        y: down.
        z: forward; 0 divides as the caller's error model says.
        params: (10,) `Pinhole.params`.
    """
    if params[KIND] == 0.0:
        return project_radial(x, y, z, params)
    return project_equidistant(x, y, z, params)


@njit(cache=True, error_model="numpy", inline="always")
def project_radial(x: float, y: float, z: float, params: np.ndarray) -> Projected:
    """As `project`, with radial-tangential distortion: without a branch, for loops that become vector instructions."""
    fx, fy = params[0], params[1]
    k1, k2, p1, p2, k3 = params[4], params[5], params[6], params[7], params[8]
    per_z = 1.0 / z
    u, v = x * per_z, y * per_z
    s = u * u + v * v
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    bend = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
    px = fx * (u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)) + params[2]
    py = fy * (v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v)) + params[3]
    uu = radial + bend * u * u + 2.0 * p1 * v + 6.0 * p2 * u
    uv = bend * u * v + 2.0 * p1 * u + 2.0 * p2 * v
    vv = radial + bend * v * v + 6.0 * p1 * v + 2.0 * p2 * u
    fx, fy = fx * per_z, fy * per_z
    d00, d01, d10, d11 = fx * uu, fx * uv, fy * uv, fy * vv
    return px, py, d00, d01, -(d00 * u + d01 * v), d10, d11, -(d10 * u + d11 * v)


@njit(cache=True, error_model="numpy")
def project_equidistant(x: float, y: float, z: float, params: np.ndarray) -> Projected:
    """As `project`, through an equidistant lens: Mathematics (equidistant)."""
    k1, k2, k3, k4 = params[4], params[5], params[6], params[7]
    per_z = 1.0 / z
    u, v = x * per_z, y * per_z
    s = u * u + v * v
    scale, bend = 1.0, 0.0
    if not s < NEAR:
        r = math.sqrt(s)
        angle = math.atan(r)
        t = angle * angle
        scale = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) / r
        along = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
        bend = (along / (1.0 + s) - scale) / s
    uv = bend * u * v
    fx, fy = params[0] * per_z, params[1] * per_z
    d00, d01, d10, d11 = fx * (scale + bend * u * u), fx * uv, fy * uv, fy * (scale + bend * v * v)
    px, py = params[0] * scale * u + params[2], params[1] * scale * v + params[3]
    return px, py, d00, d01, -(d00 * u + d01 * v), d10, d11, -(d10 * u + d11 * v)
