"""What every SLAM system is: an object that processes one frame at a time and returns its estimate.

    slam = MonoSlam(camera, config)
    for stamp_ns, image in source:
        frame = slam.track(image, stamp_ns)      # pose, covariance, state of tracking, what was observed

A system does not know the source of its frames or their number, and keeps only the state it needs to continue. Records of a
run, pictures and files are made from what `track` returns (`FrameLog`, `rbpf.runs`).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import numpy as np

from rbpf.arrays import Float, Int
from rbpf.core.checkpoint import BEYOND, elements, fitting, integers, numbers, read, split
from rbpf.core.filter import Filter, StepReport
from rbpf.core.models import Conditional, Map, MotionModel, Part, Proposal, Sensor
from rbpf.core.resampling import Consolidation
from rbpf.errors import InputError
from rbpf.lie import SE2Group, SE3Group
from rbpf.maps.joint_map import JointMap
from rbpf.ranges import require_memory
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.measurements import Measurements
from rbpf.systems.filtering import RunConfig
from rbpf.systems.map_estimate import MapEstimate

#: Name under which `System.restore` gets the ids (M,) of the restored map's landmarks.
MAP_IDS = "map/ids"
#: Frames of the particles' paths kept if neither the settings nor a recording's length define it.
LAG = 150
#: Relation of a system's world to that of the ground truth: identical; starting at the first frame's pose; equal up to a
#: rigid motion; equal up to a similarity.
Gauge = Literal["none", "first frame", "rigid", "similarity"]


class TrackingState(StrEnum):
    """Whether the pose of a frame can be relied on."""

    #: There is a pose, but poses may still be revised: scale or initial depths have not converged.
    INITIALISING = "initialising"
    TRACKED = "tracked"  #: The frame was measured and is consistent with the map.
    #: The frame had too little information: the pose is predicted by the motion model or odometry.
    PREDICTED = "predicted"
    #: The frame was measured, but the camera could not be localised in the map: the pose is the last trusted one, or
    #: extrapolated from it.
    LOST = "lost"


@dataclass(frozen=True)
class Column:
    """A scalar, or an array of fixed shape, that a system reports for every frame."""

    name: str  #: key in `Tracked.values` and in the log of a run.
    meaning: str  #: one sentence, for documentation and the report.
    unit: str = ""  #: SI, as "s" or "px"; empty for pure numbers.
    kind: type = float  #: float, int or bool.
    shape: tuple[int, ...] = ()  #: of the value of one frame.
    #: file of the run folder with this column, "diagnostics.csv" or "timings.csv"; None for neither.
    table: str | None = None
    heading: str | None = None  #: column heading there; by default `name`. Times are written in milliseconds.


DIAGNOSTICS = "diagnostics.csv"
TIMINGS = "timings.csv"

ESS = Column("ess", "effective sample size before resampling", table=DIAGNOSTICS)
RESAMPLED = Column("resampled", "whether the particles were resampled", kind=bool, table=DIAGNOSTICS)
LOG_EVIDENCE = Column(
    "log_evidence", "increment of the log-evidence; NaN where it is not defined", "nat", table=DIAGNOSTICS
)
NIS = Column("nis", "normalised innovation squared; NaN without a linearised innovation", table=DIAGNOSTICS)
NIS_DOF = Column("nis_dof", "its degrees of freedom, a weighted mean over the particles", table=DIAGNOSTICS)
FILTER_COLUMNS = ESS, RESAMPLED, LOG_EVIDENCE, NIS, NIS_DOF


def filter_values(report: StepReport) -> dict[str, Any]:
    """Values of `FILTER_COLUMNS` after a step."""
    names = (column.name for column in FILTER_COLUMNS)
    values = report.ess, report.resampled, report.log_evidence, report.nis, report.rows
    return dict(zip(names, values, strict=True))


def timing(name: str, meaning: str, heading: str) -> Column:
    """The column of a part of a frame's processing time."""
    return Column(name, meaning, "s", table=TIMINGS, heading=heading)


@dataclass(frozen=True)
class Ragged:
    """An array per frame with a variable number of rows, such as one per feature."""

    name: str  #: key in `Tracked.observed`.
    meaning: str  #: one sentence.
    shape: tuple[int, ...] = ()  #: of one row.
    kind: str = "float64"  #: NumPy type in which it is stored.
    per: str | None = None  #: name of another array with the same number of rows in each frame, or None.


