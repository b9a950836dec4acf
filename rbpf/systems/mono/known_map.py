"""The map of a run: as Gaussians, for reports; and as a file in which later runs localise their camera."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import fitting, grey, integers, load_arrays, numbers, poses, read, text
from rbpf.core.filter import Filter
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation
from rbpf.maps.inverse_depth import MIN_RHO
from rbpf.maps.joint_map import JointMap
from rbpf.sensors.calibration import spread_rows
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.distortion import RadialTangential
from rbpf.sensors.camera.points import MembersView
from rbpf.sensors.feature_log import KnownPoints
from rbpf.systems.map_estimate import Anchored, MapEstimate, relative_points
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.feature_table import PATCH_PX
from rbpf.systems.system import Gauge

NAME = "known_map.npz"
VERSION = 1
LEAST = 8  #: Least number of points of a map for localisation.
MOST_BYTES = 1 << 30
MAX_VIEWS = 16  #: Maximum number of stored viewpoints for localisation without a prior.
#: Extent of a drawn ray around its mean inverse depth, in standard deviations.
RAY_SIGMAS = 2.0
#: Tolerance of the focal length for localisation in another camera's map.
FOCAL_FRACTION = 0.02
_SCHEMA = {
    "camera": numbers(10),
    "image_size": integers(2, least=1, below=1 << 16),
    "alignment": text(),
    "names": integers("points", least=0),
    "positions": numbers("points", 3),
    "cov": numbers("points", 3, 3),
    "windows": grey("points", PATCH_PX, PATCH_PX),
    "first_px": numbers("points", 2),
    "first_pose": poses("points"),
    "views": poses("views"),
}
_GAUGES: dict[str, Gauge] = {"none": "none", "rigid": "rigid", "similarity": "similarity"}


@dataclass(frozen=True)
class KnownMap:
    """K points of a finished run, in its world."""

    camera: Pinhole  #: that observed them.
    alignment: Gauge  #: relation of its world to that of the ground truth.
    names: np.ndarray  #: (K,) int64.
    positions: np.ndarray  #: (K, 3).
    cov: np.ndarray  #: (K, 3, 3) of them, within + between particles.
    windows: np.ndarray  #: (K, S, S) uint8 around the first observations.
    first_px: np.ndarray  #: (K, 2) pixels of those.
    first_pose: np.ndarray  #: (K, 7) world_from_camera then.
    views: np.ndarray  #: (V, 7) world_from_camera of the run, distant from each other.

    @property
    def points(self) -> KnownPoints:
        """The points named by their rows, as in a localised run."""
        return KnownPoints(np.arange(self.names.size), self.positions, self.cov)

    @property
    def size_m(self) -> float:
        """Half the diagonal of the box around all points and views."""
        places = np.concatenate([self.positions, self.views[:, 4:]])
        return 0.5 * float(np.linalg.norm(np.ptp(places, axis=0)))

    def require_camera(self, camera: Pinhole) -> None:
        """Raises InputError: the camera's image size, focal length or lens differs from the map's."""
        mine = self.camera
        if mine.distortion_model != camera.distortion_model:
            raise InputError(
                f"the map was made through a lens with {mine.distortion_model} distortion, the recording has "
                f"{camera.distortion_model} distortion: correct its calibration, or map with it"
            )
        same = (mine.width, mine.height) == (camera.width, camera.height)
        ratio = np.array([camera.fx / mine.fx, camera.fy / mine.fy])
        if not same or np.abs(ratio - 1.0).max() > FOCAL_FRACTION:
            raise InputError(
                f"the map was made with images of {mine.width}x{mine.height} px, focal length {mine.fx:.0f} px; "
                f"the recording has {camera.width}x{camera.height} px and {camera.fx:.0f} px: scale its images, or map with it"
            )


def known_map_arrays(found: KnownMap) -> dict[str, np.ndarray]:
    """The arrays of the file."""
    named = ("camera", "alignment")
    arrays = {item.name: getattr(found, item.name) for item in fields(KnownMap) if item.name not in named}
    camera = found.camera
    # Only fisheye cameras store their lens, so that files of other cameras keep their format.
    params = camera.params if camera.lens.kind != RadialTangential.kind else camera.params[:-1]
    return {
        "version": np.array(VERSION),
        "camera": params,
        "image_size": np.array([camera.width, camera.height]),
        "alignment": np.array(found.alignment),
        **arrays,
    }


def map_file(path: Path) -> Path:
    """The file itself, or that of a run's folder."""
    return path / NAME if path.is_dir() else path


