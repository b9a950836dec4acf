"""Copy-on-write store of landmark records, shared between particles along their ancestry.

A landmark is a column: one record per particle, field by field, written in some generation of the lineage. Particles
that descend from the same writer read the same row, so resampling copies nothing here, whatever the map's size. A
column is rewritten only when it is observed; one that is left alone is compacted to the rows that still have
descendants, whose number falls like 1/age as lineages coalesce. See `docs/adr` for the comparison with a tree.
"""

from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.genealogy import Lineage, Schedule
from rbpf.maps.pool import Pool

ALL = slice(None)
HOT_SHARE = 0.75
"""A column with fewer surviving rows than this share of the particles gives its dense slab back."""
COLD_SHARE = 0.9
"""A compacted column is compacted again when no more than this share of its rows survives."""


@dataclass
class Cold:
    """A compacted column: records (fields, n) of the writers `kept` (n,) that still have descendants."""

    kept: np.ndarray
    data: np.ndarray


@dataclass(frozen=True)
class Access:
    """What a kernel needs to read columns: slab, and the row of each particle, `maps[which[k]]`."""

    pool: np.ndarray
    slabs: np.ndarray
    which: np.ndarray
    maps: np.ndarray


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
        self._fields = np.zeros(64, dtype=np.int64)
        self._slab = np.full(64, -1)
        self._generation = np.zeros(64, dtype=np.int64)
        self._size = 0
        self._cold: dict[int, Cold] = {}
        self._members: dict[int, set[int]] = {}
        self._schedule = Schedule()
        self._survivors: dict[int, int] = {}

    @property
    def ids(self) -> np.ndarray:
        """Columns alive, ascending."""
        return np.flatnonzero(self._fields[: self._size])

    def __contains__(self, column: object) -> bool:
        """Whether a column is alive."""
        return isinstance(column, int | np.integer) and bool(
            0 <= column < self._size and self._fields[column] > 0
        )

    def add(self, records: np.ndarray) -> int:
        """Stores a new column (fields, N) and returns its id; ids are never used again."""
        self._checked(records)
        column = self._size
        if column == self._fields.size:
            self._fields = np.concatenate([self._fields, np.zeros_like(self._fields)])
            self._slab = np.concatenate([self._slab, np.full_like(self._slab, -1)])
            self._generation = np.concatenate([self._generation, np.zeros_like(self._generation)])
        self._size += 1
        self._occupy(column, records)
        return column

    def remove(self, columns: np.ndarray) -> None:
        """Drops columns from all particles."""
        for column in np.unique(columns):
            self._vacate(int(column))
            self._fields[column] = 0

    def replace(self, column: int, records: np.ndarray) -> None:
        """Overwrites a column in all particles (fields, N); the record size may change."""
        self._checked(records)
        self._vacate(column)
        self._occupy(column, records)

    def read(self, column: int, particles: np.ndarray | slice = ALL) -> np.ndarray:
        """Records of all or some particles, (fields, N)."""
        generation = int(self._generation[column])
        rows = self.lineage.rows(generation)[particles]
        cold = self._cold.get(column)
        if cold is not None:
            return cold.data[:, np.searchsorted(cold.kept, rows)]
        slab = self._pool(column).data[self._slab[column]]
        return slab[:, particles].copy() if generation == self.lineage.generation else slab[:, rows]

    def is_warm(self, columns: np.ndarray) -> bool:
        """Whether `access` may read columns (K,) as they are."""
        return bool((self._slab[columns] >= 0).all())

    def access(self, columns: np.ndarray) -> Access:
        """Lets a kernel read columns (K,), at least one, of one record size; cold ones are warmed up first."""
        slabs = self._slab[columns]
        if slabs.min() < 0:
            for column in columns[slabs < 0].tolist():
                if column in self._cold:
                    self.replace(column, self.read(column))
            slabs = self._slab[columns]
        generations = self._generation[columns].tolist()
        number = {generation: k for k, generation in enumerate(dict.fromkeys(generations))}
        if len(number) == 1:
            maps, which = self.lineage.rows(generations[0])[None], np.zeros(columns.size, dtype=np.int64)
        else:
            which = np.array([number[generation] for generation in generations])
            maps = np.array([self.lineage.rows(generation) for generation in number])
        return Access(self._pool(int(columns[0])).data, slabs, which, maps)

    def rewrite(self, columns: np.ndarray) -> tuple[Access, np.ndarray]:
        """Lets a kernel overwrite columns (K,) in every particle: what to read, and the slabs to write.

        A column named twice is read again from where it was first written.
        """
        access = self.access(columns)
        now = self.lineage.generation
        generations = self._generation[columns]
        if (generations == now).all():
            return access, access.slabs
        stale = np.unique(columns[generations != now])
        pool = self._pool(int(columns[0]))
        old = self._slab[stale].copy()
        self._slab[stale] = pool.take(stale.size)
        pool.give(old)
        self._move(stale, now)
        targets = self._slab[columns]
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
            if alive.size <= COLD_SHARE * self._survivors.get(generation, self.n):
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
        return int(self._fields[: self._size].sum()) * 8 * self.n

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint must hold."""
        ids = self.ids
        out = {
            "store/size": np.array(self._size),
            "store/ids": ids,
            "store/fields": self._fields[ids],
            "store/generation": self._generation[ids],
            "store/due": self._schedule.array(),
        }
        for column in ids:
            cold = self._cold.get(int(column))
            if cold is not None:
                out[f"store/{column}/kept"], out[f"store/{column}/data"] = cold.kept, cold.data
            else:
                out[f"store/{column}/data"] = self._pool(int(column)).data[self._slab[column]]
        return out

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`, into an empty store."""
        self._size = int(arrays["store/size"])
        room = max(64, 2 * self._size)
        self._fields, self._generation = np.zeros(room, dtype=np.int64), np.zeros(room, dtype=np.int64)
        self._slab = np.full(room, -1)
        for column, fields, generation in zip(
            arrays["store/ids"], arrays["store/fields"], arrays["store/generation"], strict=True
        ):
            name = f"store/{column}"
            self._fields[column], self._generation[column] = fields, generation
            self._members.setdefault(int(generation), set()).add(int(column))
            if f"{name}/kept" in arrays:
                self._cold[int(column)] = Cold(arrays[f"{name}/kept"].copy(), arrays[f"{name}/data"].copy())
            else:
                self._fill(int(column), arrays[f"{name}/data"])
        for generation in self._members:
            self.lineage.retain(generation)
        self._schedule = Schedule.of(arrays["store/due"])

    def _pool(self, column: int) -> Pool:
        fields = int(self._fields[column])
        if fields not in self.pools:
            self.pools[fields] = Pool(fields, self.n)
        return self.pools[fields]

    def _checked(self, records: np.ndarray) -> None:
        if records.ndim != 2 or records.shape[0] == 0 or records.shape[1] != self.n:
            raise InputError(f"landmark records must be (fields, {self.n}), got {records.shape}")

    def _occupy(self, column: int, records: np.ndarray) -> None:
        self._fields[column] = records.shape[0]
        self._fill(column, records)
        self._generation[column] = self.lineage.generation
        self._join([column], self.lineage.generation)

    def _fill(self, column: int, records: np.ndarray) -> None:
        pool = self._pool(column)
        self._slab[column] = pool.take(1)[0]
        pool.data[self._slab[column]] = records

    def _vacate(self, column: int) -> None:
        self._leave(int(self._generation[column]), [column])
        if self._cold.pop(column, None) is None:
            self._pool(column).give(self._slab[column : column + 1])
        self._slab[column] = -1

    def _shrink(self, column: int, alive: np.ndarray) -> None:
        cold = self._cold.get(column)
        if cold is not None:
            if alive.size <= COLD_SHARE * cold.kept.size:
                self._cold[column] = Cold(alive, cold.data.take(np.searchsorted(cold.kept, alive), axis=1))
        elif alive.size <= HOT_SHARE * self.n:
            pool = self._pool(column)
            self._cold[column] = Cold(alive, pool.data[self._slab[column]].take(alive, axis=1))
            pool.give(self._slab[column : column + 1])
            self._slab[column] = -1

    def _move(self, columns: np.ndarray, now: int) -> None:
        """To the present generation: all of one past generation together, as a resampling leaves them."""
        past = self._generation[columns]
        for generation in np.unique(past).tolist():
            self._leave(generation, columns[past == generation].tolist())
        self._generation[columns] = now
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
