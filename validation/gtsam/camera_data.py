"""What the batch solution of camera features starts from: a table of all sightings, and an estimate."""

from collections.abc import Container
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog, KnownPoints

Index = NDArray[np.intp]

SINGULAR = 1e-12
"""An eigenvalue of a covariance below this fraction of the largest counts as zero."""


@final
@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """Where to start from.

    Attributes:
        world_from_camera: (T, 7) poses.
        landmarks: name to (3,) position [m]; those that it lacks are triangulated from the poses.
    """

    world_from_camera: Array
    landmarks: dict[int, Array]


@final
@dataclass(frozen=True, eq=False)
class Sightings:
    """All measurements of a log, one row each, in the order of the frames.

    Attributes:
        camera: that took them.
        steps: (K,) frame of each.
        index: (K,) its landmark's place in `names`.
        names: (L,) names of the landmarks, ascending.
        z: (K, p) [px].
        cov_z: (K, p, p) [px^2].
    """

    camera: Pinhole | RectifiedStereo
    steps: Index
    index: Index
    names: NDArray[np.int64]
    z: Array
    cov_z: Array

    def rows(self, kept: NDArray[np.bool_] | Index) -> "Sightings":
        """Some of the rows, with the landmarks that they show."""
        names, index = np.unique(self.names[self.index[kept]], return_inverse=True)
        return Sightings(self.camera, self.steps[kept], index, names, self.z[kept], self.cov_z[kept])

    def bearings(self) -> Array:
        """Unit directions (K, 3) of the landmarks in the (left) camera's frame."""
        camera = self.camera.camera if isinstance(self.camera, RectifiedStereo) else self.camera
        uv = camera.unproject(self.z[:, :2])
        rays = np.concatenate([uv, np.ones_like(uv[:, :1])], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def determined(self, known: Container[int]) -> "Sightings":
        """Without those of landmarks that a single camera saw in one frame only, which tell nothing about its pose."""
        if isinstance(self.camera, RectifiedStereo):
            return self
        pairs = np.unique(np.stack([self.index, self.steps]), axis=1)
        frames = np.bincount(pairs[0], minlength=len(self.names))
        kept = [count > 1 or name in known for name, count in zip(self.names.tolist(), frames, strict=True)]
        return self.rows(np.array(kept, dtype=bool)[self.index])


def sightings_of(log: FeatureLog) -> Sightings:
    """All measurements of a log.

    Raises:
        InputError: a covariance is singular.
    """
    counts = [len(frame.landmarks) for frame in log.frames]
    names, index = np.unique(np.concatenate([f.landmarks for f in log.frames]), return_inverse=True)
    steps = np.repeat(np.arange(len(counts)), counts)
    z = np.concatenate([frame.z for frame in log.frames])
    cov_z = np.concatenate([frame.cov_z for frame in log.frames])
    table = Sightings(log.camera, steps, index, names, z, cov_z)
    _require_noise(log, table)
    return table


def known_by_name(known: KnownPoints | None, names: NDArray[np.int64]) -> dict[int, tuple[Array, Array]]:
    """Position (3,) and covariance (3, 3) of the known points among the names.

    Raises:
        InputError: a covariance is neither positive definite nor zero.
    """
    if known is None:
        return {}
    seen, found = set(names.tolist()), {}
    for name, position, cov in zip(known.names.tolist(), known.positions, known.cov, strict=True):
        variances = np.linalg.eigvalsh(cov)
        if variances[0] <= SINGULAR * variances[-1] and np.any(cov):
            raise InputError(
                f"The covariance of known point {name} is singular; expected a positive definite one, "
                "or zeros for a point known exactly."
            )
        if name in seen:
            found[name] = (np.asarray(position, dtype=float), np.asarray(cov, dtype=float))
    return found


def in_camera(table: Sightings, path: Array, points: Array) -> Array:
    """Each sighting's landmark in the camera's frame (K, 3), of poses (T, 7) and points (L, 3)."""
    return SE3.inverse_transform(path[table.steps], points[table.index])


def _require_noise(log: FeatureLog, table: Sightings) -> None:
    variances = np.linalg.eigvalsh(table.cov_z)
    if (bad := np.flatnonzero(~(variances[:, 0] > SINGULAR * variances[:, -1]))).size:
        place = f"landmark {table.names[table.index[bad[0]]]} in frame {table.steps[bad[0]]}"
        raise InputError(f"The covariance of {place} of {log.name} is not positive definite.")