@dataclass(frozen=True, eq=False)
class Revision:
    """Re-estimated poses of all frames up to the current one: world_from_body (T, E), cov in the chart at each."""

    stamps_ns: Int[np.ndarray, " T"]
    poses: Float[np.ndarray, "T E"]
    covs: Float[np.ndarray, "T d d"]


@dataclass(frozen=True, eq=False)
class Tracked:
    """A system's result for a frame."""

    stamp_ns: int  #: time of the frame.
    #: (E,) world_from_body, the mean of the filtered posterior; the body is the camera or the robot.
    pose: Float[np.ndarray, " E"]
    cov: Float[np.ndarray, "d d"]  #: (d, d) its covariance in the right chart at the mean, [ω, v], rad and m.
    state: TrackingState  #: whether the pose can be relied on.
    values: Mapping[str, Any] = field(default_factory=dict)  #: the system's columns for this frame, by name.
    #: searched and observed features, arrays by name, see `System.observed`.
    observed: Mapping[str, np.ndarray] = field(default_factory=dict)
    messages: tuple[str, ...] = ()  #: warnings and remarks.
    revision: Revision | None = None  #: earlier poses changed by this frame, or None.


#: Columns of every system; times are written in milliseconds.
COMMON = (
    Column("seconds", "time that the system took, without reading and decoding", "s", table=TIMINGS),
    Column("state", "state of tracking, as its index in `TrackingState`", kind=int),
)

#: Likewise; written if a system has a name for it (`System.waiting`).
WAITING = Column("seconds_waiting", "time until the frame was read and decoded", "s")
_STATES = list(TrackingState)


