"""The paths of the particles: sampled states per generation, shared along the lineage."""

from dataclasses import dataclass

import numpy as np

from rbpf.core.archive import checked, within
from rbpf.core.genealogy import Lineage, Schedule
from rbpf.errors import InputError


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
        """The inverse of `arrays`.

        Raises:
            InputError: an array is missing, or is not what it should be.
        """
        self.blocks, self._by_generation = [], {}
        self._schedule = Schedule.of(checked(arrays, "history/due", (None, 2), "i"))
        generations = checked(arrays, "history/generations", (None,), "i").tolist()
        for number, generation in enumerate(generations):
            self.lineage.take_up(generation)
            block = self._block(number, generation, arrays)
            self.blocks.append(block)
            self._by_generation[generation] = block
        if (np.diff(generations) <= 0).any():
            raise InputError("the generations of the history do not ascend")
        self._steps = self.stamps_ns.size

    def _block(self, number: int, generation: int, arrays: dict[str, np.ndarray]) -> PathBlock:
        name, n = f"history/{number}", self.lineage.n
        kept = within(arrays, f"{name}/kept", None, 0, n)
        stamps = checked(arrays, f"{name}/stamps_ns", (None,), "i").tolist()
        states = checked(arrays, f"{name}/states", (len(stamps), kept.size, None), "f")
        weights = checked(arrays, f"{name}/log_weights", (len(stamps), n) if self.clouds else (0,), "f")
        alive = self.lineage.survivors(generation)
        if not stamps or (np.diff(kept) <= 0).any() or np.setdiff1d(alive, kept).size:
            raise InputError(f"the array {name}/kept does not hold the particles that have descendants")
        return PathBlock(generation, kept, stamps, list(states.copy()), list(weights.copy()))

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
            alive = self.lineage.survivors(generation)
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
