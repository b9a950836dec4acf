"""Who descends from whom: the lineage of the particles, and their paths.

Ancestry changes only where particles are resampled. Each resampling starts a generation; whatever is stored per
particle (poses, landmarks) is stored per generation, by the row of the particle that wrote it, and read back
through `Lineage.rows`. Resampling therefore copies nothing but ancestor indices.
"""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from rbpf.kernels import forest

_FIRST_CHECK = 4
"""Age in generations at which a block is first looked through for dead rows; the age then doubles."""


class Lineage:
    """The forest of ancestors of N particles.

    A generation that somebody stores rows of must be kept by `retain` until `release`.

    Args:
        n: number of particles.
    """

    def __init__(self, n: int) -> None:
        self.n = n
        self.generation = 0
        self._retained: Counter[int] = Counter()
        self._mark = 0
        self._allocate(4 * n)
        self._leaves = np.arange(n)
        self._generation[:n] = 0
        self._row[:n] = np.arange(n)
        self._children[:n] = 1
        self._free = np.arange(4 * n - 1, n - 1, -1)
        self._n_free = self._free.size
        self._free = np.concatenate([self._free, np.zeros(n, dtype=np.int64)])
        self._splice_at = 4 * n
        self._identity = np.arange(n)
        self._cache: dict[int, np.ndarray] = {}

    @property
    def nodes(self) -> int:
        """Number of nodes held."""
        return self._parent.size - self._n_free

    def advance(self, ancestors: np.ndarray) -> None:
        """Starts a generation in which particle i descends from particle ancestors[i] (N,)."""
        if self._n_free < self.n:
            self._make_room()
        self.generation += 1
        self._n_free = forest.advance(
            self._parent,
            self._children,
            self._generation,
            self._row,
            self._free,
            self._n_free,
            self._leaves,
            np.ascontiguousarray(ancestors, dtype=np.int64),
            self.generation,
        )
        self._cache.clear()

    def rows(self, generation: int) -> np.ndarray:
        """Row in a retained generation of each particle's ancestor, (N,) int."""
        if generation == self.generation:
            return self._identity
        if generation not in self._cache:
            self._mark += 1
            self._cache[generation] = forest.rows_at(
                self._parent,
                self._generation,
                self._row,
                self._leaves,
                generation,
                self._found,
                self._stamp,
                self._mark,
            )
        return self._cache[generation]

    def distinct(self, generation: int) -> int:
        """Number of particles of a retained generation that still have descendants."""
        return int(np.unique(self.rows(generation)).size)

    def retain(self, generation: int) -> None:
        """Keeps the nodes of a generation."""
        self._retained[generation] += 1

    def release(self, generation: int) -> None:
        """Ends one `retain`."""
        self._retained[generation] -= 1
        if self._retained[generation] == 0:
            del self._retained[generation]

    def is_retained(self, generation: int) -> bool:
        """Whether `rows` may be asked for a generation."""
        return generation == self.generation or self._retained[generation] > 0

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint must hold."""
        names = ("parent", "children", "generation", "row", "leaves", "free")
        arrays = {f"lineage/{name}": getattr(self, f"_{name}") for name in names}
        arrays["lineage/now"] = np.array([self.generation, self._n_free, self._splice_at])
        return arrays

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`; what is stored per generation must `retain` again."""
        self._allocate(arrays["lineage/parent"].size)
        for name in ("parent", "children", "generation", "row", "leaves", "free"):
            setattr(self, f"_{name}", arrays[f"lineage/{name}"].copy())
        self.generation, self._n_free, self._splice_at = (int(v) for v in arrays["lineage/now"])
        self._retained.clear()
        self._cache.clear()

    def _allocate(self, size: int) -> None:
        self._parent = np.full(size, -1)
        self._children = np.zeros(size, dtype=np.int64)
        self._generation = np.full(size, -1)
        self._row = np.zeros(size, dtype=np.int64)
        self._found = np.zeros(size, dtype=np.int64)
        self._stamp = np.zeros(size, dtype=np.int64)

    def _make_room(self) -> None:
        """Splices chains that nobody needs out of the forest, and doubles it where that is not enough."""
        needed = np.zeros(self.generation + 1, dtype=np.bool_)
        needed[[g for g in self._retained if g <= self.generation]] = True
        self._mark += 1
        self._n_free = forest.splice(
            self._parent,
            self._children,
            self._generation,
            self._free,
            self._n_free,
            self._leaves,
            needed,
            self._stamp,
            self._mark,
        )
        if self._n_free < self._parent.size // 2:
            self._grow()

    def _grow(self) -> None:
        old = self._parent.size
        for name, value in (
            ("parent", -1),
            ("children", 0),
            ("generation", -1),
            ("row", 0),
            ("found", 0),
            ("stamp", 0),
        ):
            extra = np.full(old, value, dtype=np.int64)
            setattr(self, f"_{name}", np.concatenate([getattr(self, f"_{name}"), extra]))
        free = np.zeros(2 * old + self.n, dtype=np.int64)
        free[: self._n_free] = self._free[: self._n_free]
        free[self._n_free : self._n_free + old] = np.arange(2 * old - 1, old - 1, -1)
        self._free, self._n_free = free, self._n_free + old


