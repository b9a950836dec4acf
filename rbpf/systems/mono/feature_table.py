"""The table of features: appearance and viewpoint, current position, and search statistics of each.

These are common to all particles. A feature's number is its row here, in all reports of a run.
"""

from typing import Any, final

import numpy as np

from rbpf.core.checkpoint import grey, integers, numbers, poses, read, truths
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import SearchConfig

#: Half-width of a stored patch: large enough to be rotated and shrunk.
PATCH_HALF_PX = 15
PATCH_PX = 2 * PATCH_HALF_PX + 1
#: Lower bound of a homogeneous point's weight for its patch; smaller ones are raised to it.
MIN_WEIGHT = 1e-3
ENOUGH_TRUSTED = 6  #: Trusted matches that suffice to determine the motion: three do, and half of them may be wrong.
_OFFSETS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
_COLUMNS = {
    "first_patch": grey("features", PATCH_PX, PATCH_PX),
    "last_patch": grey("features", PATCH_PX, PATCH_PX),
    "first_px": numbers("features", 2),
    "first_pose": poses("features"),
    "last_pose": poses("features"),
    "position": numbers("features", 4),
    "plane_information": numbers("features", 2, 3),
    "squared_parallax": numbers("features", 2, least=0.0),
    "attempts": integers("features", least=0),
    "found": integers("features", least=0),
    "missed": integers("features", least=0),
    "alive": truths("features"),
    "member": integers("features", least=-1, below="members"),
}


@final
class FeatureTable:
    """One row per feature ever initialised. Columns are views of the F rows in use."""

    first_patch: np.ndarray  #: (F, S, S) uint8 first appearance.
    last_patch: np.ndarray  #: (F, S, S) uint8 a later appearance under different viewing conditions; else the first.
    first_px: np.ndarray  #: (F, 2) pixel of the first one.
    first_pose: np.ndarray  #: (F, 7) world_from_camera of the first one, in the heaviest particle's world.
    last_pose: np.ndarray  #: (F, 7) likewise of the later one.
    position: np.ndarray  #: (F, 4) homogeneous point in the heaviest particle's world, when it was last observed.
    #: (F, 2, 3) information about its first patch's `slopes`: sums of information, and of information times slope.
    plane_information: np.ndarray
    squared_parallax: np.ndarray  #: (F, 2) sum and maximum over these views, see `parallax`.
    attempts: np.ndarray  #: (F,) number of searches, the initialisation included.
    found: np.ndarray  #: (F,) number of matches, the initialisation included.
    missed: np.ndarray  #: (F,) consecutive misses.
    alive: np.ndarray  #: (F,) whether it is still in the map.
    member: np.ndarray  #: (F,) its index in a known constellation, or −1.

    def __init__(self) -> None:
        self._room: dict[str, np.ndarray] = {name: entry.empty() for name, entry in _COLUMNS.items()}
        self._use(0)

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._use(len(self.alive))  # columns of a copy, too, are views

    def __len__(self) -> int:
        return len(self.alive)

    def add(self, patches: np.ndarray, px: np.ndarray, pose: np.ndarray, member: np.ndarray | int = -1) -> np.ndarray:
        """Adds k features observed at px (k, 2) from poses (7,) or (k, 7), with patches (k, S, S); returns their rows."""
        first, count = len(self), len(self) + px.shape[0]
        room = len(self._room["alive"])
        if count > room:
            extra = max(count, 2 * room, 64) - room
            for name, column in self._room.items():
                more = np.zeros((extra, *column.shape[1:]), dtype=column.dtype)
                self._room[name] = np.concatenate([column, more])
        self._use(count)
        rows = np.arange(first, count)
        self.first_patch[rows], self.first_px[rows], self.first_pose[rows] = patches, px, pose
        self.last_patch[rows], self.last_pose[rows] = patches, pose
        self.attempts[rows], self.found[rows], self.alive[rows] = 1, 1, True
        self.member[rows] = member
        return rows

    def count_search(self, rows: np.ndarray, found: np.ndarray) -> None:
        """Counts a search of features (k,), matched or not (k,) bool."""
        self.attempts[rows] += 1
        self.found[rows] += found
        self.missed[rows] = np.where(found, 0, self.missed[rows] + 1)

    def failing(self, rows: np.ndarray, config: SearchConfig) -> np.ndarray:
        """Mask of the features (k,) that are missed too often."""
        missed_often = 1.0 - self.found[rows] / self.attempts[rows] > config.max_failure_ratio
        return np.asarray(missed_often & (self.attempts[rows] >= config.min_attempts))

    def found_fraction(self, rows: np.ndarray) -> np.ndarray:
        """Success rate (k,) of searches of features (k,), by Laplace's rule of succession."""
        return np.asarray((self.found[rows] + 1.0) / (self.attempts[rows] + 2.0))

    def trusted(self, rows: np.ndarray, min_fraction: float) -> np.ndarray:
        """Mask of the features (k,) with a sufficient success rate to localise the camera; all if these are too few."""
        trusted = (self.member[rows] >= 0) | (self.found_fraction(rows) >= min_fraction)
        return trusted if trusted.sum() >= ENOUGH_TRUSTED else np.ones(rows.size, dtype=bool)

    def voting(self, rows: np.ndarray, min_fraction: float) -> np.ndarray:
        """Mask of the trusted features (k,) searched since initialisation, to determine the motion; all trusted if few."""
        trusted = self.trusted(rows, min_fraction)
        known = trusted & ((self.member[rows] >= 0) | (self.attempts[rows] > 1))
        return known if known.sum() >= ENOUGH_TRUSTED else trusted

    def nearest_appearance(
        self, rows: np.ndarray, position: np.ndarray, world_from_camera: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Patches (k, S, S) stored closest to a pose's viewing direction of points (k, 4), and their poses (k, 7)."""
        first, last = self.first_pose[rows], self.last_pose[rows]
        of_first, of_last = (view_change(position, pose, world_from_camera)[0] for pose in (first, last))
        later = of_last > of_first
        patches = np.where(later[:, None, None], self.last_patch[rows], self.first_patch[rows])
        return patches, np.where(later[:, None], last, first)

    def slopes(self, rows: np.ndarray) -> np.ndarray:
        """Slopes (k, 2) of the first patches of features (k,), relative to patches that face their camera.

        A slope is the derivative of the logarithm of the inverse depth by normalised coordinates, constant in a plane; 1 is a
        plane at 45°, and the prior's standard deviation. Half of the noise of a comparison is the first patch's, common to
        all views: n views have the information of 2 n / (1 + n).
        """
        info, (total, greatest) = self.plane_information[rows], self.squared_parallax[rows].T
        info = 2.0 / (1.0 + total / np.maximum(greatest, np.finfo(float).tiny))[:, None, None] * info
        return np.asarray(np.linalg.solve(info[:, :, :2] + np.eye(2), info[:, :, 2:])[..., 0])

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint."""
        return {f"features/{name}": getattr(self, name) for name in _COLUMNS}

    def restore(self, arrays: dict[str, np.ndarray], members: int) -> None:
        """The inverse of `arrays`, for a constellation of so many points; errors as `rbpf.core.checkpoint.read`."""
        self._room = read(arrays, _COLUMNS, "features/", members=members)
        if (np.linalg.eigvalsh(self._room["plane_information"][:, :, :2]) < -0.1).any():
            raise InputError("features/plane_information: expected positive semi-definite information")
        self._use(len(self._room["alive"]))

    def _use(self, count: int) -> None:
        for name, column in self._room.items():
            setattr(self, name, column[:count])


def directions(position: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """Directions (K, 3) in the camera's frame of homogeneous world points (K, 4)."""
    centre = SE3.translation(world_from_camera)
    return SE3.inverse_transform(world_from_camera, position[:, :3] + (1.0 - position[:, 3:]) * centre)


def patch_affines(
    camera: Pinhole, position: np.ndarray, first_pose: np.ndarray, world_from_camera: np.ndarray
) -> np.ndarray:
    """∂(pixel in the patch's image)/∂(pixel now) (K, 2, 2) of patches that face their camera (E06 §4.1).

    Patches are at homogeneous world points (K, 4), observed from poses (K, 7); the current camera is at (7,). See `tilted`
    for other orientations.
    """
    point = position[:, :3] / np.maximum(position[:, 3:], MIN_WEIGHT)
    normal = SE3.translation(first_pose) - point
    # Four pixels around the feature are projected onto its patch's plane, and from there into the first camera.
    now = camera.project(directions(position, world_from_camera))
    uv = camera.unproject(now[:, None] + _OFFSETS)
    rays = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1)
    centre = SE3.translation(world_from_camera)
    world_rays = SE3.transform(world_from_camera, rays) - centre
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (normal * (point - centre)).sum(axis=-1)[:, None] / (normal[:, None] * world_rays).sum(axis=-1)
    on_patch = centre + depth[..., None] * world_rays
    first = camera.project(SE3.inverse_transform(first_pose[:, None], on_patch))
    return np.stack([first[:, 0] - first[:, 1], first[:, 2] - first[:, 3]], axis=-1) / 2.0


