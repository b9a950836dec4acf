"""All measurements of a recording in one table, their residuals, and landmarks triangulated from them.

Nothing here needs GTSAM: initial values of a batch adjustment, and tests of how well landmarks are determined.
"""

from collections.abc import Container
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog, KnownPoints
from rbpf.validation.metrics.gaussian_differences import mahalanobis

Index = NDArray[np.intp]
Residuals = tuple[Array, list[Array]]  #: Residuals (K, p), and their Jacobians (K, p, d) by each variable.
SINGULAR = 1e-12  #: An eigenvalue of a covariance below this fraction of the largest counts as zero.
HUBER = 1.345  #: Threshold of Huber's loss, in standard deviations.
LOOSE = 0.25  #: A landmark whose distance is uncertain by more than this fraction counts as undetermined.
COLLAPSED = 0.02  #: Depth, relative to the usual distance of landmarks, below which one is collapsed into its camera.
_ROUNDS = 6
_FAR = 1e4
_REACHES = np.geomspace(0.2, 50.0, 40)
_TINY = 1e-12
_NONE = 1e-200  # information of a landmark behind its cameras


@final
@dataclass(frozen=True, eq=False)
class ObservationTable:
    """All measurements of a log, one row each, in the order of the frames."""

    camera: Pinhole | RectifiedStereo  #: of the measurements.
    steps: Index  #: (K,) frame of each.
    index: Index  #: (K,) its landmark's index in `names`.
    names: NDArray[np.int64]  #: (L,) names of the landmarks, ascending.
    z: Array  #: (K, p) [px].
    cov_z: Array  #: (K, p, p) [px^2].

    def rows(self, kept: NDArray[np.bool_] | Index) -> "ObservationTable":
        """A subset of the rows, with their landmarks."""
        names, index = np.unique(self.names[self.index[kept]], return_inverse=True)
        return ObservationTable(self.camera, self.steps[kept], index, names, self.z[kept], self.cov_z[kept])

    def bearings(self) -> Array:
        """Unit directions (K, 3) of the landmarks in the (left) camera's frame."""
        camera = self.camera.camera if isinstance(self.camera, RectifiedStereo) else self.camera
        uv = camera.unproject(self.z[:, :2])
        rays = np.concatenate([uv, np.ones_like(uv[:, :1])], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def determined(self, known: Container[int]) -> "ObservationTable":
        """Without landmarks that a single camera observed in only one frame, which do not constrain its pose."""
        if isinstance(self.camera, RectifiedStereo):
            return self
        pairs = np.unique(np.stack([self.index, self.steps]), axis=1)
        frames = np.bincount(pairs[0], minlength=len(self.names))
        kept = [count > 1 or name in known for name, count in zip(self.names.tolist(), frames, strict=True)]
        return self.rows(np.array(kept, dtype=bool)[self.index])


def observation_table(log: FeatureLog) -> ObservationTable:
    """All measurements of a log. Raises InputError: one has a singular covariance."""
    counts = [len(frame.landmarks) for frame in log.frames]
    names, index = np.unique(np.concatenate([f.landmarks for f in log.frames]), return_inverse=True)
    steps = np.repeat(np.arange(len(counts)), counts)
    z = np.concatenate([frame.z for frame in log.frames])
    cov_z = np.concatenate([frame.cov_z for frame in log.frames])
    variances = np.linalg.eigvalsh(cov_z)
    if (bad := np.flatnonzero(~(variances[:, 0] > SINGULAR * variances[:, -1]))).size:
        where = f"landmark {names[index[bad[0]]]} in frame {steps[bad[0]]}"
        raise InputError(f"The covariance of {where} of {log.name} is not positive definite.")
    return ObservationTable(log.camera, steps, index, names, z, cov_z)


def in_one_piece(steps: Index, index: Index, frames: int, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Frames (T,) that landmarks connect with the known ones (L,), else with the first frame with any landmark.

    Observations (K,) are by their frame and by their landmark's row.
    """
    if not steps.size:
        return np.zeros(frames, dtype=bool)
    of_group = np.flatnonzero(known)
    ends = np.concatenate([index, of_group]) + frames
    starts = np.concatenate([steps, frames + np.repeat(of_group[:1], of_group.size)])
    size = frames + known.size
    _, piece = connected_components(csr_array((np.ones(ends.size), (starts, ends)), shape=(size, size)), False)
    anchor = frames + of_group[0] if of_group.size else steps[0]
    return np.asarray(piece[:frames] == piece[anchor])


def known_by_name(known: KnownPoints | None, names: NDArray[np.int64]) -> dict[int, tuple[Array, Array]]:
    """Position (3,) and covariance (3, 3), positive definite or zero, of the known points among the names."""
    if known is None:
        return {}
    seen, found = set(names.tolist()), {}
    for name, position, cov in zip(known.names.tolist(), known.positions, known.cov, strict=True):
        variances = np.linalg.eigvalsh(cov)
        if variances[0] <= SINGULAR * variances[-1] and np.any(cov):
            raise InputError(
                f"The covariance of known point {name} is singular; give a positive definite one, or zeros where it is exact."
            )
        if name in seen:
            found[name] = (np.asarray(position, dtype=float), np.asarray(cov, dtype=float))
    return found


def in_camera(table: ObservationTable, path: Array, points: Array) -> Array:
    """Each observation's landmark in the camera's frame (K, 3), of poses (T, 7) and points (L, 3)."""
    return SE3.inverse_transform(path[table.steps], points[table.index])


def reprojection(table: ObservationTable, path: Array, points: Array) -> Residuals:
    """Residuals (K, p) and their Jacobians by the pose (K, p, 6) and the landmark (K, p, 3).

    A landmark behind its camera costs a constant, as in GTSAM's own factors.
    """
    place = in_camera(table, path, points)
    front = place[:, 2] > 0
    place = np.where(front[:, None], place, [0.0, 0.0, 1.0])
    pinhole = table.camera.camera if isinstance(table.camera, RectifiedStereo) else table.camera
    residuals = np.where(front[:, None], table.camera.project(place) - table.z, 2 * pinhole.fx)
    slope = np.where(front[:, None, None], table.camera.jacobian(place), 0.0)
    # c = T⁻¹ l moves by c × ω − v: the rows of the slope s turn with s · (c × ω) = (s × c) · ω.
    by_pose = np.concatenate([np.cross(slope, place[:, None]), -slope], axis=-1)
    return residuals, [by_pose, slope @ SE3.rotation(path[table.steps]).mT]


def triangulate(table: ObservationTable, path: Array) -> Array:
    """Huber's estimate (L, 3) from the distances to rays, each in pixels of its image; near the rays without parallax."""
    # Centres and unit directions of the rays in the world, and noise as an angle; the right image of a stereo pair
    # gives a second ray.
    poses, camera, index = path[table.steps], table.camera, table.index
    std = np.sqrt(np.trace(table.cov_z, axis1=1, axis2=2) / table.z.shape[1])
    if isinstance(camera, RectifiedStereo):
        right = replace(table, z=table.z[:, [2, 1, 0]])
        other = SE3.transform(poses, np.array([camera.baseline_m, 0.0, 0.0]))
        centres = np.concatenate([SE3.translation(poses), other])
        rays = np.concatenate([_directions(poses, side.bearings()) for side in (table, right)])
        index, std = np.tile(index, 2), np.tile(std / camera.camera.fx, 2)
    else:
        centres, rays, std = SE3.translation(poses), _directions(poses, table.bearings()), std / camera.fx
    origin = first_centres(table, path)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    offset = centres - origin[index]
    weight = np.ones(len(rays))
    for _ in range(_ROUNDS):
        info = _sums(index, len(origin), weight[:, None, None] * across)
        info += _TINY * np.trace(info, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        pull = _sums(index, len(origin), weight[:, None] * np.einsum("kij,kj->ki", across, offset))
        points = np.linalg.solve(info, pull[..., None])[..., 0]
        away = points[index] - offset
        unit = std * np.maximum(np.abs(np.einsum("ki,ki->k", away, rays)), _TINY)
        miss = np.linalg.norm(np.einsum("kij,kj->ki", across, away), axis=1) / unit
        weight = np.minimum(1.0, HUBER / np.maximum(miss, _TINY)) / unit**2
    return origin + points


def place(table: ObservationTable, path: Array, points: Array, bad: NDArray[np.bool_]) -> Array:
    """Points (L, 3), with the bad ones moved to the best depth on their first rays.

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


def is_open(table: ObservationTable, path: Array, points: Array) -> NDArray[np.bool_]:
    """Whether the distance of each landmark is undetermined by its observations (L,).

    Its standard deviation alone is misleading: with hardly any camera motion, a point close in front of the cameras fits as
    well as one at infinity, and its distance would seem to be well known.
    """
    along = points - first_centres(table, path)
    square = np.einsum("ki,ki->k", along, along)
    std = np.sqrt(np.einsum("ki,kij,kj->k", along, spread(table, path, points), along))
    looseness = np.divide(std, square, out=np.full(len(points), np.inf), where=square > 0)
    return ~((looseness < LOOSE) & (parallax(table, path, points) > 1 / LOOSE))


def collapsed(table: ObservationTable, path: Array, points: Array) -> NDArray[np.bool_]:
    """Whether each landmark (L,) has collapsed into one of its cameras, where it explains any pixel, due to an outlier."""
    depth = np.full(len(points), np.inf)
    np.minimum.at(depth, table.index, in_camera(table, path, points)[:, 2])
    usual = np.median(np.linalg.norm(points - first_centres(table, path), axis=1))
    return np.asarray(depth < COLLAPSED * usual)


def first_centres(table: ObservationTable, path: Array) -> Array:
    """Camera position at the first observation of each landmark (L, 3)."""
    first = np.unique(table.index, return_index=True)[1]
    return SE3.translation(path[table.steps[first]])


def in_front(table: ObservationTable, path: Array, points: Array) -> NDArray[np.bool_]:
    """Whether each landmark is in front of all cameras that saw it (L,)."""
    behind = in_camera(table, path, points)[:, 2] <= 0
    return np.bincount(table.index, weights=behind, minlength=len(table.names)) == 0


def spread(table: ObservationTable, path: Array, points: Array) -> Array:
    """Covariance of each landmark (L, 3, 3), the poses taken as exact."""
    slope = reprojection(table, path, points)[1][1]
    info = _sums(table.index, len(points), slope.mT @ np.linalg.solve(table.cov_z, slope))
    info += (_NONE + _TINY * np.trace(info, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.inv(info))


def misfit(table: ObservationTable, path: Array, points: Array) -> Array:
    """Huber's loss of each landmark's observations (L,)."""
    norm = mahalanobis(reprojection(table, path, points)[0], table.cov_z)
    loss = np.where(norm < HUBER, 0.5 * norm**2, HUBER * (norm - 0.5 * HUBER))
    return np.bincount(table.index, weights=loss, minlength=len(points)).astype(float)


def parallax(table: ObservationTable, path: Array, points: Array) -> Array:
    """Significance of each landmark's inverse distance (L,): its difference from zero in standard deviations.

    It compares the fit of the observations to the point and to its direction at infinity, and so detects points that are
    near only because of scatter in the camera positions.
    """
    origin, rays = first_centres(table, path), _directions(path[table.steps], table.bearings())
    mean = _sums(table.index, len(points), rays)
    reach = np.linalg.norm(SE3.translation(path) - SE3.translation(path[0]), axis=1).max()
    reach = np.maximum(reach, np.linalg.norm(points - origin, axis=1))
    far = origin + (_FAR * reach / np.linalg.norm(mean, axis=1))[:, None] * mean
    return np.sqrt(2 * np.maximum(misfit(table, path, far) - misfit(table, path, points), 0.0))


def _directions(poses: Array, rays: Array) -> Array:
    return (SE3.rotation(poses) @ rays[..., None])[..., 0]


def _sums(index: Index, count: int, parts: Array) -> Array:
    """Sums (L, …) of the rows (K, …) of each landmark."""
    gather = csr_array((np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index)))
    return np.asarray(gather @ parts.reshape(len(parts), -1)).reshape(-1, *parts.shape[1:])
