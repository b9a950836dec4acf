"""Compiled twins of the pinhole camera and of its observation models, see `rbpf.sensors.camera` and `.points`.

Each loop over the lanes writes few arrays, so that it compiles to vector instructions; the rows of the Jacobian by the
landmark hold the landmark's position until that Jacobian is computed.
"""

import math

import numpy as np
from numba import boolean, int64, njit, types

from rbpf.kernels.block import flat, rotation_at, store_by_state
from rbpf.kernels.se3 import back, rotation, times
from rbpf.kernels.signature import BLOCK, INDICES, MATRIX, VECTOR, observation_kernel
from rbpf.sensors.camera.distortion import MIN_DEPTH_FRACTION, NEAR

KIND = 9  #: Index of the kind of lens in `Pinhole.params`, the last one: 0 radial-tangential, 1 equidistant.
#: Pixel of a point and its Jacobian by rows: (px, py, d00, d01, d02, d10, d11, d12).
Projected = tuple[float, float, float, float, float, float, float, float]


@njit(cache=True, error_model="numpy", forceinline=True)
def project(x: float, y: float, z: float, params: np.ndarray) -> Projected:
    """Pixel of a point (right, down, forward) and its Jacobian, by `Pinhole.params`; z = 0 gives infinity or NaN."""
    if params[KIND] == 0.0:
        return project_radial(x, y, z, params)
    return project_equidistant(x, y, z, params)


@njit(cache=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, error_model="numpy", forceinline=True)
def clamp_depth(x, y, z):
    """The depth, raised to a positive minimum."""
    return max(z, MIN_DEPTH_FRACTION * math.sqrt(x * x + y * y + z * z))


@njit(cache=True, error_model="numpy", forceinline=True)
def locate(pose, point, n, place):
    """Writes points in the camera's frame, with positive depth, to the first three rows of `place`."""
    for i in range(n):
        r = rotation_at(pose, i)
        a, b = point[i] - pose[4 * BLOCK + i], point[BLOCK + i] - pose[5 * BLOCK + i]
        x, y, z = back(r, a, b, point[2 * BLOCK + i] - pose[6 * BLOCK + i])
        place[i], place[BLOCK + i], place[2 * BLOCK + i] = x, y, clamp_depth(x, y, z)


@njit(cache=True, error_model="numpy", forceinline=True)
def measure(place, z0, z1, params, n, nu, across, down):
    """Residuals and both Jacobian rows by the state, of points `place` in the camera's frame."""
    if params[KIND] != 0.0:
        # A separate loop: its arc tangents would prevent vector instructions in the other one.
        for i in range(n):
            x, y, depth = place[i], place[BLOCK + i], place[2 * BLOCK + i]
            px, py, d00, d01, d02, d10, d11, d12 = project_equidistant(x, y, depth, params)
            nu[i], nu[BLOCK + i] = z0 - px, z1 - py
            store_by_state(d00, d01, d02, x, y, depth, across, i)
            store_by_state(d10, d11, d12, x, y, depth, down, i)
        return
    camera = (
        params[0], params[1], params[2], params[3], params[4], params[5], params[6], params[7], params[8]
    )  # fmt: skip
    for i in range(n):
        x, y, depth = place[i], place[BLOCK + i], place[2 * BLOCK + i]
        px, py, d00, d01, d02, d10, d11, d12 = project_radial(x, y, depth, camera)
        nu[i], nu[BLOCK + i] = z0 - px, z1 - py
        store_by_state(d00, d01, d02, x, y, depth, across, i)
        store_by_state(d10, d11, d12, x, y, depth, down, i)


@njit(cache=True, error_model="numpy", forceinline=True)
def turn(pose, row, n, by_point):
    """One Jacobian row by the point, a Rᵀ, from the −a in the row by the state."""
    for i in range(n):
        r = rotation_at(pose, i)
        a0, a1, a2 = -row[3 * BLOCK + i], -row[4 * BLOCK + i], -row[5 * BLOCK + i]
        by_point[i], by_point[BLOCK + i], by_point[2 * BLOCK + i] = times(r, a0, a1, a2)


