"""Compiled twin of `rbpf.sensors.pinhole.Pinhole`: one point, plain numbers. See there for the equations."""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy", inline="always")
def project(
    x: float, y: float, z: float, params: np.ndarray
) -> tuple[float, float, float, float, float, float, float, float]:
    """Pixel of a point and its slope by rows: (px, py, d00, d01, d02, d10, d11, d12).

    Args:
        x: to the right, in the camera's frame.
        y: down.
        z: forward; 0 divides as the caller's error model says.
        params: (9,) `Pinhole.params`.
    """
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
