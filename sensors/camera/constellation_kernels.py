"""Compiled twins of `rbpf.sensors.camera.constellation`."""

import math

from numba import njit

from rbpf.kernels.block import flat
from rbpf.kernels.se3 import rotation
from rbpf.kernels.signature import BLOCK, observation_kernel
from rbpf.sensors.camera.kernels import (
    KIND,
    clamp_depth,
    locate,
    measure,
    project_equidistant,
    project_radial,
    store_by_state,
    turn,
)

HEADER = KIND + 1
"""Parameters before the points: the camera's."""
_SMALL = 1e-2
"""θ² below which the series of the coefficients are exact to rounding with the terms kept."""


@njit(cache=True, error_model="numpy", inline="always")
def _coefficients(square):
    """Of Exp: a = sin θ/θ, b = (1 − cos θ)/θ², c = (θ − sin θ)/θ³, and each one's derivative by θ²/2."""
    s = square
    if s < _SMALL:
        a = 1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0)))
        b = 0.5 - s / 24.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0)))
        c = 1.0 / 6.0 - s / 120.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0 * (1.0 - s / 110.0)))
        da = -1.0 / 3.0 + s / 30.0 * (1.0 - s / 28.0 * (1.0 - s / 54.0 * (1.0 - s / 88.0)))
        db = -1.0 / 12.0 + s / 180.0 * (1.0 - 3.0 * s / 112.0 * (1.0 - 2.0 * s / 135.0))
        dc = -1.0 / 60.0 + s / 1260.0 * (1.0 - s / 48.0 * (1.0 - 4.0 * s / 330.0))
        return a, b, c, da, db, dc
    angle = math.sqrt(s)
    sine, cosine = math.sin(angle), math.cos(angle)
    a, b, c = sine / angle, (1.0 - cosine) / s, (angle - sine) / (s * angle)
    return a, b, c, (cosine - a) / s, (a - 2.0 * b) / s, (b - 3.0 * c) / s


@njit(cache=True, error_model="numpy", inline="always")
def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(cache=True, error_model="numpy", inline="always")
def _turned(k1, k2, w, x):
    """The sum x + k1 ω × x + k2 ω × (ω × x)."""
    once = _cross(w, x)
    twice = _cross(w, once)
    return (
        x[0] + k1 * once[0] + k2 * twice[0],
        x[1] + k1 * once[1] + k2 * twice[1],
        x[2] + k1 * once[2] + k2 * twice[2],
    )


@njit(cache=True, error_model="numpy", inline="always")
def _by_turn(g, k1, k2, d1, d2, w, x):
    """gᵀ ∂/∂ω of `_turned`, where k1 and k2 change by d1 ω and d2 ω."""
    once = _cross(w, x)
    twice = _cross(w, once)
    along = d1 * (g[0] * once[0] + g[1] * once[1] + g[2] * once[2])
    along += d2 * (g[0] * twice[0] + g[1] * twice[1] + g[2] * twice[2])
    first = _cross(x, g)
    second = _cross(once, g)
    third = _cross(x, _cross(g, w))
    return (
        k1 * first[0] + k2 * (second[0] + third[0]) + along * w[0],
        k1 * first[1] + k2 * (second[1] + third[1]) + along * w[1],
        k1 * first[2] + k2 * (second[2] + third[2]) + along * w[2],
    )


@njit(cache=True, error_model="numpy", inline="always")
def _view(project, state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """`constellation_view` through one kind of lens."""
    count = z.shape[0] // 2
    for i in range(n):
        r = rotation(state[0, i], state[1, i], state[2, i], state[3, i])
        s = rotation(const[0, i], const[1, i], const[2, i], const[3, i])
        w = (mean[0, i], mean[1, i], mean[2, i])
        shift = (mean[3, i], mean[4, i], mean[5, i])
        a, b, c, da, db, dc = _coefficients(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
        moved = _turned(b, c, w, shift)
        for k in range(count):
            first = HEADER + 3 * k
            x = (params[first], params[first + 1], params[first + 2])
            t = _turned(a, b, w, x)
            p0, p1, p2 = t[0] + moved[0], t[1] + moved[1], t[2] + moved[2]
            u0 = s[0] * p0 + s[1] * p1 + s[2] * p2 + const[4, i] - state[4, i]
            u1 = s[3] * p0 + s[4] * p1 + s[5] * p2 + const[5, i] - state[5, i]
            u2 = s[6] * p0 + s[7] * p1 + s[8] * p2 + const[6, i] - state[6, i]
            c0 = r[0] * u0 + r[3] * u1 + r[6] * u2
            c1 = r[1] * u0 + r[4] * u1 + r[7] * u2
            depth = clamp_depth(c0, c1, r[2] * u0 + r[5] * u1 + r[8] * u2)
            px, py, d00, d01, d02, d10, d11, d12 = project(c0, c1, depth, params)
            nu[2 * k, i] = z[2 * k] - px
            nu[2 * k + 1, i] = z[2 * k + 1] - py
            for row in range(2):
                d = (d00, d01, d02) if row == 0 else (d10, d11, d12)
                out = 2 * k + row
                store_by_state(d[0], d[1], d[2], c0, c1, depth, flat(jac_state[out]), i)
                e0 = d[0] * r[0] + d[1] * r[1] + d[2] * r[2]
                e1 = d[0] * r[3] + d[1] * r[4] + d[2] * r[5]
                e2 = d[0] * r[6] + d[1] * r[7] + d[2] * r[8]
                g = (
                    e0 * s[0] + e1 * s[3] + e2 * s[6],
                    e0 * s[1] + e1 * s[4] + e2 * s[7],
                    e0 * s[2] + e1 * s[5] + e2 * s[8],
                )
                turned = _by_turn(g, a, b, da, db, w, x)
                carried = _by_turn(g, b, c, db, dc, w, shift)
                back = (-w[0], -w[1], -w[2])
                by_shift = _turned(b, c, back, g)
                for f in range(3):
                    jac_landmark[out, f, i] = turned[f] + carried[f]
                    jac_landmark[out, 3 + f, i] = by_shift[f]


@observation_kernel
def constellation_view(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Pixels of several exact points of one group; params: the camera's, then the points in the group's frame."""
    if params[KIND] == 0.0:
        _view(project_radial, state, mean, const, z, params, n, nu, jac_state, jac_landmark)
    else:
        _view(project_equidistant, state, mean, const, z, params, n, nu, jac_state, jac_landmark)


@observation_kernel
def members_view(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Pixels of several points of one record (p_1, p_2, …); params: the camera's, then which points they are."""
    pose, points = flat(state), flat(mean)
    jac_landmark[:, :, :n] = 0.0
    for k in range(z.shape[0] // 2):
        own, out = 3 * int(params[HEADER + k]), 2 * k
        across, down = flat(jac_state[out]), flat(jac_state[out + 1])
        by_point = flat(jac_landmark[out])[own * BLOCK :]
        locate(pose, points[own * BLOCK :], n, by_point)
        measure(by_point, z[out], z[out + 1], params, n, flat(nu)[out * BLOCK :], across, down)
        turn(pose, across, n, by_point)
        turn(pose, down, n, flat(jac_landmark[out + 1])[own * BLOCK :])
