"""What features look like, and how often they were found: facts that do not differ between particles."""

from dataclasses import dataclass, fields
from typing import final

import numpy as np

from rbpf.core.archive import checked

SOURCE_HALF_PX = 15
"""The window that is kept of a first sighting reaches this far from its centre: enough to be turned and shrunk."""


@dataclass
class _Rows:
    """One row per feature ever started.

    Attributes:
        source: (F, S, S) uint8 window around the first sighting.
        last_source: (F, S, S) uint8 window around a later one, from where it looked different; else the first.
        first_px: (F, 2) where that was.
        first_pose: (F, 7) world_from_camera of the first sighting, in the mode's world.
        last_pose: (F, 7) likewise of the later one.
        place: (F, 4) homogeneous point in the mode's world at the last sighting.
        attempts: (F,) times looked for.
        found: (F,) times found.
        missed: (F,) times not found in a row.
        alive: (F,) whether the map still holds it.
        member: (F,) its number among the known points, or −1.
    """

    source: np.ndarray
    last_source: np.ndarray
    first_px: np.ndarray
    first_pose: np.ndarray
    last_pose: np.ndarray
    place: np.ndarray
    attempts: np.ndarray
    found: np.ndarray
    missed: np.ndarray
    alive: np.ndarray
    member: np.ndarray


@final
class Appearances:
    """A growing table of features."""

    def __init__(self) -> None:
        size = 2 * SOURCE_HALF_PX + 1
        self._rows = _Rows(
            np.zeros((0, size, size), dtype=np.uint8),
            np.zeros((0, size, size), dtype=np.uint8),
            np.zeros((0, 2)),
            np.zeros((0, 7)),
            np.zeros((0, 7)),
            np.zeros((0, 4)),
            np.zeros(0, dtype=np.int64),
            np.zeros(0, dtype=np.int64),
            np.zeros(0, dtype=np.int64),
            np.zeros(0, dtype=bool),
            np.zeros(0, dtype=np.int64),
        )
        self.count = 0

    def __getattr__(self, name: str) -> np.ndarray:
        """Columns of the rows in use, as views."""
        if name.startswith("_"):
            raise AttributeError(name)
        column: np.ndarray = getattr(self._rows, name)[: self.count]
        return column

    def add(
        self, source: np.ndarray, px: np.ndarray, pose: np.ndarray, member: np.ndarray | None = None
    ) -> np.ndarray:
        """Starts k features seen at px (k, 2) from one pose (7,), with windows (k, S, S); returns their rows."""
        k = px.shape[0]
        self._reserve(self.count + k)
        rows = np.arange(self.count, self.count + k)
        self.count += k
        self.source[rows], self.first_px[rows], self.first_pose[rows] = source, px, pose
        self.last_source[rows], self.last_pose[rows] = source, pose
        self.attempts[rows], self.found[rows], self.alive[rows] = 1, 1, True
        self.member[rows] = -1 if member is None else member
        return rows

    def found_fraction(self, rows: np.ndarray) -> np.ndarray:
        """Share (k,) of the looks for features (k,) that found them, as expected after these looks (P. Laplace)."""
        return np.asarray((self.found[rows] + 1.0) / (self.attempts[rows] + 2.0))

    def note(self, rows: np.ndarray, found: np.ndarray) -> None:
        """Counts a search for features (k,) that were found or not (k,) bool."""
        self.attempts[rows] += 1
        self.found[rows] += found
        self.missed[rows] = np.where(found, 0, self.missed[rows] + 1)

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {f"appearance/{item.name}": getattr(self, item.name) for item in fields(_Rows)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        count = checked(arrays, "appearance/alive", (None,), "b").size
        columns = []
        for item in fields(_Rows):
            empty = getattr(self._rows, item.name)[:0]
            name, shape = f"appearance/{item.name}", (count, *empty.shape[1:])
            columns.append(checked(arrays, name, shape, empty.dtype.kind).astype(empty.dtype))
        self._rows, self.count = _Rows(*columns), count

    def _reserve(self, count: int) -> None:
        room = self._rows.alive.size
        if count <= room:
            return
        extra = max(count, 2 * room, 64) - room
        for item in fields(_Rows):
            column = getattr(self._rows, item.name)
            grown = np.concatenate([column, np.zeros((extra, *column.shape[1:]), dtype=column.dtype)])
            setattr(self._rows, item.name, grown)
