"""Keys of landmarks in one array, which grows and shrinks with the map."""

from typing import final

import numpy as np

from rbpf.errors import InputError


@final
class KeyStore:
    """Keys of landmarks, which come and go.

    Args:
        length: of a key.
    """

    def __init__(self, length: int) -> None:
        self.length = length
        self._keys = np.zeros((64, length), dtype=np.float32)
        self._ids = np.zeros(64, dtype=np.int64)
        self._count = 0
        self.restored = 0
        """How often the store was filled from a checkpoint: what was built on it before is void."""

    def __len__(self) -> int:
        return self._count

    @property
    def ids(self) -> np.ndarray:
        """(M,) ascending."""
        return self._ids[: self._count]

    @property
    def keys(self) -> np.ndarray:
        """(M, d) float32, in the order of the ids."""
        return self._keys[: self._count]

    def add(self, ids: np.ndarray, keys: np.ndarray) -> None:
        """Adds keys (k, d) of new landmarks (k,).

        Raises:
            InputError: the ids do not ascend beyond those held, or the keys have another length.
        """
        ids = np.asarray(ids, dtype=np.int64)
        if keys.shape != (ids.size, self.length):
            raise InputError(f"keys must be ({ids.size}, {self.length}), one for each id, got {keys.shape}")
        last = self._ids[self._count - 1 : self._count]
        if (np.diff(np.concatenate([last, ids])) <= 0).any():
            raise InputError("ids of new keys must ascend, and be above those held: take the map's own")
        total = self._count + ids.size
        self._reserve(total)
        self._ids[self._count : total], self._keys[self._count : total] = ids, keys
        self._count = total

    def remove(self, ids: np.ndarray) -> None:
        """Drops landmarks (k,).

        Raises:
            InputError: one is not held.
        """
        rows = self.rows(ids)
        if not rows.size:
            return
        # What is removed is mostly young: only what follows the first of them moves.
        start = int(rows.min())
        kept = np.delete(np.arange(start, self._count), rows - start)
        total = start + kept.size
        self._ids[start:total], self._keys[start:total] = self._ids[kept], self._keys[kept]
        self._count = total

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Rows (k,) of landmarks (k,).

        Raises:
            InputError: one is not held.
        """
        ids = np.asarray(ids, dtype=np.int64)
        rows, held = self.find(ids)
        if not held.all():
            raise InputError(f"there is no key of landmark {ids[~held][0]}")
        return rows

    def find(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (k,) of landmarks (k,), and whether each is held (k,); the row of one that is not means nothing."""
        rows = np.minimum(np.searchsorted(self.ids, ids), max(self._count - 1, 0))
        return rows, (self.ids[rows] == ids) if self._count else np.zeros(rows.shape, dtype=bool)

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {"keys/ids": self.ids.copy(), "keys/keys": self.keys.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self._ids, self._keys = arrays["keys/ids"].copy(), arrays["keys/keys"].copy()
        self._count, self.length = self._ids.size, self._keys.shape[1]
        self.restored += 1

    def _reserve(self, count: int) -> None:
        if count > self._ids.size:
            room = max(count, 2 * self._ids.size)
            ids, keys = np.zeros(room, dtype=np.int64), np.zeros((room, self.length), dtype=np.float32)
            ids[: self._count], keys[: self._count] = self.ids, self.keys
            self._ids, self._keys = ids, keys