@final
class FrameLog:
    """The record of all frames of a run: a row of the columns per frame, and the observed features.

    `log["ess"]` is a column (T, …); `log.poses`, `log.covs` and `log.stamps_ns` are the path with all revisions;
    `log.observed(t)` has the features of frame t.
    """

    def __init__(self, system: "System") -> None:
        self.space, self.ragged = system.space, tuple(system.observed)
        waiting = replace(WAITING, table=None if system.waiting is None else TIMINGS, heading=system.waiting)
        self.columns = (*COMMON, *system.columns, waiting)
        self._path: dict[str, list[Any]] = {"stamps_ns": [], "poses": [], "covs": []}
        self._rows: dict[str, list[Any]] = {column.name: [] for column in self.columns}
        self._observed: dict[str, list[np.ndarray]] = {each.name: [] for each in self.ragged}

    def __len__(self) -> int:
        return len(self._path["stamps_ns"])

    def __getitem__(self, name: str) -> np.ndarray:
        column = next((column for column in self.columns if column.name == name), None)
        if column is None:
            raise KeyError(f"no column is called {name!r}: {', '.join(self._rows)}")
        return np.array(self._rows[name], dtype=column.kind).reshape(len(self), *column.shape)

    def __contains__(self, name: str) -> bool:
        return name in self._rows

    @property
    def stamps_ns(self) -> np.ndarray:
        return np.array(self._path["stamps_ns"], dtype=np.int64)

    @property
    def poses(self) -> np.ndarray:
        """(T, E) world_from_body: filtered means, or revised ones."""
        return np.array(self._path["poses"], dtype=float).reshape(len(self), self.space.size)

    @property
    def covs(self) -> np.ndarray:
        """(T, d, d) covariances of the poses in the right chart at each."""
        return np.array(self._path["covs"], dtype=float).reshape(len(self), self.space.dim, self.space.dim)

    @property
    def states(self) -> list[TrackingState]:
        """State of tracking after each frame."""
        return [_STATES[int(state)] for state in self._rows["state"]]

    def lost(self) -> np.ndarray:
        """(T,) bool, whether the system was lost."""
        return np.array([state is TrackingState.LOST for state in self.states], dtype=bool)

    def observed(self, t: int) -> dict[str, np.ndarray]:
        """The features of frame t, arrays by name."""
        return {name: frames[t] for name, frames in self._observed.items()}

    def append(self, tracked: Tracked, seconds: float, waiting: float = 0.0) -> None:
        own = {"seconds": seconds, "seconds_waiting": waiting, "state": _STATES.index(tracked.state)}
        for name, values in self._rows.items():
            values.append(own[name] if name in own else tracked.values[name])
        for each in self.ragged:
            rows = np.asarray(tracked.observed[each.name], dtype=each.kind)
            self._observed[each.name].append(rows.reshape(-1, *each.shape))
        for name, value in zip(self._path, (tracked.stamp_ns, tracked.pose, tracked.cov), strict=True):
            self._path[name].append(value)
        revision = tracked.revision
        if revision is not None:
            known = min(len(self), len(revision.poses))  # a log may start later
            self._path["poses"][-known:] = list(revision.poses[-known:])
            self._path["covs"][-known:] = list(revision.covs[-known:])

    def table(self, name: str) -> tuple[list[str], list[list[Any]]]:
        """A table of the run folder: its header, and its columns as plain numbers; times in milliseconds."""
        header, columns = ["step"], [list(range(len(self)))]
        if name == DIAGNOSTICS:
            header, columns = ["step", "stamp_ns"], [*columns, self._path["stamps_ns"]]
        for column in self.columns:
            if column.table != name:
                continue
            values = self[column.name]
            if name == TIMINGS:
                header.append("milliseconds" if column.name == "seconds" else column.heading or column.name)
                columns.append((1e3 * values).round(4).tolist())
            else:
                header.append(column.heading or column.name)
                columns.append((values.astype(int) if column.kind is bool else values).tolist())
        return header, columns

    def arrays(self) -> dict[str, np.ndarray]:
        out = {"log/stamps_ns": self.stamps_ns, "log/poses": self.poses, "log/covs": self.covs}
        out |= {f"log/{column.name}": self[column.name] for column in self.columns}
        for each in self.ragged:
            frames = self._observed[each.name]
            empty = np.zeros((0, *each.shape), dtype=each.kind)
            out[f"observed/{each.name}"] = np.concatenate([empty, *frames])
            out[f"observed/{each.name}/counts"] = np.array([len(rows) for rows in frames], dtype=np.int64)
        return out

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """The inverse of `arrays`, into an empty log of the same system; errors as `rbpf.core.checkpoint.read`."""
        dim = self.space.dim
        covs = numbers("frames", dim, dim)
        path = {"stamps_ns": integers("frames"), "poses": elements(self.space, "frames"), "covs": covs}
        columns = {c.name: numbers("frames", *c.shape, dtype=c.kind, values="any") for c in self.columns}
        columns["state"] = integers("frames", least=0, below="states")
        found = read(arrays, path | columns, "log/", states=len(_STATES))
        for held in (self._path, self._rows):
            held |= {name: list(found[name]) if found[name].ndim > 1 else found[name].tolist() for name in held}
        for each in self.ragged:
            entries = {
                f"{each.name}/counts": integers("frames", least=0),
                each.name: numbers("rows", *each.shape, dtype=each.kind, values="any"),
            }
            counts, rows = read(arrays, entries, "observed/", frames=len(self)).values()
            if each.per and counts.tolist() != [len(rows) for rows in self._observed[each.per]]:
                raise InputError(f"the array observed/{each.name} has other rows than observed/{each.per}")
            self._observed[each.name] = split(rows, counts.tolist(), f"observed/{each.name}")


