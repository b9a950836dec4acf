"""Which landmark a recording's name stands for."""

from typing import Any, final


@final
class Names:
    """The catalogue read backwards: name → id, looked up again only where the catalogue has changed."""

    def __init__(self) -> None:
        self._ids: dict[Any, int] = {}
        self._read: tuple[dict[int, Any] | None, int, int] = (None, 0, -1)

    def ids(self, catalogue: dict[int, Any]) -> dict[Any, int]:
        """Ids by name; they only grow, so size and last id tell whether the catalogue has changed."""
        last = next(reversed(catalogue), -1)
        if self._read[0] is not catalogue or self._read[1:] != (len(catalogue), last):
            self._ids = {name: landmark_id for landmark_id, name in catalogue.items()}
            self._read = (catalogue, len(catalogue), last)
        return self._ids
