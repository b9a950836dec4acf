"""Copy-on-write store of landmark records, shared between particles along their ancestry.

A landmark is a column: one record per particle, field by field, written in some generation of the lineage. Particles
that descend from the same writer read the same row, so resampling copies nothing here, whatever the map's size. A
column is rewritten only when it is observed; one that is left alone is compacted to the rows that still have
descendants, whose number falls like 1/age as lineages coalesce. See `docs/adr` for the comparison with a tree.
"""

import numpy as np

from rbpf.core.archive import checked, within
from rbpf.core.genealogy import Lineage, Schedule
from rbpf.errors import InputError
from rbpf.maps.columns import Columns
from rbpf.maps.pool import Access, Cold, Pool

ALL = slice(None)
MOST_FIELDS = 1 << 20
"""No record is longer."""

HOT_FRACTION = 0.75
"""A column with fewer surviving rows than this fraction of the particles gives its dense slab back."""
COLD_FRACTION = 0.9
"""A compacted column is compacted again when no more than this fraction of its rows survives."""


class SharedStore:
    """Columns of records in N particles.

    Args:
        n: particles.
        lineage: their ancestry.
    """

    def __init__(self, n: int, lineage: Lineage) -> None:
        self.n = n
        self.lineage = lineage
        self.pools: dict[int, Pool] = {}
        self.columns = Columns()
        self._cold: dict[int, Cold] = {}
        self._members: dict[int, set[int]] = {}
        self._schedule = Schedule()
        self._survivors: dict[int, int] = {}

    @property
    def ids(self) -> np.ndarray:
        """Columns alive, in the order in which they were added."""
        return self.columns.ids.copy()

    @property
    def next_id(self) -> int:
        """One more than the largest id that was ever used."""
        return self.columns.next_id

    def __contains__(self, column: object) -> bool:
        """Whether a column is alive."""
        return isinstance(column, int | np.integer) and bool(self.columns.held(np.array([column]))[0])

    def add(self, records: np.ndarray, column: int | None = None) -> int:
        """Stores a new column (fields, N) and returns its id: the one given, which must not be alive, or a new one."""
        self._checked(records)
        column = self.columns.add(column)
        self._occupy(column, records)
        return column

    def remove(self, columns: np.ndarray) -> None:
        """Drops columns from all particles."""
        gone = np.unique(columns)
        for column in gone.tolist():
            self._vacate(column)
        self.columns.remove(gone)

    def replace(self, column: int, records: np.ndarray) -> None:
        """Overwrites a column in all particles (fields, N); the record size may change."""
        self._checked(records)
        self._vacate(column)
        self._occupy(column, records)

    def read(self, column: int, particles: np.ndarray | slice = ALL) -> np.ndarray:
        """Records of all or some particles, (fields, N)."""
        return self.read_all(np.array([column]), particles)[0]

    def read_all(self, columns: np.ndarray, particles: np.ndarray | slice = ALL) -> np.ndarray:
        """Records (K, fields, N) of columns (K,), at least one, of one record size; cold ones stay cold."""
        at = self.columns.rows(columns)
        generations = self.columns.generation[at].tolist()
        rows = {g: self.lineage.rows(g)[particles] for g in dict.fromkeys(generations)}
        pool = self._pool(int(at[0])).data
        out = np.empty((columns.size, pool.shape[1], rows[generations[0]].size))
        # Columns that were compacted together share one array of writers.
        found: dict[int, np.ndarray] = {}
        slabs = self.columns.slab[at].tolist()
        for k, (column, generation, slab) in enumerate(
            zip(columns.tolist(), generations, slabs, strict=True)
        ):
            if slab >= 0:
                pool[slab].take(rows[generation], axis=1, out=out[k], mode="clip")
                continue
            cold = self._cold[column]
            where = found.get(id(cold.kept))
            if where is None:
                where = found[id(cold.kept)] = np.searchsorted(cold.kept, rows[generation])
            cold.data.take(where, axis=1, out=out[k], mode="clip")
        return out

    def is_warm(self, columns: np.ndarray) -> bool:
        """Whether `access` may read columns (K,) as they are."""
        return bool((self.columns.slab[self.columns.rows(columns)] >= 0).all())

    def access(self, columns: np.ndarray) -> Access:
        """Lets a kernel read columns (K,), at least one, of one record size; cold ones are warmed up first."""
        at = self.columns.rows(columns)
        slabs = self.columns.slab[at]
        if slabs.min() < 0:
            cold = np.unique(columns[slabs < 0])
            for column, records in zip(cold.tolist(), self.read_all(cold), strict=True):
                self.replace(column, records)
            slabs = self.columns.slab[at]
        generations = self.columns.generation[at].tolist()
        number = {generation: k for k, generation in enumerate(dict.fromkeys(generations))}
        if len(number) == 1:
            maps, which = self.lineage.rows(generations[0])[None], np.zeros(columns.size, dtype=np.int64)
        else:
            which = np.array([number[generation] for generation in generations])
            maps = np.array([self.lineage.rows(generation) for generation in number])
        return Access(self._pool(int(at[0])).data, slabs, which, maps)

    def rewrite(self, columns: np.ndarray) -> tuple[Access, np.ndarray]:
        """Lets a kernel overwrite columns (K,) in every particle: what to read, and the slabs to write.

        A column named twice is read again from where it was first written.
        """
        access = self.access(columns)
        now = self.lineage.generation
        at = self.columns.rows(columns)
        generations = self.columns.generation[at]
        if (generations == now).all():
            return access, access.slabs
        stale = np.unique(columns[generations != now])
        rows, pool = self.columns.rows(stale), self._pool(int(at[0]))
        old = self.columns.slab[rows].copy()
        self.columns.slab[rows] = pool.take(stale.size)
        pool.give(old)
        self._move(stale, rows, now)
        targets = self.columns.slab[at]
        if len(set(columns.tolist())) == columns.size:
            return Access(pool.data, access.slabs, access.which, access.maps), targets
        _, first = np.unique(columns, return_index=True)
        again = np.ones(columns.size, dtype=bool)
        again[first] = False
        slabs, which = access.slabs.copy(), access.which.copy()
        slabs[again], which[again] = targets[again], access.maps.shape[0]
        maps = np.concatenate([access.maps, self.lineage.rows(now)[None]])
        return Access(pool.data, slabs, which, maps), targets

    def compact(self) -> None:
        """After a resampling: shrinks the columns whose writers have lost half their lineages; amortised O(1)."""
        now = self.lineage.generation
        for generation in self._schedule.pop(now):
            members = self._members.get(generation)
            if not members:
                continue
            alive = self.lineage.survivors(generation)
            if alive.size <= COLD_FRACTION * self._survivors.get(generation, self.n):
                self._survivors[generation] = alive.size
                for column in members:
                    self._shrink(column, alive)
            if alive.size > 1:
                self._schedule.add(generation, now)

    @property
    def stored_bytes(self) -> int:
        """Bytes of records and row indices held."""
        hot = sum(pool.used * pool.data[0].nbytes for pool in self.pools.values())
        return hot + sum(cold.data.nbytes + cold.kept.nbytes for cold in self._cold.values())

    @property
    def dense_bytes(self) -> int:
        """Bytes that separate copies for all particles would take."""
        return int(self.columns.fields[: self.columns.count].sum()) * 8 * self.n

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint must hold."""
        ids = self.ids
        out = {
            "store/size": np.array(self.columns.next_id),
            "store/ids": ids,
            "store/fields": self.columns.fields[: ids.size].copy(),
            "store/generation": self.columns.generation[: ids.size].copy(),
            "store/due": self._schedule.array(),
        }
        for row, column in enumerate(ids.tolist()):
            cold = self._cold.get(column)
            if cold is not None:
                out[f"store/{column}/kept"], out[f"store/{column}/data"] = cold.kept, cold.data
            else:
                out[f"store/{column}/data"] = self._pool(row).data[self.columns.slab[row]]
        return out

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`, into an empty store.

        Raises:
            InputError: an array is missing, or is not what it should be.
        """
        next_id = int(checked(arrays, "store/size", (), "i"))
        self.columns.restore(checked(arrays, "store/ids", (None,), "i"), next_id)
        count = self.columns.count
        self.columns.fields[:count] = within(arrays, "store/fields", count, 1, MOST_FIELDS)
        now = self.lineage.generation
        self.columns.generation[:count] = within(arrays, "store/generation", count, 0, now + 1)
        for row, column in enumerate(self.ids.tolist()):
            self._members.setdefault(int(self.columns.generation[row]), set()).add(column)
        for generation in self._members:
            self.lineage.take_up(generation)
        for row, column in enumerate(self.ids.tolist()):
            self._restore_column(row, column, arrays)
        self._schedule = Schedule.of(arrays["store/due"])

    def _restore_column(self, row: int, column: int, arrays: dict[str, np.ndarray]) -> None:
        name, fields = f"store/{column}", int(self.columns.fields[row])
        if f"{name}/kept" not in arrays:
            self._fill(row, checked(arrays, f"{name}/data", (fields, self.n), "f"))
            return
        kept = within(arrays, f"{name}/kept", None, 0, self.n)
        data = checked(arrays, f"{name}/data", (fields, kept.size), "f").copy()
        alive = self.lineage.survivors(int(self.columns.generation[row]))
        if (np.diff(kept) <= 0).any() or np.setdiff1d(alive, kept).size:
            raise InputError(f"the array {name}/kept does not hold the particles that have descendants")
        self._cold[column] = Cold(kept, data)

    def _pool(self, row: int) -> Pool:
        fields = int(self.columns.fields[row])
        if fields not in self.pools:
            self.pools[fields] = Pool(fields, self.n)
        return self.pools[fields]

    def _checked(self, records: np.ndarray) -> None:
        if records.ndim != 2 or records.shape[0] == 0 or records.shape[1] != self.n:
            raise InputError(f"landmark records must be (fields, {self.n}), got {records.shape}")

    def _occupy(self, column: int, records: np.ndarray) -> None:
        row = self.columns.row(column)
        self.columns.fields[row] = records.shape[0]
        self._fill(row, records)
        self.columns.generation[row] = self.lineage.generation
        self._join([column], self.lineage.generation)

    def _fill(self, row: int, records: np.ndarray) -> None:
        pool = self._pool(row)
        self.columns.slab[row] = pool.take(1)[0]
        pool.data[self.columns.slab[row]] = records

    def _vacate(self, column: int) -> None:
        row = self.columns.row(column)
        self._leave(int(self.columns.generation[row]), [column])
        if self._cold.pop(column, None) is None:
            self._pool(row).give(self.columns.slab[row : row + 1])
        self.columns.slab[row] = -1

    def _shrink(self, column: int, alive: np.ndarray) -> None:
        cold = self._cold.get(column)
        if cold is not None:
            if alive.size <= COLD_FRACTION * cold.kept.size:
                self._cold[column] = Cold(alive, cold.data.take(np.searchsorted(cold.kept, alive), axis=1))
        elif alive.size <= HOT_FRACTION * self.n:
            row = self.columns.row(column)
            pool = self._pool(row)
            self._cold[column] = Cold(alive, pool.data[self.columns.slab[row]].take(alive, axis=1))
            pool.give(self.columns.slab[row : row + 1])
            self.columns.slab[row] = -1

    def _move(self, columns: np.ndarray, rows: np.ndarray, now: int) -> None:
        """To the present generation: all of one past generation together, as a resampling leaves them."""
        past = self.columns.generation[rows]
        for generation in np.unique(past).tolist():
            self._leave(generation, columns[past == generation].tolist())
        self.columns.generation[rows] = now
        self._join(columns.tolist(), now)

    def _join(self, columns: list[int], generation: int) -> None:
        members = self._members.get(generation)
        if members is None:
            members = self._members[generation] = set()
            self.lineage.retain(generation)
            self._schedule.add(generation, generation)
        members.update(columns)

    def _leave(self, generation: int, columns: list[int]) -> None:
        members = self._members[generation]
        members.difference_update(columns)
        if not members:
            del self._members[generation]
            self._survivors.pop(generation, None)
            self.lineage.release(generation)
