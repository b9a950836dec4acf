"""The genealogy of the particles, and their paths along it.

Each resampling starts a generation; everything stored per particle (poses, landmarks) is stored per generation, by the row
of the particle that wrote it, and read back through `Lineage.rows`. Resampling copies only ancestor indices.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from rbpf.arrays import Int
from rbpf.core.checkpoint import integers, numbers, read, read_one
from rbpf.errors import InputError
from rbpf.kernels import forest
from rbpf.kernels.forest import CHILDREN, GENERATION, ROW
from rbpf.ranges import require_memory

#: Age in generations at which stored rows are first checked for extinct lineages, and least time to the next check.
_FIRST_CHECK = 4
_MEMORY_CHECK = 64  #: Steps between checks of the paths' memory.
_PENDING = 8  #: Maximum number of generations not yet inserted into the forest.

_COLUMNS = "parent", "children", "generation", "row"
_NO_NODE = np.array([-1, 0, -1, 0])
_FOREST = {
    "parent": integers("nodes", least=-1, below="nodes"),
    "children": integers("nodes", least=0),
    "generation": integers("nodes", least=-1, below="generations"),
    "row": integers("nodes", least=0, below="n"),
    "leaves": integers("n", least=0, below="nodes"),
    "free": integers("free", least=0, below="nodes"),
}
_BLOCK = {
    "kept": integers("kept", least=0, below="n", ascending=True),
    "stamps_ns": integers("steps"),
    "states": numbers("steps", "kept", "size"),
}


class Lineage:
    """The ancestor forest of n particles; generations with stored rows are kept from `retain` to `release`."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.generation = 0
        self._retained: Counter[int] = Counter()
        self._mark = 0
        self._allocate(4 * n)
        self._identity = np.arange(n)
        #: Ancestors of the newest generations, inserted into the forest lazily.
        self._pending: list[np.ndarray] = []
        #: Cached `rows` and `survivors` by generation, since the last resampling.
        self._cache: dict[int, np.ndarray] = {}
        self._alive: dict[int, np.ndarray] = {}
        #: Nodes of each retained generation at the last check, by row.
        self._members: dict[int, np.ndarray] = {}
        #: Generations with a single surviving row, which stays the only one: no need to climb the forest again.
        self._settled: dict[int, int] = {}
        self._oldest = 0
        self._plant()

    @property
    def nodes(self) -> int:
        self._grow()
        return len(self._nodes) - self._n_free

    def advance(self, ancestors: Int[np.ndarray, " N"]) -> None:
        """Starts a generation in which particle i descends from particle ancestors[i] (N,)."""
        self.generation += 1
        self._pending.append(np.array(ancestors, dtype=np.int64))
        self._cache.clear()
        self._alive.clear()
        if len(self._pending) == _PENDING:
            self._forget()
        if len(self._pending) == _PENDING:
            self._grow()

    def rows(self, generation: int) -> Int[np.ndarray, " N"]:
        """Row in a retained generation of each particle's ancestor, (N,) int."""
        if generation == self.generation:
            return self._identity
        if generation not in self._cache:
            self._grow()
            if generation in self._settled:
                rows = np.full(self.n, self._settled[generation])
            else:
                self._mark += 1
                scratch = self._found, self._stamp, self._mark
                rows = np.asarray(forest.rows_at(self._nodes, self._leaves, generation, *scratch))
                if (rows == rows[0]).all():
                    self._settled[generation] = int(rows[0])
            self._cache[generation] = rows
        return self._cache[generation]

    def survivors(self, generation: int) -> Int[np.ndarray, " n"]:
        """Particles of a retained generation that still have descendants, ascending.

        The cost is proportional to the survivors at the previous call, so that calls at ages growing by a quarter cost a
        few passes over the particles in total.
        """
        if generation == self.generation:
            return self._identity.copy()
        if generation in self._alive:
            return self._alive[generation]
        self._grow()
        nodes = self._members.get(generation)
        if nodes is None:
            nodes = np.flatnonzero(self._nodes[:, GENERATION] == generation)
            nodes = nodes[np.argsort(self._nodes[nodes, ROW])]
        # The node of an extinct lineage is free, or reused by a later generation.
        self._members[generation], alive = forest.survivors(self._nodes, nodes, generation)
        self._alive[generation] = alive
        return alive

    def due(self, oldest: int = 0) -> list[int]:
        """Past generations from `oldest` on, ascending, whose rows are due for compaction: at ages growing by a quarter.

        Lineages coalesce ever more slowly.
        """
        due = []
        age = _FIRST_CHECK
        while age <= self.generation - oldest:
            due.append(self.generation - age)
            age += max(_FIRST_CHECK, age // 4)
        due.reverse()
        return due

    def distinct(self, generation: int) -> int:
        """Number of particles of a retained generation that still have descendants."""
        return self.survivors(generation).size

    def retain(self, generation: int) -> None:
        """Keeps the nodes of a generation. Raises InputError: it is not in the ancestry (of a damaged checkpoint)."""
        if not self._oldest <= generation <= self.generation:
            raise InputError(f"the ancestry does not hold generation {generation}")
        self._retained[generation] += 1
        if generation == self.generation and not self._pending and self._is_planted:
            self._remember(generation)

    def release(self, generation: int) -> None:
        self._retained[generation] -= 1
        if self._retained[generation] == 0:
            del self._retained[generation]
            self._settled.pop(generation, None)
            self._members.pop(generation, None)

    def arrays(self) -> dict[str, np.ndarray]:
        self._grow()
        arrays = {f"lineage/{name}": self._nodes[:, column].copy() for column, name in enumerate(_COLUMNS)}
        arrays |= {"lineage/leaves": self._leaves, "lineage/free": self._free}
        arrays["lineage/now"] = np.array([self.generation, self._n_free])
        return arrays

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`, into a new lineage; data per generation must be registered again.

        Raises InputError: an array is missing, or they do not form a forest, which compiled code does not check.
        """
        now, n_free = read_one(arrays, "lineage/now", integers(2, least=0)).tolist()
        found = read(arrays, _FOREST, "lineage/", n=self.n, generations=now + 1)
        self._allocate(len(found["parent"]))
        self._nodes[:] = np.column_stack([found[name] for name in _COLUMNS])
        self._leaves, self._free = found["leaves"], found["free"]
        self.generation, self._n_free = now, n_free
        # In a forest every used node has children or is a leaf, and its parent is older and in use.
        size, free = len(self._nodes), self._free[:n_free]
        alive = np.ones(size, dtype=bool)
        alive[free] = False
        parent, children, generation, _ = self._nodes[alive].T
        has_parent = parent >= 0
        above = parent[has_parent]
        counted = np.bincount(np.append(self._leaves, above), minlength=size)
        if not (
            n_free <= size <= self._free.size
            and alive.sum() == size - n_free
            and np.unique(self._leaves).size == self.n
            and alive[self._leaves].all()
            and alive[above].all()
            and (self._nodes[above, GENERATION] < generation[has_parent]).all()
            and (generation >= 0).all()
            and np.array_equal(children, counted[alive])
            and children.all()
        ):
            raise InputError("the particles' ancestry is no forest")
        self._oldest = int(generation[~has_parent].max())

    def _allocate(self, size: int) -> None:
        self._nodes = np.tile(_NO_NODE, (size, 1))
        self._found, self._stamp = np.zeros((2, size), dtype=np.int64)

    def _plant(self) -> None:
        """A forest of n roots, the particles of the oldest generation."""
        size, n = len(self._nodes), self.n
        self._nodes[:] = _NO_NODE
        self._nodes[:n, CHILDREN], self._nodes[:n, GENERATION], self._nodes[:n, ROW] = 1, self._oldest, self._identity
        self._leaves = self._identity.copy()
        self._free = np.concatenate([np.arange(size - 1, n - 1, -1), np.zeros(n, dtype=np.int64)])
        self._n_free = size - n
        self._is_planted = True
        self._remember(self._oldest)

    def _remember(self, generation: int) -> None:
        """Records the current leaves as the nodes of a retained generation."""
        if generation in self._retained:
            self._members[generation] = self._leaves.copy()

    def _forget(self) -> None:
        """Drops the forest if no retained generation is in it; `_grow` plants another at the oldest retained one."""
        newest = self.generation - len(self._pending)
        if self._pending and not any(generation <= newest for generation in self._retained):
            self._oldest = min(self._retained, default=self.generation)
            del self._pending[: self._oldest - newest]
            self._is_planted = False

    def _grow(self) -> None:
        """Inserts the pending ancestors into the forest."""
        if self._is_planted and not self._pending:
            return
        self._forget()
        if not self._is_planted:
            self._plant()
        first = self.generation - len(self._pending) + 1
        for generation, ancestors in enumerate(self._pending, start=first):
            if self._n_free < self.n:
                self._make_room()
            self._n_free = forest.advance(self._nodes, self._free, self._n_free, self._leaves, ancestors, generation)
            self._remember(generation)
        self._pending.clear()

    def _make_room(self) -> None:
        """Removes unneeded chain nodes from the forest, and doubles it if that is not enough."""
        needed = np.isin(self._nodes[:, GENERATION], list(self._retained))
        self._mark += 1
        scratch = self._leaves, needed, self._stamp, self._mark
        self._n_free = forest.splice(self._nodes, self._free, self._n_free, *scratch)
        held, old = self._nodes, len(self._nodes)
        if self._n_free >= old // 2:
            return
        self._allocate(2 * old)
        self._nodes[:old] = held
        free = np.zeros(2 * old + self.n, dtype=np.int64)
        free[: self._n_free] = self._free[: self._n_free]
        free[self._n_free : self._n_free + old] = np.arange(2 * old - 1, old - 1, -1)
        self._free, self._n_free = free, self._n_free + old


@dataclass
class PathBlock:
    """Poses of one generation: `states` (T, n, E) at the rows `kept` (n,); log-weights where clouds are kept."""

    generation: int
    kept: np.ndarray
    stamps_ns: list[int]
    states: list[np.ndarray]
    log_weights: list[np.ndarray]


class History:
    """Posterior trajectories: the sampled states of all surviving lineages.

    Args:
        lineage: the ancestry of the particles.
        lag: number of steps kept; None keeps all. A fixed lag holds a run of any length in constant memory.
        clouds: also keep each step's whole cloud and log-weights, which backward simulation needs.
    """

    def __init__(self, lineage: Lineage, lag: int | None = None, clouds: bool = False) -> None:
        self.lineage = lineage
        self.lag = lag
        self.clouds = clouds
        self._blocks: dict[int, PathBlock] = {}
        self._steps = 0

    def record(self, stamp_ns: int, state: np.ndarray, log_weights: np.ndarray) -> None:
        """Stores the states (N, E) after a step. Raises InputError: the paths no longer fit into memory."""
        if self._steps % _MEMORY_CHECK == 0:
            paths = (
                f"the paths of {self.lineage.n} particles over {self._steps + _MEMORY_CHECK} steps (a lag keeps fewer)"
            )
            require_memory(8.0 * state[0].size * (self.stored_states + _MEMORY_CHECK * self.lineage.n), paths)
        now = self.lineage.generation
        block = self._blocks.get(now)
        if block is None:
            block = self._blocks[now] = PathBlock(now, self.lineage.rows(now), [], [], [])
            self.lineage.retain(now)
            # Blocks shrink to the rows that still have descendants.
            for generation in [] if self.clouds else self.lineage.due(next(iter(self._blocks))):
                past = self._blocks.get(generation)
                if past is None or past.kept.size == 1:
                    continue
                alive = self.lineage.survivors(generation)
                if 2 * alive.size <= past.kept.size:
                    rows = np.searchsorted(past.kept, alive)
                    past.states = [states[rows] for states in past.states]
                    past.kept = alive
        block.stamps_ns.append(stamp_ns)
        block.states.append(state.copy())
        if self.clouds:
            block.log_weights.append(log_weights.copy())
        self._steps += 1
        if self.lag is not None and self._steps > self.lag:
            first = next(iter(self._blocks.values()))
            del first.stamps_ns[0], first.states[0], first.log_weights[:1]
            self._steps -= 1
            if not first.states:
                del self._blocks[first.generation]
                self.lineage.release(first.generation)

    @property
    def blocks(self) -> list[PathBlock]:
        """One per generation, in order of time."""
        return list(self._blocks.values())

    @property
    def stamps_ns(self) -> np.ndarray:
        """(T,) stamps of the steps kept."""
        return np.array([stamp for block in self.blocks for stamp in block.stamps_ns], dtype=np.int64)

    @property
    def stored_states(self) -> int:
        return sum(len(block.states) * block.kept.size for block in self.blocks)

    def distinct_first(self) -> int:
        """Number of particles of the first stored generation that have descendants."""
        return self.lineage.distinct(self.blocks[0].generation) if self.blocks else self.lineage.n

    def paths(self) -> np.ndarray:
        """(T, N, E): the trajectory of each current particle, along its ancestors."""
        parts: list[np.ndarray] = []
        for block in self.blocks:
            rows = np.searchsorted(block.kept, self.lineage.rows(block.generation))
            parts.extend(states[rows] for states in block.states)
        return np.array(parts)

    def arrays(self) -> dict[str, np.ndarray]:
        out: dict[str, np.ndarray] = {
            "history/generations": np.array([b.generation for b in self.blocks], dtype=np.int64)
        }
        for number, block in enumerate(self.blocks):
            kept = {name: np.array(value) for name, value in vars(block).items() if name != "generation"}
            out |= {f"history/{number}/{name}": array for name, array in kept.items()}
        return out

    def restore(self, arrays: dict[str, np.ndarray], size: int | None = None) -> None:
        """The inverse of `arrays`, into a new one, for states of `size` numbers; errors as of `rbpf.core.checkpoint.read`."""
        generations = read_one(arrays, "history/generations", integers("blocks", ascending=True)).tolist()
        shape = ("steps", "n") if self.clouds else (0,)
        block = {**_BLOCK, "log_weights": numbers(*shape, values="log")}
        sizes = {"n": self.lineage.n} | ({} if size is None else {"size": size})
        for number, generation in enumerate(generations):
            self.lineage.retain(generation)
            kept, stamps, states, log_weights = read(arrays, block, f"history/{number}/", **sizes).values()
            if not stamps.size or np.setdiff1d(self.lineage.survivors(generation), kept).size:
                raise InputError(f"the array history/{number}/kept lacks particles that have descendants")
            self._blocks[generation] = PathBlock(generation, kept, stamps.tolist(), list(states), list(log_weights))
        self._steps = self.stamps_ns.size
