"""Copy-on-write store of landmark records, shared between particles along their ancestry.

A landmark is a column: one record per particle, field by field, written in some generation of the lineage. Particles with the
same writer as ancestor read the same row, so resampling copies nothing here, whatever the map's size. A column is rewritten
only when it is observed; unobserved ones are compacted to the rows that still have descendants, whose number falls like 1/age
as lineages coalesce. See `docs/adr` for the comparison with a tree.
"""

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import integers, numbers, read, read_one
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Landmark, Records
from rbpf.errors import InputError
from rbpf.ranges import require_memory

ALL = slice(None)

_TABLES = {
    "ids": integers("landmarks", least=0, below="ids", distinct=True),
    "fields": integers("landmarks", least=1),
    "generation": integers("landmarks", least=0, below="generations"),
}
_HOT = {"data": numbers("fields", "n", values="log")}
_COLD = {"kept": integers("kept", least=0, below="n", ascending=True), "data": numbers("fields", "kept", values="log")}

#: A column with fewer surviving rows than this fraction of the particles is compacted and its dense slab freed.
HOT_FRACTION = 0.75
COLD_FRACTION = 0.9  #: A compacted column is compacted again once at most this fraction of its rows survives.

_FIRST_SLABS = 32


@dataclass(frozen=True)
class Layout:
    """Layout of a landmark's estimate in a record of fixed size.

    Per component the mean (D) and the covariance's lower triangle by rows (D(D+1)/2); the log-weights of several components;
    the constants (A); with evidence, the log-odds that the landmark exists.
    """

    landmark: Landmark
    evidence: bool = False

    @property
    def gaussian_fields(self) -> int:
        """Mean and packed covariance of one component."""
        dim = self.landmark.dim
        return dim + dim * (dim + 1) // 2

    @property
    def fields(self) -> int:
        """Numbers per record."""
        components = self.landmark.components
        weights = components if components > 1 else 0
        return components * self.gaussian_fields + weights + self.landmark.constants + self.evidence

    def pack(self, records: Records, log_odds: np.ndarray | None = None) -> np.ndarray:
        """Records of K landmarks as columns (K, fields, N).

        Raises InputError: the shapes do not fit, or a number is not finite.
        """
        n, k = records.mean.shape[:2]
        dim, components = self.landmark.dim, self.landmark.components
        middle = (components,) if components > 1 else ()
        name = type(self.landmark).__name__
        if records.mean.shape != (n, k, *middle, dim) or records.cov.shape != (n, k, *middle, dim, dim):
            raise InputError(
                f"{name} has {components} component(s) of dimension {dim}: expected means {(n, k, *middle, dim)}, "
                f"got means {records.mean.shape} and covariances {records.cov.shape}"
            )
        if (records.log_weights is None) != (components == 1):
            raise InputError(f"{name} needs log_weights exactly if it has several components")
        if (records.const is None) != (self.landmark.constants == 0):
            raise InputError(f"{name} has {self.landmark.constants} constants per landmark: give them in Records.const")
        columns, end = np.empty((k, self.fields, n)), components * self.gaussian_fields
        rows = np.moveaxis(columns, -1, 0)
        rows[..., :end] = np.concatenate([records.mean, gaussian.pack(records.cov)], axis=-1).reshape(n, k, end)
        if not np.isfinite(rows[..., :end]).all():
            raise InputError(f"a new {name} has a mean or covariance that is not finite")
        if records.log_weights is not None:
            rows[..., end : end + components] = records.log_weights
            end += components
        if records.const is not None:
            rows[..., end : end + self.landmark.constants] = records.const
        if self.evidence:
            rows[..., -1] = 0.0 if log_odds is None else log_odds
        return columns

    def estimates(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Means (N, K, D) and constants (N, K, A) of columns (K, fields, N) of single Gaussians, as views."""
        rows, end = columns.transpose(2, 0, 1), self.gaussian_fields
        const = rows[..., end : end + self.landmark.constants] if self.landmark.constants else None
        return rows[..., : self.landmark.dim], const

    def unpack(self, columns: np.ndarray) -> Records:
        """Columns (K, fields, N) as records."""
        rows = columns.transpose(2, 0, 1)
        n, k = rows.shape[:2]
        dim, components = self.landmark.dim, self.landmark.components
        end = components * self.gaussian_fields
        body = rows[..., :end].reshape(n, k, components, self.gaussian_fields)
        mean, cov = body[..., :dim], gaussian.unpack(body[..., dim:], dim)
        log_weights = None
        if components > 1:
            log_weights, end = rows[..., end : end + components], end + components
        else:
            mean, cov = mean[:, :, 0], cov[:, :, 0]
        const = rows[..., end : end + self.landmark.constants] if self.landmark.constants else None
        return Records(mean, cov, const, log_weights)


@final
class Columns:
    """Tables of the existing columns only, so that memory is bounded however many landmarks come and go.

    Row r of every table is the column with the r-th id, in order of addition. Ids are the caller's, or counted up
    from the largest used.
    """

    def __init__(self) -> None:
        self.next_id = 0  #: One more than the largest id that was ever used.
        self._hold(np.zeros((5, 0), dtype=np.int64))

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.next_id = state["next_id"]
        self._hold(state["_tables"])  # those of a copy, too, are views of one array

    def rows(self, ids: np.ndarray | int) -> np.ndarray:
        """Rows (K,) of columns (K,), which must exist; for a single one its number."""
        return self._order[self._ascending.searchsorted(ids)]

    def held(self, ids: np.ndarray) -> np.ndarray:
        """Mask (K,) of the ids (K,) that exist."""
        return self.kinds(ids) >= 0

    def kinds(self, ids: np.ndarray) -> np.ndarray:
        """`kind` of each of some ids (K,), −1 if there is no such column."""
        if not self.ids.size:
            return np.full(ids.shape, -1)
        rows = self._order[np.minimum(self._ascending.searchsorted(ids), self.ids.size - 1)]
        return np.where(self.ids[rows] == ids, self.kind[rows], -1)

    def add(self, count: int, ids: np.ndarray | None = None) -> np.ndarray:
        """Adds columns and returns their ids (K,): those given, none of which may exist, or the next ones."""
        ids = np.arange(self.next_id, self.next_id + count) if ids is None else ids
        new = np.zeros((5, count), dtype=np.int64)
        new[0], new[2] = ids, -1
        self.next_id = max(self.next_id, int(ids.max(initial=-1)) + 1)
        self._hold(np.concatenate([self._tables, new], axis=1))
        return ids

    def remove(self, ids: np.ndarray) -> None:
        """Drops columns (K,), which must exist."""
        self._hold(np.delete(self._tables, self.rows(ids), axis=1))

    def _hold(self, tables: np.ndarray) -> None:
        """Sets the five tables, which are stacked."""
        self._tables = tables
        self.ids, self.fields, self.slab, self.generation, self.kind = tables
        self._order = self.ids.argsort(kind="stable")
        self._ascending = self.ids[self._order]


class Pool:
    """Dense slabs (slabs, fields, N) of equal record size, recycled through a free list."""

    def __init__(self, fields: int, n: int) -> None:
        self.data = self._slabs(_FIRST_SLABS, fields, n)
        self._free = list(range(_FIRST_SLABS - 1, -1, -1))

    @property
    def used(self) -> int:
        return self.data.shape[0] - len(self._free)

    def take(self, count: int) -> np.ndarray:
        """Free slabs, (count,) int; the pool doubles if there are too few."""
        while len(self._free) < count:
            held, old = self.data, self.data.shape[0]
            self.data = self._slabs(2 * old, *held.shape[1:])
            # Unused slabs take no memory, and the old array's memory is returned while copying.
            for first in range(old - _FIRST_SLABS, -1, -_FIRST_SLABS):
                self.data[first : first + _FIRST_SLABS] = held[first : first + _FIRST_SLABS]
                with suppress(ValueError):  # still referenced: freed as a whole later
                    held.resize((first, *held.shape[1:]))
            self._free = list(range(2 * old - 1, old - 1, -1)) + self._free
        taken = self._free[: -count - 1 : -1]
        del self._free[len(self._free) - count :]
        return np.array(taken, dtype=np.int64)

    def give(self, slabs: np.ndarray) -> None:
        self._free.extend(slabs.tolist())

    def _slabs(self, count: int, fields: int, n: int) -> np.ndarray:
        require_memory(8.0 * count * fields * n, f"{count} landmarks of {fields} numbers in {n} particles")
        return np.zeros((count, fields, n))


@dataclass
class Cold:
    """A compacted column: records (fields, n) of the writers `kept` (n,) that still have descendants."""

    kept: np.ndarray
    data: np.ndarray


class Access(NamedTuple):
    """A kernel's access to columns: slab, and the row of each particle, `maps[which[k]]`."""

    pool: np.ndarray
    slabs: np.ndarray
    which: np.ndarray
    maps: np.ndarray


class SharedStore:
    """Columns of records in n particles, shared along their lineage."""

    def __init__(self, n: int, lineage: Lineage) -> None:
        self.n = n
        self.lineage = lineage
        self.pools: dict[int, Pool] = {}
        self.columns = Columns()
        self._cold: dict[int, Cold] = {}
        self._members: dict[int, set[int]] = {}
        self._survivors: dict[int, int] = {}

    @property
    def ids(self) -> np.ndarray:
        return self.columns.ids.copy()

    def add(self, records: np.ndarray, ids: np.ndarray | None = None) -> np.ndarray:
        """Stores new columns (K, fields, N) and returns their ids (K,): those given, none of which may exist, or new ones."""
        self._checked(records)
        ids = self.columns.add(len(records), ids)
        self._occupy(ids, self.columns.rows(ids), records)
        return ids

    def remove(self, columns: np.ndarray) -> None:
        gone = np.unique(columns)
        self._vacate(gone, self.columns.rows(gone))
        self.columns.remove(gone)

    def replace(self, columns: np.ndarray, records: np.ndarray) -> None:
        """Overwrites columns (K,), each once, in all particles (K, fields, N); the record size may change."""
        self._checked(records)
        rows = self.columns.rows(columns)
        self._vacate(columns, rows)
        self._occupy(columns, rows, records)

    def read(self, column: int, particles: np.ndarray | slice = ALL) -> np.ndarray:
        """Records of all or some particles, (fields, N)."""
        return self.read_all(np.array([column]), particles)[0]

    def read_all(self, columns: np.ndarray, particles: np.ndarray | slice = ALL) -> np.ndarray:
        """Records (K, fields, N) of columns (K,), at least one, of one record size; compacted ones stay compacted."""
        at = self.columns.rows(columns)
        generations = self.columns.generation[at].tolist()
        rows = {g: self.lineage.rows(g)[particles] for g in dict.fromkeys(generations)}
        pool = self._pool(int(at[0])).data
        out = np.empty((columns.size, pool.shape[1], rows[generations[0]].size))
        # Columns compacted together share one array of writers.
        found: dict[int, np.ndarray] = {}
        slabs = self.columns.slab[at].tolist()
        for k, (column, generation, slab) in enumerate(zip(columns.tolist(), generations, slabs, strict=True)):
            if slab >= 0:
                pool[slab].take(rows[generation], axis=1, out=out[k], mode="clip")
                continue
            cold = self._cold[column]
            where = found.get(id(cold.kept))
            if where is None:
                where = found[id(cold.kept)] = np.searchsorted(cold.kept, rows[generation])
            cold.data.take(where, axis=1, out=out[k], mode="clip")
        return out

    def access_read_only(self, columns: np.ndarray) -> Access:
        """As `access`, for a kernel that only reads: compacted columns stay so."""
        if (self.columns.slab[self.columns.rows(columns)] >= 0).all():
            return self.access(columns)
        records, count = self.read_all(columns), columns.size
        return Access(records, np.arange(count), np.zeros(count, dtype=np.int64), np.arange(self.n)[None])

    def access(self, columns: np.ndarray) -> Access:
        """Lets a kernel read columns (K,), at least one, of one record size; compacted ones are expanded first."""
        return self._opened(columns, self.columns.rows(columns))

    def _opened(self, columns: np.ndarray, at: np.ndarray) -> Access:
        slabs = self.columns.slab[at]
        if slabs.min() < 0:
            cold = np.unique(columns[slabs < 0])
            self.replace(cold, self.read_all(cold))
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

        A column named twice is read from its new slab the second time.
        """
        at, now = self.columns.rows(columns), self.lineage.generation
        access, generations = self._opened(columns, at), self.columns.generation[at]
        is_stale = generations != now
        if not is_stale.any():
            return access, access.slabs
        past = dict(zip(columns.tolist(), generations.tolist(), strict=True))
        stale = [column for column, generation in past.items() if generation != now]
        is_distinct = len(past) == columns.size
        rows, pool = at[is_stale] if is_distinct else self.columns.rows(np.array(stale)), self._pool(int(at[0]))
        old = self.columns.slab[rows].copy()
        self.columns.slab[rows] = pool.take(len(stale))
        pool.give(old)
        # All of one past generation together, as after a resampling.
        for generation in {past[column] for column in stale}:
            self._leave(generation, [column for column in stale if past[column] == generation])
        self.columns.generation[rows] = now
        self._join(stale, now)
        targets = self.columns.slab[at]
        if is_distinct:
            return access._replace(pool=pool.data), targets
        _, first = np.unique(columns, return_index=True)
        again = np.ones(columns.size, dtype=bool)
        again[first] = False
        slabs, which = access.slabs.copy(), access.which.copy()
        slabs[again], which[again] = targets[again], access.maps.shape[0]
        maps = np.concatenate([access.maps, self.lineage.rows(now)[None]])
        return Access(pool.data, slabs, which, maps), targets

    def compact(self) -> None:
        """After a resampling: compacts the columns whose writers have lost half their lineages; amortised O(1)."""
        for generation in self.lineage.due():
            members, before = self._members.get(generation), self._survivors.get(generation, self.n)
            if not members or before == 1:
                continue
            alive = self.lineage.survivors(generation)
            if alive.size <= COLD_FRACTION * before:
                self._survivors[generation] = alive.size
                # Columns compacted together share one array of writers.
                found: dict[int, np.ndarray] = {}
                columns = list(members)
                for column, row in zip(columns, self.columns.rows(np.array(columns)).tolist(), strict=True):
                    cold = self._cold.get(column)
                    if cold is not None and alive.size <= COLD_FRACTION * cold.kept.size:
                        if id(cold.kept) not in found:
                            found[id(cold.kept)] = np.searchsorted(cold.kept, alive)
                        self._cold[column] = Cold(alive, cold.data.take(found[id(cold.kept)], axis=1))
                    elif cold is None and alive.size <= HOT_FRACTION * self.n:
                        pool = self._pool(row)
                        self._cold[column] = Cold(alive, pool.data[self.columns.slab[row]].take(alive, axis=1))
                        pool.give(self.columns.slab[row : row + 1])
                        self.columns.slab[row] = -1

    @property
    def stored_bytes(self) -> int:
        """Bytes of records and row indices."""
        hot = sum(pool.used * pool.data[0].nbytes for pool in self.pools.values())
        return hot + sum(cold.data.nbytes + cold.kept.nbytes for cold in self._cold.values())

    @property
    def dense_bytes(self) -> int:
        """Bytes of separate copies for all particles."""
        return int(self.columns.fields.sum()) * 8 * self.n

    def arrays(self) -> dict[str, np.ndarray]:
        ids = self.ids
        out = {
            "store/size": np.array(self.columns.next_id),
            "store/ids": ids,
            "store/fields": self.columns.fields.copy(),
            "store/generation": self.columns.generation.copy(),
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

        Raises InputError: an array is missing or invalid.
        """
        next_id = int(read_one(arrays, "store/size", integers(least=0)))
        sizes = {"generations": self.lineage.generation + 1, "ids": next_id, "n": self.n}
        found = read(arrays, _TABLES, "store/", **sizes)
        self.columns.add(found["ids"].size, found["ids"])
        self.columns.next_id = next_id
        self.columns.fields[:], self.columns.generation[:] = found["fields"], found["generation"]
        for row, column in enumerate(self.ids.tolist()):
            self._members.setdefault(int(self.columns.generation[row]), set()).add(column)
        for generation in self._members:
            self.lineage.retain(generation)
        for row, column in enumerate(self.ids.tolist()):
            name, sizes["fields"] = f"store/{column}/", int(self.columns.fields[row])
            if f"{name}kept" not in arrays:
                self._fill(np.array([row]), read(arrays, _HOT, name, **sizes)["data"][None])
                continue
            cold = Cold(*read(arrays, _COLD, name, **sizes).values())
            alive = self.lineage.survivors(int(self.columns.generation[row]))
            if np.setdiff1d(alive, cold.kept).size:
                raise InputError(f"the array {name}kept lacks particles that have descendants")
            self._cold[column] = cold

    def _pool(self, row: int) -> Pool:
        fields = int(self.columns.fields[row])
        if fields not in self.pools:
            self.pools[fields] = Pool(fields, self.n)
        return self.pools[fields]

    def _checked(self, records: np.ndarray) -> None:
        if records.ndim != 3 or records.shape[1] == 0 or records.shape[2] != self.n:
            raise InputError(f"landmark records must be (K, fields, {self.n}), got {records.shape}")

    def _occupy(self, columns: np.ndarray, rows: np.ndarray, records: np.ndarray) -> None:
        if not columns.size:
            return
        self.columns.fields[rows], self.columns.generation[rows] = records.shape[1], self.lineage.generation
        self._fill(rows, records)
        self._join(columns.tolist(), self.lineage.generation)

    def _fill(self, rows: np.ndarray, records: np.ndarray) -> None:
        pool = self._pool(int(rows[0]))
        self.columns.slab[rows] = slabs = pool.take(rows.size)
        pool.data[slabs] = records

    def _vacate(self, columns: np.ndarray, rows: np.ndarray) -> None:
        for column, row in zip(columns.tolist(), rows.tolist(), strict=True):
            self._leave(int(self.columns.generation[row]), [column])
            if self._cold.pop(column, None) is None:
                self._pool(row).give(self.columns.slab[row : row + 1])
            self.columns.slab[row] = -1

    def _join(self, columns: list[int], generation: int) -> None:
        if generation not in self._members:
            self._members[generation] = set()
            self.lineage.retain(generation)
        self._members[generation].update(columns)

    def _leave(self, generation: int, columns: list[int]) -> None:
        members = self._members[generation]
        members.difference_update(columns)
        if not members:
            del self._members[generation]
            self._survivors.pop(generation, None)
            self.lineage.release(generation)
