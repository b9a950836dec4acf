"""Compiled choice of the features that a camera should see, see `rbpf.systems.mono.image_sensor`."""

import math

from numba import boolean, int64, njit, types

from rbpf.kernels.quaternion import rotation
from rbpf.kernels.signature import INDICES, MATRIX, VECTOR
from rbpf.sensors.pinhole_kernels import project

_FLAGS = types.Array(boolean, 1, "C")


@njit(cache=True, error_model="numpy")
def _is_unique(u, v, z, params, radius, slope):
    """Whether the distortion is one-to-one up to the direction (u, v), as `Pinhole.visible` asks."""
    along, across, down = slope[0] * z / params[0], slope[1] * z / params[0], slope[2] * z / params[1]
    one_way = along + down > 0.0 and along * down - across * across > 0.0
    return math.hypot(u, v) < radius and one_way


@njit(cache=True, error_model="numpy")
def _is_alike(place, first_pose, pose, i, least_cosine, most_scale):
    """Whether the line of sight and the distance are nearly those of the first sighting."""
    w = place[i, 3]
    a, b, along = 0.0, 0.0, 0.0
    for k in range(3):
        then, now = place[i, k] - w * first_pose[i, 4 + k], place[i, k] - w * pose[4 + k]
        a += then * then
        b += now * now
        along += then * now
    a, b = math.sqrt(a), math.sqrt(b)
    scale = b / max(a, 1e-300)
    return along >= least_cosine * max(a * b, 1e-300) and 1.0 / most_scale <= scale <= most_scale


@njit(int64(MATRIX, MATRIX, _FLAGS, VECTOR, VECTOR, VECTOR, INDICES, MATRIX), cache=True, error_model="numpy")
def in_view(place, first_pose, alive, pose, params, limits, rows, px):
    """Fills `rows` and their pixels `px` (rows, 2); returns how many there are.

    Args of features (F,): `place` (F, 4) homogeneous in the world, `first_pose` (F, 7), `alive` (F,). Of the camera:
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
        if not _is_unique(x / z, y / z, z, params, limits[3], (d00, d01, d11)):
            continue
        if _is_alike(place, first_pose, pose, i, limits[4], limits[5]):
            rows[count], px[count, 0], px[count, 1] = i, u, v
            count += 1
    return count
