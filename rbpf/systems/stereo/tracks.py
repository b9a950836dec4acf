"""Which features of which pairs are one point in space, by odometry and map together: what a batch adjustment needs.

Odometry says which features of two pairs are the same, the map which features of distant pairs are. Every pixel that
either of them used is one sighting of one track, however often the run used it.
"""

from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import NULL
from rbpf.sensors.feature_log import FeatureFrame

LEAST = 2
"""Sightings of a track that is told: a single one says nothing about the path."""


@final
class Tracks:
    """The tracks of all pairs so far."""

    def __init__(self) -> None:
        self._rows: list[np.ndarray] = []
        self._numbers: list[np.ndarray] = []
        self._named: dict[int, int] = {}
        self._joined: list[tuple[int, int]] = []
        self._next = 0
        self._step = -1
        self._last = np.zeros(0, dtype=np.int64), np.zeros((0, 9))

    def note(
        self,
        step: int,
        z: np.ndarray,
        cov: np.ndarray,
        matches: tuple[np.ndarray, np.ndarray],
        names: np.ndarray,
    ) -> None:
        """A pair is what the next one will be matched with.

        Args:
            step: its number.
            z: (K, 3) its features, px.
            cov: (K, 3, 3) px².
            matches: rows of the last pair noted and of this one that are the same point by odometry, (M,) each.
            names: (K,) of the map's landmarks; NULL where a feature is none.
        """
        numbers = np.concatenate([z, gaussian.pack(cov)], axis=1)
        ids = np.full(len(z), NULL, dtype=np.int64)
        ids[matches[1]] = self._continued(matches[0])
        self._name(ids, names)
        seen = ids >= 0
        self._append(step, ids[seen], numbers[seen])
        self._step, self._last = step, (ids, numbers)

    def frames(self, stamps_ns: np.ndarray) -> list[FeatureFrame]:
        """The sightings of each pair, of stamps (T,); a track of the map has the map's name, others follow on."""
        rows, numbers = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 9))
        if self._rows:
            rows, numbers = np.concatenate(self._rows), np.concatenate(self._numbers)
        label = self._labels(rows)[rows[:, 1]] if len(rows) else rows[:, 1]
        _, index, counts = np.unique(label, return_inverse=True, return_counts=True)
        order = np.lexsort((label, rows[:, 0]))
        order = order[(counts[index] >= LEAST)[order]]
        cuts = np.searchsorted(rows[order, 0], np.arange(1, len(stamps_ns)))
        columns = label[order], numbers[order, :3], gaussian.unpack(numbers[order, 3:], 3)
        parts = zip(stamps_ns.tolist(), *(np.split(column, cuts) for column in columns), strict=True)
        return [FeatureFrame(*part) for part in parts]

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {
            "tracks/rows": np.concatenate([np.zeros((0, 2), dtype=np.int64), *self._rows]),
            "tracks/numbers": np.concatenate([np.zeros((0, 9)), *self._numbers]),
            "tracks/named": np.array(list(self._named.items()), dtype=np.int64).reshape(-1, 2),
            "tracks/joined": np.array(self._joined, dtype=np.int64).reshape(-1, 2),
            "tracks/counts": np.array([self._next, self._step]),
            "tracks/last": self._last[0],
            "tracks/last_numbers": self._last[1],
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self._rows, self._numbers = [arrays["tracks/rows"].copy()], [arrays["tracks/numbers"].copy()]
        self._named = {int(name): int(track) for name, track in arrays["tracks/named"]}
        self._joined = [(int(one), int(other)) for one, other in arrays["tracks/joined"]]
        self._next, self._step = (int(x) for x in arrays["tracks/counts"])
        self._last = arrays["tracks/last"].copy(), arrays["tracks/last_numbers"].copy()

    def _continued(self, before: np.ndarray) -> np.ndarray:
        """Tracks of rows of the last pair; those that have none yet begin there."""
        ids, numbers = self._last
        fresh = before[ids[before] < 0]
        ids[fresh] = self._begin(fresh.size)
        self._append(self._step, ids[fresh], numbers[fresh])
        return ids[before]

    def _name(self, ids: np.ndarray, names: np.ndarray) -> None:
        """Fills in the tracks (K,) of features that the map names; where odometry says another one, both are joined."""
        present = set(ids.tolist())
        for row in np.flatnonzero(names >= 0).tolist():
            track, name = int(ids[row]), int(names[row])
            known = self._named.get(name)
            if track < 0:
                track = known if known is not None and known not in present else int(self._begin(1)[0])
                ids[row] = track
                present.add(track)
            elif known is not None and known != track:
                self._joined.append((known, track))
            if known is None:
                self._named[name] = track

    def _begin(self, count: int) -> np.ndarray:
        self._next += count
        return np.arange(self._next - count, self._next)

    def _append(self, step: int, ids: np.ndarray, numbers: np.ndarray) -> None:
        self._rows.append(np.stack([np.full(ids.size, step, dtype=np.int64), ids], axis=1))
        self._numbers.append(numbers)

    def _labels(self, rows: np.ndarray) -> np.ndarray:
        """What each track is called once those that are one have been joined, unless one pair shows both."""
        parent = np.arange(self._next)
        name_of = {track: name for name, track in self._named.items()}
        concerned = {track for pair in self._joined for track in pair}
        steps: dict[int, set[int]] = {track: set() for track in concerned}
        for step, track in rows[np.isin(rows[:, 1], list(concerned))].tolist():
            steps[track].add(step)
        for pair in self._joined:
            one, other = (_root(parent, track) for track in pair)
            if one == other or (one in name_of and other in name_of) or steps[one] & steps[other]:
                continue
            keep, gone = (other, one) if other in name_of else (one, other)
            parent[gone] = keep
            steps[keep] |= steps[gone]
        first = max(self._named, default=-1) + 1
        roots = np.array([_root(parent, track) for track in range(self._next)], dtype=np.int64)
        return np.array([name_of.get(root, first + root) for root in roots.tolist()], dtype=np.int64)


def _root(parent: np.ndarray, track: int) -> int:
    while parent[track] != track:
        track = int(parent[track])
    return track
