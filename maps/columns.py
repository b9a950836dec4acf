"""What a store knows of each of its columns, in tables that hold those alive and no others."""

from typing import final

import numpy as np

from rbpf.core.archive import checked
from rbpf.errors import InputError

_FIRST_ROWS = 64


@final
class Columns:
    """Tables of columns, which come and go; ids ascend and are never used again.

    Memory and time follow the columns that are held, not those that ever were: a filter may run for ever in a world
    that changes. Row r of every table is the column with the r-th id.
    """

    def __init__(self) -> None:
        self.count = 0
        """Columns held."""
        self.started = 0
        """Columns ever added."""
        self._ids = np.zeros(_FIRST_ROWS, dtype=np.int64)
        self.fields = np.zeros(_FIRST_ROWS, dtype=np.int64)
        self.slab = np.full(_FIRST_ROWS, -1)
        self.generation = np.zeros(_FIRST_ROWS, dtype=np.int64)
        self.kind = np.full(_FIRST_ROWS, -1)

    @property
    def ids(self) -> np.ndarray:
        """(M,) of the columns held, ascending."""
        return self._ids[: self.count]

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Rows (K,) of columns (K,), which must be held."""
        if self.count == self.started:
            return ids
        return self.ids.searchsorted(ids)

    def row(self, column: int) -> int:
        """Row of one column, which must be held."""
        return column if self.count == self.started else int(self.ids.searchsorted(column))

    def held(self, ids: np.ndarray) -> np.ndarray:
        """Whether each of some ids (K,) is that of a column held, (K,) bool."""
        if not self.count:
            return np.zeros(ids.shape, dtype=bool)
        rows = np.minimum(self.ids.searchsorted(ids), self.count - 1)
        return np.asarray(self.ids[rows] == ids)

    def kinds(self, ids: np.ndarray) -> np.ndarray:
        """What `kind` says of each of some ids (K,), −1 where there is no such column."""
        if not self.count:
            return np.full(ids.shape, -1)
        rows = np.minimum(self.ids.searchsorted(ids), self.count - 1)
        return np.where(self.ids[rows] == ids, self.kind[rows], -1)

    def add(self) -> int:
        """Makes room for a new column and returns its id."""
        if self.count == self._ids.size:
            for name, table in self._tables().items():
                setattr(self, name, np.concatenate([table, np.zeros_like(table)]))
        row = self.count
        self._ids[row], self.slab[row], self.kind[row] = self.started, -1, -1
        self.count, self.started = self.count + 1, self.started + 1
        return self.started - 1

    def remove(self, ids: np.ndarray) -> None:
        """Drops columns (K,), which must be held, each once; gives memory back when three quarters are empty."""
        if not ids.size:
            return
        gone = self.rows(ids)
        first, count = int(gone.min()), self.count - ids.size
        kept = np.delete(np.arange(first, self.count), gone - first)
        room = self._ids.size
        while room > max(_FIRST_ROWS, 4 * count):
            room //= 2
        for name, table in self._tables().items():
            table[first:count] = table[kept]
            if room < table.size:
                setattr(self, name, table[:room].copy())
        self.count = count

    def restore(self, ids: np.ndarray, started: int) -> None:
        """Holds the columns (M,) and no others; their tables have to be filled again.

        Raises:
            InputError: the ids do not ascend, or one is not below `started`.
        """
        ids = checked({"ids": ids}, "ids", (None,), "i")
        if (np.diff(ids, prepend=-1) <= 0).any() or (ids.size and ids[-1] >= started):
            raise InputError("the landmarks' ids do not ascend")
        room = max(_FIRST_ROWS, 2 * ids.size)
        for name, table in self._tables().items():
            setattr(self, name, np.zeros(room, dtype=table.dtype))
        self.slab[:], self.kind[:] = -1, -1
        self._ids[: ids.size] = ids
        self.count, self.started = ids.size, started

    def _tables(self) -> dict[str, np.ndarray]:
        names = ("_ids", "fields", "slab", "generation", "kind")
        return {name: getattr(self, name) for name in names}
