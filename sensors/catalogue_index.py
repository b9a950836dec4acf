"""Which landmark a recording's name stands for."""

from itertools import takewhile
from typing import Any, final

import numpy as np

from rbpf.core.models import NULL


@final
class NameIndex:
    """The catalogue read backwards: name → id, looked up again only where the catalogue has changed."""

    def __init__(self) -> None:
        self._ids: dict[Any, int] = {}
        self._read: tuple[dict[int, Any] | None, int, int] = (None, 0, -1)

    def ids(self, catalogue: dict[int, Any]) -> dict[Any, int]:
        """Ids by name; they only grow, so size and last id tell whether the catalogue has changed.

        What was added since is read from its end; only after a removal is all of it read again.
        """
        last = next(reversed(catalogue), -1)
        known, size, seen = self._read
        if known is catalogue and (len(catalogue), last) == (size, seen):
            return self._ids
        added = _added(catalogue, seen)
        if known is catalogue and len(catalogue) == size + len(added):
            self._ids.update((catalogue[landmark_id], landmark_id) for landmark_id in reversed(added))
        else:
            self._ids = {name: landmark_id for landmark_id, name in catalogue.items()}
        self._read = (catalogue, len(catalogue), last)
        return self._ids


@final
class NumberIndex:
    """The same for names that are whole numbers from 0 up and never used again: an array.

    A removal leaves it as it is, so that a large map need not be read again: what is removed must not be asked for.
    """

    def __init__(self) -> None:
        self._ids = np.full(64, NULL, dtype=np.int64)
        self._last = -1

    def ids(self, catalogue: dict[int, Any], names: np.ndarray) -> np.ndarray:
        """Ids (k,) of names (k,)."""
        for landmark_id in _added(catalogue, self._last):
            name = catalogue[landmark_id]
            if name >= self._ids.size:
                self._ids = np.concatenate([self._ids, np.full(name + 1, NULL, dtype=np.int64)])
            self._ids[name] = landmark_id
            self._last = max(self._last, landmark_id)
        return np.asarray(self._ids[names])


def _added(catalogue: dict[int, Any], last: int) -> list[int]:
    """Ids that came after `last`, read from the catalogue's end."""
    return list(takewhile(lambda landmark_id: landmark_id > last, reversed(catalogue)))
