"""Landmarks from the rays of their sightings, and how well these determine them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from rbpf.lie import SE3, Array
from rbpf.sensors.camera import RectifiedStereo
from rbpf.validation.gtsam.camera_data import Sightings, in_camera
from rbpf.validation.gtsam.camera_factors import evaluate_sightings

HUBER = 1.345
"""Threshold of the loss where outliers must not do harm, in standard deviations."""
LOOSE = 0.25
"""A landmark whose distance is uncertain by more than this fraction counts as undetermined."""
COLLAPSED = 0.02
"""Depth, as a fraction of the usual distance of a landmark, of one that has run into its camera."""

_ROUNDS = 6
_FAR = 1e4
_REACHES = np.geomspace(0.2, 50.0, 40)
_TINY = 1e-12
_NONE = 1e-200  # information of a landmark behind its cameras


def triangulate(table: Sightings, path: Array) -> Array:
    """Huber's estimate from the distances to the rays, each taken in pixels of its image.

    Args:
        table: sightings.
        path: (T, 7) poses.

    Returns:
        (L, 3) positions; anywhere near its rays where a landmark has no parallax.
    """
    centres, rays, index, std = _rays(table, path)
    gather = _gather(index, len(table.names))
    origin = first_centres(table, path)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    offset = centres - origin[index]
    weight = np.ones(len(rays))
    for _ in range(_ROUNDS):
        info = _sums(gather, weight[:, None, None] * across)
        info += _TINY * np.trace(info, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        pull = _sums(gather, weight[:, None] * np.einsum("kij,kj->ki", across, offset))
        points = np.linalg.solve(info, pull[..., None])[..., 0]
        away = points[index] - offset
        unit = std * np.maximum(np.abs(np.einsum("ki,ki->k", away, rays)), _TINY)
        miss = np.linalg.norm(np.einsum("kij,kj->ki", across, away), axis=1) / unit
        weight = np.minimum(1.0, HUBER / np.maximum(miss, _TINY)) / unit**2
    return origin + points


def place(table: Sightings, path: Array, points: Array, bad: NDArray[np.bool_]) -> Array:
    """Points (L, 3), of which the bad ones are moved to where they fit best on their first rays.

    The distances tried are those from a fifth to fifty times the median of the others.
    """
    if not bad.any():
        return points
    part = table.rows(bad[table.index])
    origin, first = first_centres(part, path), np.unique(part.index, return_index=True)[1]
    distance = np.linalg.norm(points - first_centres(table, path), axis=1)
    usual = float(np.median(distance[~bad])) if not bad.all() else 1.0
    rays = _directions(path[part.steps], part.bearings())[first]
    tried = origin + usual * _REACHES[:, None, None] * rays
    best = np.argmin([misfit(part, path, points) for points in tried], axis=0)
    moved = points.copy()
    moved[bad] = tried[best, np.arange(len(best))]
    return moved


def is_open(table: Sightings, path: Array, points: Array) -> NDArray[np.bool_]:
    """Whether the sightings leave each landmark's distance open (L,).

    Its standard deviation alone does not tell: where the cameras hardly moved, a point a hand's breadth in front of
    them fits as well as one at infinity, and its distance would seem to be known well.
    """
    known = (looseness(table, path, points) < LOOSE) & (parallax(table, path, points) > 1 / LOOSE)
    return ~known


def collapsed(table: Sightings, path: Array, points: Array) -> NDArray[np.bool_]:
    """Whether each landmark (L,) has run into one of its cameras, where it explains any pixel: an outlier's doing."""
    depth = np.full(len(points), np.inf)
    np.minimum.at(depth, table.index, in_camera(table, path, points)[:, 2])
    usual = np.median(np.linalg.norm(points - first_centres(table, path), axis=1))
    return np.asarray(depth < COLLAPSED * usual)


def first_centres(table: Sightings, path: Array) -> Array:
    """Where the camera was at the first sighting of each landmark (L, 3)."""
    first = np.unique(table.index, return_index=True)[1]
    return SE3.translation(path[table.steps[first]])