def parallax(
    camera: Pinhole, position: np.ndarray, first_pose: np.ndarray, world_from_camera: np.ndarray
) -> np.ndarray:
    """∂(pixel now)/∂(logarithm of the inverse depth) (K, 2) along the first lines of sight; arguments as `patch_affines`."""
    point = position[:, :3] / np.maximum(position[:, 3:], MIN_WEIGHT)
    line = (SE3.translation(first_pose) - point) @ SE3.rotation(world_from_camera)
    return (camera.jacobian(SE3.inverse_transform(world_from_camera, point)) @ line[..., None])[..., 0]


def tilted(affines: np.ndarray, along: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """`patch_affines` (K, 2, 2) of patches with slopes (K, 2), by the pixel of their images, whose parallax is (K, 2).

    Changing the plane through a point shifts the other view's image by the parallax times the change of inverse depth: A⁻¹ =
    A₀⁻¹ + e gᵀ, inverted by Sherman and Morrison.
    """
    back, ahead = affines @ along[..., None], slope[:, None] @ affines
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(affines - back @ ahead / (1.0 + slope[:, None] @ back))


def view_change(position: np.ndarray, one_pose: np.ndarray, other_pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Change of view between two poses, (7,) or (K, 7), of points (K, 4): cosine (K,) of the rays, ratio (K,) of distances."""
    one, other = (position[:, :3] - position[:, 3:] * SE3.translation(pose) for pose in (one_pose, other_pose))
    far, near = np.linalg.norm(one, axis=-1), np.linalg.norm(other, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (one * other).sum(axis=-1) / (far * near), far / near