@dataclass
class Schedule:
    """When each generation's rows are next worth compacting: at ages 4, 8, 16, …, as lineages coalesce like 1/age."""

    due: dict[int, set[int]] = field(default_factory=dict)

    def add(self, generation: int, now: int) -> None:
        """Looks again when the generation has twice its present age."""
        self.due.setdefault(now + max(_FIRST_CHECK, now - generation), set()).add(generation)

    def pop(self, now: int) -> list[int]:
        """Generations to look through now."""
        return sorted(self.due.pop(now, ()))

    def array(self) -> np.ndarray:
        """(n, 2) pairs of due age and generation, for a checkpoint."""
        pairs = [(when, g) for when in sorted(self.due) for g in sorted(self.due[when])]
        return np.array(pairs, dtype=np.int64).reshape(-1, 2)

    @classmethod
    def of(cls, pairs: np.ndarray) -> "Schedule":
        """The inverse of `array`."""
        schedule = cls()
        for when, generation in pairs:
            schedule.due.setdefault(int(when), set()).add(int(generation))
        return schedule


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
        self.blocks: list[PathBlock] = []
        self._by_generation: dict[int, PathBlock] = {}
        self._schedule = Schedule()
        self._steps = 0

    def record(self, stamp_ns: int, state: np.ndarray, log_weights: np.ndarray) -> None:
        """Stores the states (N, E) after a step."""
        now = self.lineage.generation
        block = self._by_generation.get(now)
        if block is None:
            block = PathBlock(now, np.arange(state.shape[0]), [], [], [])
            self._append(block)
            self._compact(now)
        block.stamps_ns.append(stamp_ns)
        block.states.append(state.copy())
        if self.clouds:
            block.log_weights.append(log_weights.copy())
        self._steps += 1
        if self.lag is not None and self._steps > self.lag:
            self._drop_first()

    @property
    def stamps_ns(self) -> np.ndarray:
        """(T,) stamps of the steps kept."""
        return np.array([stamp for block in self.blocks for stamp in block.stamps_ns], dtype=np.int64)

    @property
    def stored_states(self) -> int:
        """Number of states held, of T·N without sharing."""
        return sum(len(block.states) * block.kept.size for block in self.blocks)

    def distinct_first(self) -> int:
        """How many particles of the first generation kept still have descendants."""
        return self.lineage.distinct(self.blocks[0].generation) if self.blocks else self.lineage.n

    def paths(self) -> np.ndarray:
        """(T, N, E): the trajectory of each current particle, along its ancestors."""
        parts: list[np.ndarray] = []
        for block in self.blocks:
            rows = np.searchsorted(block.kept, self.lineage.rows(block.generation))
            parts.extend(states[rows] for states in block.states)
        return np.array(parts)

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint must hold."""
        out: dict[str, np.ndarray] = {
            "history/generations": np.array([b.generation for b in self.blocks], dtype=np.int64)
        }
        for number, block in enumerate(self.blocks):
            out[f"history/{number}/kept"] = block.kept
            out[f"history/{number}/stamps_ns"] = np.array(block.stamps_ns, dtype=np.int64)
            out[f"history/{number}/states"] = np.array(block.states)
            out[f"history/{number}/log_weights"] = np.array(block.log_weights)
        out["history/due"] = self._schedule.array()
        return out

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self.blocks, self._by_generation = [], {}
        self._schedule = Schedule.of(arrays["history/due"])
        for number, generation in enumerate(arrays["history/generations"]):
            part = {
                name: arrays[f"history/{number}/{name}"]
                for name in ("kept", "stamps_ns", "states", "log_weights")
            }
            block = PathBlock(
                int(generation),
                part["kept"].copy(),
                [int(stamp) for stamp in part["stamps_ns"]],
                list(part["states"].copy()),
                list(part["log_weights"].copy()),
            )
            self.blocks.append(block)
            self._by_generation[block.generation] = block
            self.lineage.retain(block.generation)
        self._steps = self.stamps_ns.size

    def _append(self, block: PathBlock) -> None:
        self.blocks.append(block)
        self._by_generation[block.generation] = block
        self.lineage.retain(block.generation)
        if not self.clouds:
            self._schedule.add(block.generation, block.generation)

    def _compact(self, now: int) -> None:
        for generation in self._schedule.pop(now):
            block = self._by_generation.get(generation)
            if block is None:
                continue
            alive = np.unique(self.lineage.rows(generation))
            if 2 * alive.size <= block.kept.size:
                rows = np.searchsorted(block.kept, alive)
                block.states = [states[rows] for states in block.states]
                block.kept = alive
            if alive.size > 1:
                self._schedule.add(generation, now)

    def _drop_first(self) -> None:
        block = self.blocks[0]
        del block.stamps_ns[0], block.states[0], block.log_weights[:1]
        self._steps -= 1
        if not block.states:
            self.blocks.pop(0)
            del self._by_generation[block.generation]
            self.lineage.release(block.generation)
