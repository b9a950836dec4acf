"""Reads the run folder of any system, for plots, comparisons and reports.

Parts are read lazily, so that a folder with a missing one still has the others. Missing and damaged files, and those of
another version, raise an InputError.
"""

import csv
import json
from dataclasses import dataclass, replace
from functools import cached_property
from io import StringIO
from pathlib import Path
from typing import Any, Self, final

import numpy as np
from numpy.typing import NDArray

from rbpf.core.checkpoint import Schema, fitting, integers, load_arrays, numbers, read
from rbpf.errors import InputError, printable
from rbpf.lie import SE2, SE3, Array, SE2Group, SE3Group
from rbpf.maps.grid import Picture
from rbpf.runs.files import GRID, MAP, TRAJECTORY, VERSION
from rbpf.runs.measurement_files import read_measurements
from rbpf.runs.provenance import read_config, require_own_version
from rbpf.runs.run import Run
from rbpf.runs.trajectory import Trajectory, in_space
from rbpf.runs.truth import RunTruth, read_truth
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.measurements import Measurements
from rbpf.sensors.readers.text import read_text
from rbpf.systems.map_estimate import MapEstimate

_PATH = {"stamps_ns": integers("frames"), "mean": numbers("frames", "size"), "cov": numbers("frames", "dim", "dim")}
_MOVED = numbers("frames", "r", values="any"), numbers("frames", "r", "r", values="any")
_CORRECTIONS = dict(zip(("correction", "cov_correction"), _MOVED, strict=True))
_MAP = {
    "id": integers("landmarks"),
    "mean": numbers("landmarks", "axes", values="any"),
    "cov": numbers("landmarks", "axes", "axes", values="any"),
    "ray_ends": numbers("landmarks", 2, 3, values="any"),
}
_NO_LANDMARKS = MapEstimate(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))
_GRID = {"log_odds": numbers("rows", "columns"), "cell_m": numbers(), "corner": numbers(2)}
_PARTICLES = {"particles": numbers("particles", "size"), "weights": numbers("particles", least=0)}


@final
@dataclass(frozen=True, eq=False)
class PathAndMap:
    """T poses in SE2 or SE3 and M landmarks."""

    stamps_ns: NDArray[np.int64]  #: (T,).
    world_from_body: Array  #: (T, E).
    cov_poses: Array  #: (T, d, d) in the right chart at each pose, order [ω, v]; no rows if unknown.
    landmarks: MapEstimate = _NO_LANDMARKS  #: those that are points; empty for a path alone.

    @classmethod
    def of_run(cls, run: Run) -> "PathAndMap":
        """The online filtered poses of a run, and its last map."""
        return cls(run.log.stamps_ns, run.log.poses, run.log.covs, run.system.map().points())

    @property
    def space(self) -> SE2Group | SE3Group:
        return SE2 if self.world_from_body.shape[1] == SE2.size else SE3

    @property
    def trajectory(self) -> Trajectory:
        """The poses in space."""
        return in_space(self.stamps_ns, self.world_from_body)

    def at(self, rows: NDArray[np.intp]) -> "PathAndMap":
        """A subset of the poses, with all landmarks."""
        covs = self.cov_poses[rows] if len(self.cov_poses) else self.cov_poses
        return PathAndMap(self.stamps_ns[rows], self.world_from_body[rows], covs, self.landmarks)