@observation_kernel
def camera_point(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """A world point; params are the camera's."""
    pose, by_point = flat(state), flat(jac_landmark)
    across, down = flat(jac_state[0]), flat(jac_state[1])
    locate(pose, flat(mean), n, by_point)
    measure(by_point, z[0], z[1], params, n, flat(nu), across, down)
    for a in range(2):
        turn(pose, flat(jac_state[a]), n, by_point[3 * a * BLOCK :])


@njit(cache=True, error_model="numpy", forceinline=True)
def _store_pixel(place, fx, fy, baseline, n, row):
    """A Jacobian row by the state, of fx (x − baseline) / z + fy y / z."""
    for i in range(n):
        x, y, depth = place[i], place[BLOCK + i], place[2 * BLOCK + i]
        gx, gy = fx / depth, fy / depth
        store_by_state(gx, gy, -(gx * (x - baseline) + gy * y) / depth, x, y, depth, row, i)


@observation_kernel
def stereo_point(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """A world point in a rectified pair, z = (u_left, v, u_right); params are fx, fy, cx, cy and the baseline."""
    pose, by_point = flat(state), flat(jac_landmark)
    left, down, right = flat(jac_state[0]), flat(jac_state[1]), flat(jac_state[2])
    locate(pose, flat(mean), n, by_point)
    fx, fy, cx, cy, baseline = params[0], params[1], params[2], params[3], params[4]
    out, z0, z1, z2 = flat(nu), z[0], z[1], z[2]
    for i in range(n):
        x, y, depth = by_point[i], by_point[BLOCK + i], by_point[2 * BLOCK + i]
        gx, gy = fx / depth, fy / depth
        out[i] = z0 - gx * x - cx
        out[BLOCK + i] = z1 - gy * y - cy
        out[2 * BLOCK + i] = z2 - gx * (x - baseline) - cx
    _store_pixel(by_point, fx, 0.0, 0.0, n, left)
    _store_pixel(by_point, 0.0, fy, 0.0, n, down)
    _store_pixel(by_point, fx, 0.0, baseline, n, right)
    for a in range(3):
        turn(pose, flat(jac_state[a]), n, by_point[3 * a * BLOCK :])


@njit(cache=True, error_model="numpy", forceinline=True)
def _turn_ray(pose, anchor, row, n, by_ray):
    """One Jacobian row by (u, v, ρ) from the −a in the row by the state."""
    for i in range(n):
        r, s = rotation_at(pose, i), rotation_at(anchor, i)
        a0, a1, a2 = -row[3 * BLOCK + i], -row[4 * BLOCK + i], -row[5 * BLOCK + i]
        e0, e1, e2 = times(r, a0, a1, a2)
        by_ray[i] = e0 * s[0] + e1 * s[3] + e2 * s[6]
        by_ray[BLOCK + i] = e0 * s[1] + e1 * s[4] + e2 * s[7]
        by_ray[2 * BLOCK + i] = (
            e0 * (anchor[4 * BLOCK + i] - pose[4 * BLOCK + i])
            + e1 * (anchor[5 * BLOCK + i] - pose[5 * BLOCK + i])
            + e2 * (anchor[6 * BLOCK + i] - pose[6 * BLOCK + i])
        )


@njit(cache=True, error_model="numpy", forceinline=True)
def _scale_shift(ray, n, row):
    """Scales the position columns by ρ: a ray's direction moves by ρ times as much as a point."""
    for i in range(n):
        rho = ray[2 * BLOCK + i]
        row[3 * BLOCK + i] *= rho
        row[4 * BLOCK + i] *= rho
        row[5 * BLOCK + i] *= rho


@njit(cache=True, error_model="numpy", forceinline=True)
def _both(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Residual and derivatives of the full 2-D measurement."""
    pose, ray, anchor, by_ray = flat(state), flat(mean), flat(const), flat(jac_landmark)
    across, down = flat(jac_state[0]), flat(jac_state[1])
    # As `locate`, for directions R_a (u, v, 1) + ρ (t_a − t).
    for i in range(n):
        r, s = rotation_at(pose, i), rotation_at(anchor, i)
        u, v, rho = ray[i], ray[BLOCK + i], ray[2 * BLOCK + i]
        a = s[0] * u + s[1] * v + s[2] + rho * (anchor[4 * BLOCK + i] - pose[4 * BLOCK + i])
        b = s[3] * u + s[4] * v + s[5] + rho * (anchor[5 * BLOCK + i] - pose[5 * BLOCK + i])
        c = s[6] * u + s[7] * v + s[8] + rho * (anchor[6 * BLOCK + i] - pose[6 * BLOCK + i])
        x, y, depth = back(r, a, b, c)
        by_ray[i], by_ray[BLOCK + i], by_ray[2 * BLOCK + i] = x, y, clamp_depth(x, y, depth)
    measure(by_ray, z[0], z[1], params, n, flat(nu), across, down)
    for a in range(2):
        row = flat(jac_state[a])
        _turn_ray(pose, anchor, row, n, by_ray[3 * a * BLOCK :])
        _scale_shift(ray, n, row)


@observation_kernel
def camera_ray(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Inverse depth, both dimensions; params are the camera's."""
    _both(state, mean, const, z, params, n, nu, jac_state, jac_landmark)


@njit(cache=True, error_model="numpy", forceinline=True)
def _take_out(along, n, first, second):
    """Removes the component along ∂h/∂ρ, (2, BLOCK) flat, from vectors (first, second)."""
    for i in range(n):
        a, b = along[i], along[BLOCK + i]
        squared = a * a + b * b
        fraction = 1.0 / squared if squared > 0.0 else 0.0
        part = fraction * (a * first[i] + b * second[i])
        first[i] -= a * part
        second[i] -= b * part


@observation_kernel
def epipolar_ray(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Inverse depth, across the epipolar line only; params are the camera's."""
    _both(state, mean, const, z, params, n, nu, jac_state, jac_landmark)
    along = np.empty(2 * BLOCK)
    for i in range(n):
        along[i], along[BLOCK + i] = jac_landmark[0, 2, i], jac_landmark[1, 2, i]
    _take_out(along, n, nu[0], nu[1])
    for k in range(6):
        _take_out(along, n, jac_state[0, k], jac_state[1, k])
    for k in range(3):
        _take_out(along, n, jac_landmark[0, k], jac_landmark[1, k])


_FLAGS = types.Array(boolean, 1, "C")


@njit(int64(MATRIX, MATRIX, _FLAGS, VECTOR, VECTOR, VECTOR, INDICES, MATRIX), cache=True, error_model="numpy")
def in_view(place, first_pose, alive, pose, params, limits, rows, px):
    """Selects the features in view: fills `rows` and their pixels `px` (rows, 2), returns their number.

    Inputs per feature (F,): `place` (F, 4) homogeneous in the world, `first_pose` (F, 7), `alive` (F,). Of the camera:
    `pose` (7,), `params` (10,), `limits` (6,) = width, height, margin, monotonic radius, least cosine, most scale.
    """
    r = rotation(pose[0], pose[1], pose[2], pose[3])
    low, right, bottom = limits[2] - 0.5, limits[0] - 0.5 - limits[2], limits[1] - 0.5 - limits[2]
    count = 0
    for i in range(alive.size):
        if not alive[i]:
            continue
        w = place[i, 3]
        a, b, c = place[i, 0] - w * pose[4], place[i, 1] - w * pose[5], place[i, 2] - w * pose[6]
        z = r[2] * a + r[5] * b + r[8] * c
        if not z > 0.0:
            continue
        x, y = r[0] * a + r[3] * b + r[6] * c, r[1] * a + r[4] * b + r[7] * c
        u, v, d00, d01, _, _, d11, _ = project(x, y, z, params)
        if not (low <= u <= right and low <= v <= bottom):
            continue
        # The distortion must be one-to-one there, as in `Pinhole.visible`.
        along, across, down = d00 * z / params[0], d01 * z / params[0], d11 * z / params[1]
        one_way = along + down > 0.0 and along * down - across * across > 0.0
        if not (math.hypot(x / z, y / z) < limits[3] and one_way):
            continue
        # Viewing direction and distance must be close to those of the first observation.
        a, b, along = 0.0, 0.0, 0.0
        for k in range(3):
            then, now = place[i, k] - w * first_pose[i, 4 + k], place[i, k] - w * pose[4 + k]
            a += then * then
            b += now * now
            along += then * now
        a, b = math.sqrt(a), math.sqrt(b)
        scale = b / max(a, 1e-300)
        alike = along >= limits[4] * max(a * b, 1e-300)
        if alike and 1.0 / limits[5] <= scale <= limits[5]:
            rows[count], px[count, 0], px[count, 1] = i, u, v
            count += 1
    return count


HEADER = KIND + 1  #: Parameters before the points: the camera's.


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
