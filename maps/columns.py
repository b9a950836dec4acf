"""What a store knows of each of its columns, in tables that hold those alive and no others."""

from typing import final

import numpy as np

from rbpf.core.archive import checked
from rbpf.errors import InputError

_FIRST_ROWS = 64


@final
class Columns:
    """Tables of columns, which come and go, in the order in which they came.

    Memory and time follow the columns that are held, not those that ever were: a filter may run for ever in a world
    that changes. Row r of every table is the column with the r-th id. Ids are the caller's, or counted up from the
    largest that was ever used.
    """

    def __init__(self) -> None:
        self.count = 0
        """Columns held."""
        self.next_id = 0
        """One more than the largest id that was ever used."""
        self._ids = np.zeros(_FIRST_ROWS, dtype=np.int64)
        self._ascending = True
        """Whether the ids held ascend, as those that are counted up do."""
        self._sorted: tuple[np.ndarray, np.ndarray] | None = None
        """Where they do not: the ids ascending, and the rows of each; made when it is asked for."""
        self.fields = np.zeros(_FIRST_ROWS, dtype=np.int64)
        self.slab = np.full(_FIRST_ROWS, -1)
        self.generation = np.zeros(_FIRST_ROWS, dtype=np.int64)
        self.kind = np.full(_FIRST_ROWS, -1)

    @property
    def ids(self) -> np.ndarray:
        """(M,) of the columns held, in the order in which they were added."""
        return self._ids[: self.count]

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Rows (K,) of columns (K,), which must be held."""
        if not self._ascending:
            ascending, rows = self._by_id()
            return rows[ascending.searchsorted(ids)]
        # All ids from 0 up are their own rows.
        return ids if self.count == self.next_id else self.ids.searchsorted(ids)

    def row(self, column: int) -> int:
        """Row of one column, which must be held."""
        return int(self.rows(np.array(column)))

    def held(self, ids: np.ndarray) -> np.ndarray:
        """Whether each of some ids (K,) is that of a column held, (K,) bool."""
        return self._found(ids)[1]

    def kinds(self, ids: np.ndarray) -> np.ndarray:
        """What `kind` says of each of some ids (K,), −1 where there is no such column."""
        rows, held = self._found(ids)
        return np.where(held, self.kind[rows], -1)

    def _found(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (K,) of ids (K,), and whether they are held; the rows of others mean nothing."""
        if not self.count:
            return np.zeros(ids.shape, dtype=np.int64), np.zeros(ids.shape, dtype=bool)
        if self._ascending:
            rows = np.minimum(self.ids.searchsorted(ids), self.count - 1)
        else:
            ascending, order = self._by_id()
            rows = order[np.minimum(ascending.searchsorted(ids), self.count - 1)]
        return rows, np.asarray(self.ids[rows] == ids)

    def _by_id(self) -> tuple[np.ndarray, np.ndarray]:
        if self._sorted is None:
            order = self.ids.argsort(kind="stable")
            self._sorted = self.ids[order], order
        return self._sorted

    def add(self, column: int | None = None) -> int:
        """Makes room for a new column and returns its id: the one given, which must not be held, or the next one."""
        if self.count == self._ids.size:
            for name, table in self._tables().items():
                setattr(self, name, np.concatenate([table, np.zeros_like(table)]))
        row, column = self.count, self.next_id if column is None else column
        self._ascending = self._ascending and (not row or column > int(self._ids[row - 1]))
        self._ids[row], self.slab[row], self.kind[row] = column, -1, -1
        self.count, self.next_id, self._sorted = row + 1, max(self.next_id, column + 1), None
        return column

    def remove(self, ids: np.ndarray) -> None:
        """Drops columns (K,), which must be held, each once; gives memory back when three quarters are empty."""
        if not ids.size:
            return
        gone = np.sort(self.rows(ids))
        first, count = int(gone.min()), self.count - ids.size
        kept = np.delete(np.arange(first, self.count), gone - first)
        room = self._ids.size
        while room > max(_FIRST_ROWS, 4 * count):
            room //= 2
        for name, table in self._tables().items():
            table[first:count] = table[kept]
            if room < table.size:
                setattr(self, name, table[:room].copy())
        self.count, self._sorted = count, None
        self._ascending = self._ascending or not count

    def restore(self, ids: np.ndarray, next_id: int) -> None:
        """Holds the columns (M,) and no others; their tables have to be filled again.

        Raises:
            InputError: an id comes twice, or one is not between 0 and `next_id`.
        """
        ids = checked({"ids": ids}, "ids", (None,), "i").astype(np.int64)
        if np.unique(ids).size < ids.size or (ids.size and not 0 <= ids.min() <= ids.max() < next_id):
            raise InputError(f"the landmarks' ids are not different numbers from 0 to {next_id - 1}")
        room = max(_FIRST_ROWS, 2 * ids.size)
        for name, table in self._tables().items():
            setattr(self, name, np.zeros(room, dtype=table.dtype))
        self.slab[:], self.kind[:] = -1, -1
        self._ids[: ids.size] = ids
        self.count, self.next_id = ids.size, next_id
        self._ascending, self._sorted = bool((np.diff(ids) > 0).all()), None

    def _tables(self) -> dict[str, np.ndarray]:
        names = ("_ids", "fields", "slab", "generation", "kind")
        return {name: getattr(self, name) for name in names}
