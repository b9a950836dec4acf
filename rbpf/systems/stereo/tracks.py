"""Feature tracks over all pairs, from odometry and map together, for batch adjustment.

Odometry matches features of two consecutive pairs, the map those of distant pairs. Every pixel that either of them used is
one observation of one track, however often the run used it.
"""

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import NULL
from rbpf.errors import InputError
from rbpf.sensors.feature_log import FeatureFrame

LEAST = 2  #: Least observations of a track: a single one does not constrain the path.


def tracked_features(
    stamps_ns: np.ndarray, measured: Iterable[bool], observed: Iterable[Mapping[str, np.ndarray]]
) -> list[FeatureFrame]:
    """The observations of each of T pairs; tracks in the map have the map's names, others get further numbers.

    `measured` is the column of `StereoSlam`, `observed` the features of each pair.
    """
    tracks = _Tracks()
    for step, (is_measured, shown) in enumerate(zip(measured, observed, strict=True)):
        if is_measured:
            tracks.add(step, shown)
    rows, numbers = np.concatenate(tracks.rows), np.concatenate(tracks.numbers)
    label = tracks.labels(rows)[rows[:, 1]]
    _, index, counts = np.unique(label, return_inverse=True, return_counts=True)
    order = np.lexsort((label, rows[:, 0]))
    order = order[(counts[index] >= LEAST)[order]]
    cuts = np.searchsorted(rows[order, 0], np.arange(1, len(stamps_ns)))
    columns = label[order], numbers[order, :3], gaussian.unpack(numbers[order, 3:], 3)
    parts = zip(stamps_ns.tolist(), *(np.split(column, cuts) for column in columns), strict=True)
    return [FeatureFrame(*part) for part in parts]


@final
class _Tracks:
    """The tracks of the pairs so far, and pairs of tracks to be merged."""

    def __init__(self) -> None:
        # Of each observation the numbers of its pair and its track, (k, 2), and its pixels and packed covariance, (k, 9).
        self.rows, self.numbers = [np.zeros((0, 2), dtype=np.int64)], [np.zeros((0, 9))]
        self._named: dict[int, int] = {}
        self._joined: list[tuple[int, int]] = []
        self._count, self._step = 0, -1
        self._last = np.zeros(0, dtype=np.int64), np.zeros((0, 9))

    def add(self, step: int, shown: Mapping[str, np.ndarray]) -> None:
        """Adds the next measured pair."""
        numbers = np.concatenate([shown["z"], gaussian.pack(shown["cov_z"])], axis=1)
        tracks = np.full(len(numbers), NULL, dtype=np.int64)
        previous = shown["previous"]
        matched = np.argsort(previous, kind="stable")[(previous < 0).sum() :]
        # Continue tracks from the last pair; features without a track there start one in it.
        before, (last_tracks, last_numbers) = previous[matched], self._last
        if before.max(initial=-1) >= last_tracks.size:
            raise InputError("the run's log is damaged: a feature is matched to one that the previous pair lacks")
        fresh = before[last_tracks[before] < 0]
        last_tracks[fresh] = self._begin(fresh.size)
        self._append(self._step, last_tracks[fresh], last_numbers[fresh])
        tracks[matched] = last_tracks[before]
        # Tracks by the map's landmarks; if odometry gives another one, both are merged.
        present, names = set(tracks.tolist()), shown["landmarks"]
        for row in np.flatnonzero(names >= 0).tolist():
            track, name = int(tracks[row]), int(names[row])
            known = self._named.get(name)
            if track < 0:
                track = known if known is not None and known not in present else int(self._begin(1)[0])
                tracks[row] = track
                present.add(track)
            elif known is not None and known != track:
                self._joined.append((known, track))
            if known is None:
                self._named[name] = track
        seen = tracks >= 0
        self._append(step, tracks[seen], numbers[seen])
        self._step, self._last = step, (tracks, numbers)

    def labels(self, rows: np.ndarray) -> np.ndarray:
        """The name of each track after merging, which excludes tracks observed in the same pair."""
        parent = np.arange(self._count)
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
        roots = [_root(parent, track) for track in range(self._count)]
        return np.array([name_of.get(root, first + root) for root in roots], dtype=np.int64)

    def _begin(self, count: int) -> np.ndarray:
        self._count += count
        return np.arange(self._count - count, self._count)

    def _append(self, step: int, tracks: np.ndarray, numbers: np.ndarray) -> None:
        self.rows.append(np.stack([np.full(tracks.size, step, dtype=np.int64), tracks], axis=1))
        self.numbers.append(numbers)


def _root(parent: np.ndarray, track: int) -> int:
    while parent[track] != track:
        track = int(parent[track])
    return track
