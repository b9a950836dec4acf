"""A path and a map with their covariances: a filter's at its end, a batch optimum's, a run folder's."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rbpf import __version__
from rbpf.core.checkpoint import load_arrays
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Array, SE2Group, SE3Group
from rbpf.runs.trajectory import Trajectory, read_tum
from rbpf.systems.map_estimate import MapEstimate, estimate_map, map_of
from rbpf.systems.mono.run import MonoRun
from rbpf.systems.mono.video import VideoRun
from rbpf.systems.plain_yaml import read_plain_yaml
from rbpf.systems.range_bearing.run import Run
from rbpf.systems.stereo.run import StereoRun
from rbpf.validation.camera_map import summarise_points
from rbpf.validation.mono_map import summarise_mono_map
from rbpf.validation.run_files import path_of

AnyRun = Run | MonoRun | VideoRun | StereoRun


@final
@dataclass(frozen=True, eq=False)
class PathAndMap:
    """T poses in SE2 or SE3 and M landmarks.

    Attributes:
        stamps_ns: (T,).
        world_from_body: (T, E).
        cov_poses: (T, d, d) in the right chart at each pose, order [omega, v]; no rows where they are not known.
        landmarks: those that are points.
    """

    stamps_ns: NDArray[np.int64]
    world_from_body: Array
    cov_poses: Array
    landmarks: MapEstimate

    @property
    def space(self) -> SE2Group | SE3Group:
        """The group of the poses."""
        return SE2 if self.world_from_body.shape[1] == SE2.size else SE3

    @property
    def trajectory(self) -> Trajectory:
        """The path in space."""
        if self.space is SE2:
            return Trajectory.from_planar(self.stamps_ns, self.world_from_body)
        return Trajectory(self.stamps_ns, self.world_from_body)

    def at(self, rows: NDArray[np.intp]) -> "PathAndMap":
        """Some of the poses, with all landmarks."""
        covs = self.cov_poses[rows] if len(self.cov_poses) else self.cov_poses
        return PathAndMap(self.stamps_ns[rows], self.world_from_body[rows], covs, self.landmarks)


def of_run(run: AnyRun) -> PathAndMap:
    """The online filtered poses of a run in memory, and its last map, within + between particles."""
    if isinstance(run, Run):
        stamps = np.array([frame.stamp_ns for frame in run.log.frames], dtype=np.int64)
        summary = estimate_map(run.filter, run.anchored)
        return PathAndMap(stamps, run.progress.mean, run.progress.cov, summary)
    if isinstance(run, MonoRun):
        return PathAndMap(run.stamps_ns, run.world_from_camera, run.cov, summarise_points(run.filter))
    if isinstance(run, StereoRun):
        return PathAndMap(run.stamps_ns, run.world_from_camera, run.cov, estimate_map(run.filter))
    mapped = summarise_mono_map(run.filter)
    full, found = ~mapped.is_ray, mapped.landmarks
    points = MapEstimate(found.ids[full], found.mean[full], found.cov[full])
    return PathAndMap(run.stamps_ns, run.world_from_camera, run.cov, points)


def read_config(folder: Path) -> dict[str, Any]:
    """The entries of a run folder's config.yaml.

    Raises:
        InputError: it is no run folder, or one of another version.
    """
    path = folder / "config.yaml"
    if not path.exists():
        raise InputError(f"{folder} holds no config.yaml: expected the folder that `rbpf run` leaves.")
    config = read_plain_yaml(path)
    if not isinstance(config, dict) or "rbpf" not in config or "system" not in config:
        raise InputError(
            f"{path}: expected the settings of a run with its version and system, found other content."
        )
    if _series(str(config["rbpf"])) != _series(__version__):
        raise InputError(
            f"{folder} was written by rbpf {config['rbpf']}, this is {__version__}; run again with --config {path}."
        )
    return config


def read_path_and_map(folder: Path) -> PathAndMap:
    """What a run folder holds: trajectory.npz, or without it trajectory.tum and no covariances; map.npz.

    Raises:
        InputError: it is no run folder, one of another version, or a file is missing or malformed.
    """
    read_config(folder)
    return PathAndMap(*_read_path(folder), _read_map(folder))


def _read_path(folder: Path) -> tuple[NDArray[np.int64], Array, Array]:
    if (folder / "trajectory.npz").exists():
        arrays = _arrays(folder / "trajectory.npz", ("stamps_ns", "mean", "cov"))
        return path_of(folder / "trajectory.npz", arrays)
    path = read_tum(folder / "trajectory.tum")
    poses = path.world_from_body
    if _read_map(folder).mean.shape[1] == 2:
        heading = 2.0 * np.arctan2(poses[:, 2], poses[:, 3])
        poses = SE2.normalise(np.stack([heading, poses[:, 4], poses[:, 5]], axis=1))
    dim = SE2.dim if poses.shape[1] == SE2.size else SE3.dim
    return path.stamps_ns, poses, np.empty((0, dim, dim))


def _read_map(folder: Path) -> MapEstimate:
    return map_of(folder / "map.npz", _arrays(folder / "map.npz", ("id", "mean", "cov")))


def _arrays(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    if not path.exists():
        raise InputError(f"{path.parent} holds no {path.name}: expected the folder of a finished run.")
    arrays = load_arrays(path)
    if missing := [name for name in names if name not in arrays]:
        raise InputError(f"{path}: expected the arrays {', '.join(names)}, found no {missing[0]}; run again.")
    return arrays


def _series(version: str) -> list[str]:
    return version.split(".")[:2]
