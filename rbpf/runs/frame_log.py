"""What a run remembers of every frame: columns of numbers, and what each frame showed.

The columns are those that every system has, below, and the system's own (`System.columns`, `System.observed`). A
system declares a column once, with name, unit, shape and meaning; tables, checkpoints, data frames and the report
follow from that.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np

from rbpf.core.checkpoint import elements, integers, numbers, read, split
from rbpf.errors import InputError
from rbpf.systems.system import DIAGNOSTICS, TIMINGS, Column, System, Tracked, TrackingState

#: Columns of every system; times are written in milliseconds.
COMMON = (
    Column("seconds", "time that the system took, without reading and decoding", "s", table=TIMINGS),
    Column("state", "state of tracking, as its place in `TrackingState`", kind=int),
)

#: Likewise; written where a system has a name for it (`System.waiting`).
WAITING = Column("seconds_waiting", "time until the frame was read and decoded", "s")
_STATES = list(TrackingState)


@final
class FrameLog:
    """One row per frame that a system takes.

    `log["ess"]` is a column (T, …); `log.poses`, `log.covs` and `log.stamps_ns` are the path as it is known now;
    `log.observed(t)` is what frame t showed.
    """

    def __init__(self, system: System) -> None:
        self.space, self.ragged = system.space, tuple(system.observed)
        waiting = replace(WAITING, table=None if system.waiting is None else TIMINGS, heading=system.waiting)
        self.columns = (*COMMON, *system.columns, waiting)
        self._path: dict[str, list[Any]] = {"stamps_ns": [], "poses": [], "covs": []}
        self._rows: dict[str, list[Any]] = {column.name: [] for column in self.columns}
        self._observed: dict[str, list[np.ndarray]] = {field.name: [] for field in self.ragged}

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
        """(T, E) world_from_body: filtered means, revised ones where the system has revised them."""
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
        """(T,) bool, whether the system said that it was lost."""
        return np.array([state is TrackingState.LOST for state in self.states], dtype=bool)

    def observed(self, t: int) -> dict[str, np.ndarray]:
        """What frame t showed, arrays by name."""
        return {name: frames[t] for name, frames in self._observed.items()}

    def append(self, tracked: Tracked, seconds: float, waiting: float = 0.0) -> None:
        own = {"seconds": seconds, "seconds_waiting": waiting, "state": _STATES.index(tracked.state)}
        for name, values in self._rows.items():
            values.append(own[name] if name in own else tracked.values[name])
        for field in self.ragged:
            rows = np.asarray(tracked.observed[field.name], dtype=field.kind)
            self._observed[field.name].append(rows.reshape(-1, *field.shape))
        for name, value in zip(self._path, (tracked.stamp_ns, tracked.pose, tracked.cov), strict=True):
            self._path[name].append(value)
        revision = tracked.revision
        if revision is not None:
            first = len(self) - len(revision.poses)
            self._path["poses"][first:] = list(revision.poses)
            self._path["covs"][first:] = list(revision.covs)

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
        for field in self.ragged:
            frames = self._observed[field.name]
            empty = np.zeros((0, *field.shape), dtype=field.kind)
            out[f"observed/{field.name}"] = np.concatenate([empty, *frames])
            out[f"observed/{field.name}/counts"] = np.array([len(rows) for rows in frames], dtype=np.int64)
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
        for field in self.ragged:
            entries = {
                f"{field.name}/counts": integers("frames", least=0),
                field.name: numbers("rows", *field.shape, dtype=field.kind, values="any"),
            }
            counts, rows = read(arrays, entries, "observed/", frames=len(self)).values()
            if field.per and counts.tolist() != [len(each) for each in self._observed[field.per]]:
                raise InputError(f"the array observed/{field.name} has other rows than observed/{field.per}")
            self._observed[field.name] = split(rows, counts.tolist(), f"observed/{field.name}")
