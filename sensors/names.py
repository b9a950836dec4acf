"""Which landmark a recording's name stands for."""

from itertools import takewhile
from typing import Any, final


@final
class Names:
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
        added = list(takewhile(lambda landmark_id: landmark_id > seen, reversed(catalogue)))
        if known is catalogue and len(catalogue) == size + len(added):
            self._ids.update((catalogue[landmark_id], landmark_id) for landmark_id in reversed(added))
        else:
            self._ids = {name: landmark_id for landmark_id, name in catalogue.items()}
        self._read = (catalogue, len(catalogue), last)
        return self._ids