@dataclass(frozen=True, repr=False)
class RunFolder:
    """A run folder, with the entries of its config.yaml and of its summary.json."""

    folder: Path
    config: dict[str, Any]
    summary: dict[str, Any]

    @classmethod
    def open(cls, folder: Path | str) -> Self:
        """Opens a run folder."""
        folder = Path(folder)
        if not folder.is_dir():
            raise InputError(f"{folder}: expected the folder of a run, there is no such folder")
        for name in ("config.yaml", "summary.json"):
            if not (folder / name).is_file():
                raise InputError(f"{folder} has no {name}: expected the folder that a finished `rbpf run` left")
        config, path = read_config(folder), folder / "summary.json"
        try:
            summary = json.loads(read_text(path))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path} is damaged: {' '.join(str(error).split())}") from error
        if not isinstance(summary, dict):
            raise InputError(f"{path} is damaged: expected names with values")
        for name in ("remarks", "problems"):
            if not isinstance(summary.get(name, []), list):
                raise InputError(f"{path} is damaged: expected a list of sentences as {name}, got {summary[name]!r}")
        return cls(folder, config, summary)

    @property
    def system(self) -> str:
        return str(self.config.get("system", ""))

    @property
    def name(self) -> str:
        """Of the recording."""
        return printable(str(self.summary.get("recording", self.folder.name)))

    @cached_property
    def path(self) -> PathAndMap:
        """The filtered poses, without landmarks."""
        file, again = self.folder / TRAJECTORY, f"repeat the run with --config {self.folder / 'config.yaml'}"
        if not file.is_file():
            raise InputError(f"{self.folder} has no {file.name}, which every finished run leaves; {again}")
        arrays = load_arrays(file)
        version = arrays.get("version", np.array(0))
        if version.shape or version.dtype.kind != "i" or int(version) != VERSION:
            raise InputError(f"{file} has version {version}, this program reads version {VERSION}; {again}")
        try:
            with fitting(file):
                stamps_ns, mean, cov = read(arrays, _PATH).values()
                if (mean.shape[1], cov.shape[1]) not in [(space.size, space.dim) for space in (SE2, SE3)]:
                    raise InputError("the poses are neither in the plane nor in space")
        except InputError as error:
            raise InputError(f"{file} does not hold the poses of a run ({error}); {again}") from error
        return PathAndMap(stamps_ns, mean, cov)

    @property
    def trajectory(self) -> Trajectory:
        """The online filtered path in space."""
        return self.path.trajectory

    @property
    def covariance(self) -> np.ndarray:
        """(T, d, d) of the poses in the right chart at each, [ω, v]."""
        return self.path.cov_poses

    @cached_property
    def corrections(self) -> tuple[Array, Array]:
        """Corrections (T, r) of the motions and their covariances (T, r, r); r = 0 if the system does not report them."""
        correction, cov = self._arrays(TRAJECTORY, _CORRECTIONS).values()
        return correction, cov

    @cached_property
    def truth(self) -> RunTruth:
        """The ground truth at the run's frames."""
        return read_truth(self.folder, *self.path.world_from_body.shape)

    @cached_property
    def map(self) -> MapEstimate:
        """All landmarks, with the system's columns; `map.points()` are those of known depth."""
        file = self.folder / MAP
        if not file.exists():
            raise InputError(f"{self.folder} holds no {MAP}: expected the folder of a finished run.")
        arrays = load_arrays(file)
        with fitting(file):
            more = [name for name in arrays if name not in _MAP]
            columns = {name: numbers("landmarks", values="any", dtype=arrays[name].dtype) for name in more}
            held = {name: entry for name, entry in _MAP.items() if name in arrays or name != "ray_ends"}
            found = read(arrays, held | columns)
            if found["mean"].shape[1] not in (2, 3):
                raise InputError("the points are neither in the plane nor in space")
        ids, mean, cov = (found.pop(name) for name in ("id", "mean", "cov"))
        return MapEstimate(ids, mean, cov, ray_ends=found.pop("ray_ends", None), columns=found)

    @cached_property
    def grid(self) -> Picture:
        """The occupancy grid of a laser scanner's run."""
        found = self._arrays(GRID, _GRID)
        return Picture(found["log_odds"], float(found["cell_m"]), found["corner"])

    @cached_property
    def particles(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses (N, E) of the last frame's particles in the reported world, and their weights (N,)."""
        poses, weights = self._arrays(TRAJECTORY, _PARTICLES, size=self.path.space.size).values()
        return poses, weights

    def _arrays(self, name: str, schema: Schema, **sizes: int) -> dict[str, np.ndarray]:
        arrays = load_arrays(self.folder / name)
        with fitting(self.folder / name):
            return read(arrays, schema, "", **sizes)

    @cached_property
    def measurements(self) -> FeatureLog | Measurements:
        """The measurements used by the run."""
        return read_measurements(self.folder)

    @property
    def estimate(self) -> PathAndMap:
        """Poses and point landmarks, with their covariances; only for a run of this version."""
        require_own_version(self.config, self.folder)
        return replace(self.path, landmarks=self.map.points())

    def table(self, name: str, *needed: str) -> dict[str, np.ndarray]:
        """A table of numbers by its columns' names, with those `needed`: diagnostics.csv, timings.csv."""
        path = self.folder / name
        rows = list(csv.reader(StringIO(read_text(path))))
        if len(rows) < 2 or any(len(row) != len(rows[0]) for row in rows):
            raise InputError(f"{path}: expected a header, and rows of as many cells below it")
        if missing := [column for column in needed if column not in rows[0]]:
            raise InputError(f"{path}: expected a table with the columns {', '.join(needed)}, found no {missing[0]}")
        try:
            values = np.array(rows[1:], dtype=float).reshape(len(rows) - 1, len(rows[0]))
        except ValueError as error:
            raise InputError(f"{path}: expected numbers below the header: {error}") from error
        return dict(zip(rows[0], values.T, strict=True))