def read_known_map(path: Path) -> KnownMap:
    """Reads the file, or that of a run's folder.

    Raises InputError: it is missing, damaged, of another version, or holds too few points.
    """
    path = map_file(path)
    if not path.is_file():
        raise InputError(
            f"{path}: there is no such map; expected the folder of a finished `rbpf run mono`, or its {NAME}"
        )
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path} is larger than any map")
    arrays = load_arrays(path)
    version = arrays.get("version", np.zeros(()))
    if version.shape or version.dtype.kind != "i" or int(version) != VERSION:
        raise InputError(f"{path} is no map of this version of the program: map again")
    with fitting(path):
        if "camera" in arrays and arrays["camera"].shape == (9,):
            arrays = arrays | {"camera": np.append(arrays["camera"], RadialTangential.kind)}
        parts = read(arrays, _SCHEMA)
        if not len(parts["views"]) or (np.linalg.eigvalsh(parts["cov"]) < 0.0).any():
            raise InputError("expected views, and covariances that are none less than zero")
        params, size, alignment = (parts.pop(name) for name in ("camera", "image_size", "alignment"))
        width, height = size.tolist()
        camera = Pinhole.from_params(width, height, params)
        found = KnownMap(camera, _GAUGES[str(alignment)], **parts)
    if found.names.size < LEAST:
        raise InputError(
            f"{path} holds {found.names.size} points of known depth, expected at least {LEAST}: map for longer"
        )
    return found


def estimate_mono_map(filter_: Filter, features: FeatureSensor, world: Anchored | None) -> MapEstimate:
    """Every landmark of a filter's map, in the order of their names, with the column `ray`.

    A ray is linearised at its mean inverse depth; its ends are those in the heaviest particle. `world` is the reported world
    in each particle's own; None if they are identical.
    """
    belief = filter_.belief()
    held, n = belief.map, belief.weights.size
    if isinstance(held, JointMap):
        names, means, covs = held.landmarks(filter_.particles)
    else:
        no_world = Anchored(SE3.identity((n,)), np.zeros((n, 6, 6)))
        group = features.group
        names = held.ids if group is None or not held.ids.size else np.union1d(held.ids, group.names)
        means, covs = np.empty((names.size, 3)), np.empty((names.size, 3, 3))
        for model, chosen, ids in features.by_model(belief, names):
            records = held.read(ids)
            if isinstance(model, MembersView):
                kind = held.landmark_of(int(ids[0]))
                assert isinstance(kind, Constellation)
                points = tuple(each[:, model.places] for each in kind.in_group(records))
            else:
                is_ray = model is features.unknown_depth.model
                records = features.unknown_depth.as_points(records) if is_ray else records
                points = relative_points(SE3, world or no_world, records)
            means[chosen], covs[chosen] = gaussian.mixture_moments(belief.weights, *points)
    spans = np.full((names.size, 2, 3), np.nan)
    which, ends = features.extents(belief, names, RAY_SIGMAS, MIN_RHO)
    spans[which] = ends[..., :3] / ends[..., 3:]
    if world is not None:
        spans = SE3.inverse_transform(world.mean[belief.mode], spans)
    order = np.argsort(names)
    columns = {"ray": np.isfinite(spans[order]).all(axis=(1, 2)).astype(int)}
    return MapEstimate(names[order], means[order], covs[order], columns, spans[order])


def distant_views(positions: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (V, 7) of (T, 7) by farthest-point sampling; a rotation of one radian counts as the depth of points (K, 3)."""
    centre = poses[:, 4:].mean(axis=0)
    depth = float(np.linalg.norm(positions - centre, axis=1).mean()) if len(positions) else 1.0
    ahead = SE3.rotation(poses) @ np.array([0.0, 0.0, 1.0])
    return poses[spread_rows(np.concatenate([poses[:, 4:] / depth, ahead], axis=1), MAX_VIEWS)]
