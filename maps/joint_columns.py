"""Which landmarks and clones a joint map holds, and in which columns of its Gaussian."""

from typing import NamedTuple

import numpy as np

from rbpf.core.models import Landmark
from rbpf.errors import InputError


class Table(NamedTuple):
    """What is held of landmarks (M,): names, kinds by number, first columns, and rows of the clones they are anchored at."""

    ids: np.ndarray
    kind: np.ndarray
    first: np.ndarray
    clone: np.ndarray  #: −1 where they are not.


class Kind(NamedTuple):
    """Landmarks of one kind, K of them, as rows of the table (K,)."""

    landmark: Landmark
    rows: np.ndarray
    columns: np.ndarray  #: (K, D) of their means.
    clones: np.ndarray  #: (K, d) columns of what they are anchored at; (K, 0) where they are not.
    by_clone: np.ndarray  #: (K,) which clones these are.


class JointColumns:
    """Finds landmarks by name and by kind.

    Args:
        dim: d, columns of a clone.
        kinds: the parametrisations, by their numbers.

    Attributes:
        table: the landmarks held; `hold` replaces it.
        clone_first: (C,) first columns of the clones.
    """

    def __init__(self, dim: int, kinds: list[Landmark]) -> None:
        none = np.zeros(0, dtype=np.int64)
        self.dim, self.kinds, self.clone_first = dim, kinds, none
        self.hold(Table(none, none, none, none))

    def hold(self, table: Table) -> None:
        self.table = table
        self._row_of = {landmark: row for row, landmark in enumerate(table.ids.tolist())}

    def holds(self, ids: np.ndarray) -> np.ndarray:
        """Which landmarks (K,) there are."""
        return np.array([landmark in self._row_of for landmark in np.asarray(ids).tolist()], dtype=bool)

    def rows_of(self, ids: np.ndarray) -> np.ndarray:
        """Rows (K,) of landmarks in the table. Raises InputError: the map does not hold one of them."""
        try:
            return np.array([self._row_of[landmark] for landmark in np.asarray(ids).tolist()], dtype=np.int64)
        except KeyError as error:
            raise InputError(f"the map holds no landmark {error.args[0]}") from error

    def number(self, landmark: Landmark) -> int:
        """Of a parametrisation; −1 for one that the map does not know."""
        for number, held in enumerate(self.kinds):
            if type(held) is type(landmark) and vars(held) == vars(landmark):
                return number
        return -1

    def of_one_kind(self, ids: np.ndarray) -> Kind:
        """Landmarks (K,) of one kind, in their order. Raises InputError: the map does not hold one, or their kinds differ."""
        rows = self.rows_of(ids)
        kinds = np.unique(self.table.kind[rows])
        if kinds.size > 1:
            raise InputError("a joint map is asked for landmarks of one parametrisation at a time: see `landmark_of`")
        return self._of_kind(int(kinds[0]) if kinds.size else 0, rows)

    def by_kind(self) -> list[Kind]:
        """All landmarks."""
        numbers = np.unique(self.table.kind).tolist()
        return [self._of_kind(number, np.flatnonzero(self.table.kind == number)) for number in numbers]

    def clone_columns(self, clones: np.ndarray) -> np.ndarray:
        """Columns (K, d) of clones (K,)."""
        return self.clone_first[clones, None] + np.arange(self.dim)

    def _of_kind(self, number: int, rows: np.ndarray) -> Kind:
        landmark, clones = self.kinds[number], self.table.clone[rows]
        columns = self.table.first[rows, None] + np.arange(landmark.dim)
        at = self.clone_columns(clones) if landmark.anchored else np.zeros((rows.size, 0), dtype=np.int64)
        return Kind(landmark, rows, columns, at, clones)