def in_front(table: Sightings, path: Array, points: Array) -> NDArray[np.bool_]:
    """Whether each landmark is in front of all cameras that saw it (L,)."""
    behind = in_camera(table, path, points)[:, 2] <= 0
    return np.bincount(table.index, weights=behind, minlength=len(table.names)) == 0


def spread(table: Sightings, path: Array, points: Array) -> Array:
    """Covariance of each landmark (L, 3, 3), the poses taken as exact."""
    slope = evaluate_sightings(table, path, points)[1][1]
    info = _sums(_gather(table.index, len(points)), slope.mT @ np.linalg.solve(table.cov_z, slope))
    info += (_NONE + _TINY * np.trace(info, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.inv(info))


def looseness(table: Sightings, path: Array, points: Array) -> Array:
    """Standard deviation of each landmark's distance over its distance (L,), the poses taken as exact."""
    along = points - first_centres(table, path)
    square = np.einsum("ki,ki->k", along, along)
    std = np.sqrt(np.einsum("ki,kij,kj->k", along, spread(table, path, points), along))
    return np.divide(std, square, out=np.full(len(points), np.inf), where=square > 0)


def misfit(table: Sightings, path: Array, points: Array, cap: float = np.inf) -> Array:
    """Huber's loss of each landmark's sightings (L,), each of which counts for no more than the cap."""
    residuals = evaluate_sightings(table, path, points)[0]
    norm = np.sqrt(
        np.einsum("ki,ki->k", residuals, np.linalg.solve(table.cov_z, residuals[..., None])[..., 0])
    )
    loss = np.where(norm < HUBER, 0.5 * norm**2, HUBER * (norm - 0.5 * HUBER))
    return np.bincount(table.index, weights=np.minimum(loss, cap), minlength=len(points)).astype(float)


def parallax(table: Sightings, path: Array, points: Array, cap: float = np.inf) -> Array:
    """By how many standard deviations the inverse distance of each landmark (L,) differs from zero.

    It compares how well the sightings fit the point and its direction at infinity, and so sees through a point that
    only the scatter of the cameras' places has brought near.
    """
    origin, rays = first_centres(table, path), _directions(path[table.steps], table.bearings())
    mean = _sums(_gather(table.index, len(points)), rays)
    reach = np.linalg.norm(SE3.translation(path) - SE3.translation(path[0]), axis=1).max()
    reach = np.maximum(reach, np.linalg.norm(points - origin, axis=1))
    far = origin + (_FAR * reach / np.linalg.norm(mean, axis=1))[:, None] * mean
    return np.sqrt(2 * np.maximum(misfit(table, path, far, cap) - misfit(table, path, points, cap), 0.0))


def _rays(table: Sightings, path: Array) -> tuple[Array, Array, NDArray[np.intp], Array]:
    # Centres and unit directions (R, 3) in the world, landmarks, and noise as an angle; the right image of a stereo
    # pair gives a second ray.
    poses, camera = path[table.steps], table.camera
    std = np.sqrt(np.trace(table.cov_z, axis1=1, axis2=2) / table.z.shape[1])
    if not isinstance(camera, RectifiedStereo):
        return SE3.translation(poses), _directions(poses, table.bearings()), table.index, std / camera.fx
    right = replace(table, z=table.z[:, [2, 1, 0]])
    other = SE3.transform(poses, np.array([camera.baseline_m, 0.0, 0.0]))
    centres = np.concatenate([SE3.translation(poses), other])
    rays = np.concatenate([_directions(poses, side.bearings()) for side in (table, right)])
    return centres, rays, np.tile(table.index, 2), np.tile(std / camera.camera.fx, 2)


def _directions(poses: Array, rays: Array) -> Array:
    return (SE3.rotation(poses) @ rays[..., None])[..., 0]


def _gather(index: NDArray[np.intp], count: int) -> csr_array:
    # Its product with rows of sightings sums those of each landmark.
    rows = np.arange(len(index))
    return csr_array((np.ones(len(index)), (index, rows)), shape=(count, len(index)))


def _sums(gather: csr_array, parts: Array) -> Array:
    return np.asarray(gather @ parts.reshape(len(parts), -1)).reshape(-1, *parts.shape[1:])