class System(ABC):
    """A SLAM system. Subclasses add `track`, with the arguments of their sensor."""

    name: ClassVar[str]  #: as on the command line.
    frame_word: ClassVar[str] = "frame"  #: word for a frame in messages.
    #: name of the time until a frame was read and decoded in timings.csv; None omits it.
    waiting: ClassVar[str | None] = None
    columns: tuple[Column, ...]  #: what `Tracked.values` holds, in the order of the tables that are written.
    observed: tuple[Ragged, ...] = ()  #: what `Tracked.observed` holds.
    space: SE2Group | SE3Group  #: group of the poses.
    gauge: Gauge = "first frame"  #: relation of its world to that of the ground truth.
    config: RunConfig  #: all settings.
    filter: Filter  #: the current particle filter.
    recorded: bool = False  #: whether the frames have a known end, see `keep_paths`.

    @property
    def lag(self) -> int | None:
        """Frames of the particles' paths that are kept; None keeps all, only for recordings with a known end."""
        return LAG if self.config.lag is None and not self.recorded else self.config.lag

    def new_filter(
        self,
        motion: MotionModel,
        sensor: Sensor,
        parts: Sequence[Conditional],
        proposal: Proposal | None = None,
        window: int = 1,
    ) -> Filter:
        """The particle filter of the settings; a joint map, its first part, is consolidated after `window` steps."""
        config, is_joint, rng = self.config, isinstance(parts[0], JointMap), np.random.default_rng(self.config.seed)
        due = Consolidation(window, config.resampling.ess_threshold) if is_joint else None
        resampler, lag = config.resampling.build(), 1 if is_joint else self.lag
        return Filter(motion, sensor, parts, proposal, resampler, config.particles, rng, lag=lag, consolidation=due)

    def keep_paths(self, frames: int) -> None:
        """Announces the number of frames, so that the particles' whole paths are kept, unless the settings have a lag.

        Raises InputError: they would not fit into memory.
        """
        kept = frames if self.config.lag is None else min(frames, self.config.lag)
        if self.filter.consolidation is None:
            what = f"the paths of {self.filter.n} particles over {kept} {self.frame_word}s (lag keeps fewer)"
            require_memory(float(kept * self.filter.particles.state.nbytes), what)
            self.recorded = True
            self.filter.history.lag = self.lag

    def checked_stamp(self, stamp_ns: Any, last_ns: int | None = None) -> int:
        """A frame's time. Raises InputError: it is no whole number that a checkpoint holds, or is before `last_ns`."""
        if not (isinstance(stamp_ns, int | float | np.integer) and 0 <= stamp_ns < BEYOND and stamp_ns % 1 == 0):
            raise InputError(f"stamp_ns must be a whole number of nanoseconds from 0 to {BEYOND - 1}, got {stamp_ns!r}")
        if last_ns is not None and stamp_ns < last_ns:
            raise InputError(f"time runs backwards: a {self.frame_word} at {stamp_ns} ns after one at {last_ns} ns")
        return int(stamp_ns)

    @abstractmethod
    def take(self, frame: Any) -> Tracked:
        """`track` with a frame of a recording. Passes over frames without information; raises if no particle explains it."""

    @abstractmethod
    def map(self) -> MapEstimate:
        """The current landmarks, each a Gaussian (within + between particles), in the reported world."""

    @abstractmethod
    def measurements(self, name: str, log: FrameLog) -> FeatureLog | Measurements | None:
        """The measurements used, for a batch optimiser; landmarks are named as in `map`, `name` is the recording's."""

    @property
    def joint(self) -> JointMap | None:
        """The joint map; None while every particle has its own map."""
        held = self.filter.marginals.parts.get(Part.LANDMARK)
        return held if isinstance(held, JointMap) else None

    def particle_poses(self) -> np.ndarray:
        """(N, E) world_from_body of the current particles, in the reported world."""
        return self.filter.belief().map.world(self.filter.particles.state[:, : self.space.size])

    def summary(self, log: FrameLog) -> dict[str, Any]:
        """Further entries of a run's summary.json; they override common ones of the same name."""
        return {}

    def files(self, log: FrameLog) -> Mapping[str, dict[str, np.ndarray] | str]:
        """Further files of a run's folder by name, arrays by their own names or text."""
        return {}

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a checkpoint besides the filter's."""

    @abstractmethod
    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`, into a system built with the same arguments. Raises InputError: an array does not fit."""

    def save(self, path: Path | str, extra: Mapping[str, np.ndarray] | None = None) -> None:
        """Writes a checkpoint, after any frame, with further arrays of the caller's."""
        self.filter.save(path, self.arrays() | dict(extra or {}))

    def load(self, path: Path | str) -> dict[str, np.ndarray]:
        """Continues identically from a checkpoint; returns the arrays of `extra`, among others.

        Raises InputError: the file is missing or damaged, or belongs to another system or other settings.
        """
        arrays, held = self.filter.load(path), self.filter.marginals.parts.get(Part.LANDMARK)
        with fitting(Path(path)):
            if isinstance(held, Map):
                arrays[MAP_IDS] = held.all_ids if isinstance(held, JointMap) else held.ids
            self.restore(arrays)
        return arrays
