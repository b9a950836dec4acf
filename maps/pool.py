"""Memory for the records of a store: dense slabs and compacted columns, and how a kernel reaches the slabs."""

from dataclasses import dataclass

import numpy as np

_FIRST_SLABS = 32


class Pool:
    """Dense slabs (slabs, fields, N) of equal record size, recycled through a free list.

    Args:
        fields: numbers per record.
        n: particles.
    """

    def __init__(self, fields: int, n: int) -> None:
        self.data = np.zeros((_FIRST_SLABS, fields, n))
        self._free = list(range(_FIRST_SLABS - 1, -1, -1))

    @property
    def used(self) -> int:
        """Number of slabs in use."""
        return self.data.shape[0] - len(self._free)

    def take(self, count: int) -> np.ndarray:
        """Free slabs, (count,) int; the pool doubles where there are too few."""
        while len(self._free) < count:
            old = self.data.shape[0]
            self.data = np.concatenate([self.data, np.zeros_like(self.data)])
            self._free = list(range(2 * old - 1, old - 1, -1)) + self._free
        taken = self._free[: -count - 1 : -1]
        del self._free[len(self._free) - count :]
        return np.array(taken, dtype=np.int64)

    def give(self, slabs: np.ndarray) -> None:
        """Returns slabs."""
        self._free.extend(slabs.tolist())


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
