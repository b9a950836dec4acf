"""Descriptors of landmarks in one array, which grows and shrinks with the map."""

from typing import final

import numpy as np

from rbpf.errors import InputError


@final
class DescriptorStore:
    """Descriptors of landmarks, which come and go.

    Args:
        length: of a descriptor.
    """

    def __init__(self, length: int) -> None:
        self.length = length
        self._descriptors = np.zeros((64, length), dtype=np.float32)
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
    def descriptors(self) -> np.ndarray:
        """(M, d) float32, in the order of the ids."""
        return self._descriptors[: self._count]

    def add(self, ids: np.ndarray, descriptors: np.ndarray) -> None:
        """Adds descriptors (k, d) of new landmarks (k,).

        Raises:
            InputError: the ids do not ascend beyond those held, or the descriptors have another length.
        """
        ids = np.asarray(ids, dtype=np.int64)
        if descriptors.shape != (ids.size, self.length):
            raise InputError(
                f"descriptors must be ({ids.size}, {self.length}), one for each id, got {descriptors.shape}"
            )
        last = self._ids[self._count - 1 : self._count]
        if (np.diff(np.concatenate([last, ids])) <= 0).any():
            raise InputError(
                "ids of new descriptors must ascend, and be above those held: take the map's own"
            )
        total = self._count + ids.size
        self._reserve(total)
        self._ids[self._count : total], self._descriptors[self._count : total] = ids, descriptors
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
        self._ids[start:total], self._descriptors[start:total] = self._ids[kept], self._descriptors[kept]
        self._count = total

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Rows (k,) of landmarks (k,).

        Raises:
            InputError: one is not held.
        """
        ids = np.asarray(ids, dtype=np.int64)
        rows, held = self.find(ids)
        if not held.all():
            raise InputError(f"there is no descriptor of landmark {ids[~held][0]}")
        return rows

    def find(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (k,) of landmarks (k,), and whether each is held (k,); the row of one that is not means nothing."""
        rows = np.minimum(np.searchsorted(self.ids, ids), max(self._count - 1, 0))
        return rows, (self.ids[rows] == ids) if self._count else np.zeros(rows.shape, dtype=bool)

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {"descriptors/ids": self.ids.copy(), "descriptors/descriptors": self.descriptors.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self._ids, self._descriptors = (
            arrays["descriptors/ids"].copy(),
            arrays["descriptors/descriptors"].copy(),
        )
        self._count, self.length = self._ids.size, self._descriptors.shape[1]
        self.restored += 1

    def _reserve(self, count: int) -> None:
        if count > self._ids.size:
            room = max(count, 2 * self._ids.size)
            ids, descriptors = np.zeros(room, dtype=np.int64), np.zeros((room, self.length), dtype=np.float32)
            ids[: self._count], descriptors[: self._count] = self.ids, self.descriptors
            self._ids, self._descriptors = ids, descriptors
