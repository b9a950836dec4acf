"""How landmarks look, and which features become some: candidates are started, confirmed and dropped (S05 §IV–V).

S05 adds 10 to 15 SIFT features per frame whose descriptors are sufficiently distinct from those held, drops one that is
not seen again within three frames, and calls it a landmark once it has been seen three times. Until then it is a
candidate. Here candidates are 60 at most, and new ones are spread over the image. Landmarks and candidates go by names,
whole numbers that are never used again.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Annotated, ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, integers, numbers
from rbpf.core.models import NULL
from rbpf.errors import InputError
from rbpf.ranges import Count, CountOrNone, Formerly, NotNegative, Range, Ranged
from rbpf.sensors.descriptors import MatchLimits, distances, match_all, two_best

#: Least distance of a new descriptor from others, by its length: descriptors of one place are mostly nearer.
DISTINCT = {36: 0.12, 128: 0.3}


@dataclass(frozen=True)
class NewLandmarkConfig(Ranged):
    """Which features become landmarks, and how long candidates are kept."""

    max_per_frame: Annotated[CountOrNone, Formerly("per_frame")] = 15  #: new candidates in a frame at most.
    #: least distance of a new descriptor from those held and from other new ones; None for `DISTINCT`.
    distinct: Annotated[float | None, Range(ge=0.0, le=2.0)] = None
    #: least distance of a new candidate's pixel from those of matched features and of other new candidates.
    spacing_px: NotNegative = 10.0
    #: the image is divided into so many columns and rows, which fill evenly.
    cells: Annotated[int, Range(ge=1, le=1000)] = 6
    patience: Count = 3  #: a candidate that has not been observed in so many frames is dropped.
    #: a candidate that was observed so often is a landmark, the first time included.
    observations: Annotated[Count, Formerly("sightings")] = 3
    max_candidates: Annotated[CountOrNone, Formerly("waiting")] = 60  #: candidates at most.


@final
class LandmarkManager(Kept):
    """Holds landmarks and candidates by their descriptors, and counts observations of them, frame by frame.

    Call `observe`, then `select`, then `add`.

    Args:
        config: settings.
        size: of the images, (width, height) [px].
        length: of a descriptor.
    """

    kept: ClassVar = {
        "descriptors": numbers("landmarks", "length", dtype=np.float32),
        "_table": integers("landmarks", 3, least=0),
        "frame": integers(least=0),
        "next_name": integers(least=0),
    }
    prefix = "key_manager/"

    def __init__(self, config: NewLandmarkConfig, size: tuple[int, int], length: int) -> None:
        self.config = config
        self.size = size
        self.length = length
        self.frame = 0  #: Frames so far.
        self.next_name = 0
        self.descriptors = np.zeros((0, length), dtype=np.float32)  #: (M, d), in the order of the names.
        #: Of each its name, how often it was seen, and the frame in which it was seen last.
        self._table = np.zeros((0, 3), dtype=np.int64)

    def __len__(self) -> int:
        return len(self._table)

    @property
    def names(self) -> np.ndarray:
        """(M,) of what is held, ascending."""
        return self._table[:, 0]

    @property
    def observations(self) -> np.ndarray:
        """(M,) how often each was seen."""
        return self._table[:, 1]

    @property
    def unseen_for(self) -> np.ndarray:
        """(M,) for how many frames each has not been seen."""
        return self.frame - self._table[:, 2]

    @property
    def confirmed(self) -> np.ndarray:
        """(M,) whether each is a landmark."""
        return self.observations >= self.config.observations

    def find(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (k,) of landmarks (k,), and whether each is held (k,); the row of one that is not means nothing."""
        rows = np.minimum(np.searchsorted(self.names, names), max(len(self) - 1, 0))
        return rows, (self.names[rows] == names) if len(self) else np.zeros(rows.shape, dtype=bool)

    def rows(self, names: np.ndarray) -> np.ndarray:
        """Rows (k,) of landmarks (k,); an InputError if one is not held."""
        names = np.asarray(names, dtype=np.int64)
        rows, held = self.find(names)
        if not held.all():
            raise InputError(f"there is no landmark named {names[~held][0]}")
        return rows

    def match(self, descriptors: np.ndarray, limits: MatchLimits) -> np.ndarray:
        """The landmark (K,) of each descriptor (K, d), each once; NULL where there is none, an InputError for another d."""
        if descriptors.ndim != 2 or descriptors.shape[1] != self.length:
            raise InputError(f"descriptors must be (K, {self.length}), got {descriptors.shape}")
        matches = match_all(descriptors, self.descriptors, limits)
        names = np.full(len(descriptors), NULL, dtype=np.int64)
        names[matches.first] = self.names[matches.second]
        return names

    def nearest(self, descriptors: np.ndarray) -> np.ndarray:
        """Distance (K,) of each descriptor (K, d) to the nearest one held, infinite where none is."""
        return distances(two_best(descriptors, self.descriptors)[0])

    def copied(self) -> "LandmarkManager":
        """To be asked what a frame would do to it."""
        other = copy(self)
        other._table = self._table.copy()  # all else is never changed in place
        return other

    def observe(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begins a frame in which landmarks (k,) were seen again; returns names (j,) and rows (j,) of those dropped.

        Raises InputError: one is not held.
        """
        rows = self.rows(names)
        self.frame += 1
        self._table[rows, 1] += 1
        self._table[rows, 2] = self.frame
        overdue = np.flatnonzero(~self.confirmed & (self.unseen_for >= self.config.patience))
        dropped = self.names[overdue]
        if overdue.size:
            self._table, self.descriptors = np.delete(self._table, overdue, 0), np.delete(self.descriptors, overdue, 0)
        return dropped, overdue

    def select(self, px: np.ndarray, descriptors: np.ndarray, nearest: np.ndarray, taken: np.ndarray) -> np.ndarray:
        """Rows (k,) of those features of a frame that are worth a new candidate, in their order.

        Args:
            px: (K, 2) places of features that matched no landmark, best first.
            descriptors: (K, d) float32 of length 1.
            nearest: (K,) distances of these from the nearest descriptor held, infinite where there is none.
            taken: (L, 2) places of the features that did match.
        """
        room = min(self.config.max_per_frame, self.config.max_candidates - int((~self.confirmed).sum()))
        distinct = self.config.distinct
        if distinct is None:
            distinct = DISTINCT.get(self.length, 0.0)
        # Those of the emptiest cells first, in each cell in their order.
        cell = self._cell(px)
        rank, count = (
            np.zeros(cell.size, dtype=np.int64),
            np.bincount(self._cell(taken), minlength=self.config.cells**2),
        )
        for row, place in enumerate(cell.tolist()):
            rank[row] = count[place]
            count[place] += 1
        chosen: list[int] = []
        for row in np.argsort(rank, kind="stable").tolist():
            if len(chosen) >= room:
                break
            # Far enough from what is held, and from others of the frame, in the image and in the descriptor.
            others = np.concatenate([taken, px[chosen]])
            if nearest[row] < distinct:
                continue
            if (np.square(others - px[row]).sum(axis=1) < self.config.spacing_px**2).any():
                continue
            if not (distances(descriptors[chosen] @ descriptors[row]) < distinct).any():
                chosen.append(row)
        return np.array(sorted(chosen), dtype=np.int64)

    def add(self, descriptors: np.ndarray) -> np.ndarray:
        """Takes in descriptors (k, d), seen for the first time in this frame; returns their names (k,)."""
        count = len(descriptors)
        names = np.arange(self.next_name, self.next_name + count)
        self.next_name += count
        new = np.column_stack([names, np.ones(count, dtype=np.int64), np.full(count, self.frame)])
        self._table = np.concatenate([self._table, new])
        self.descriptors = np.concatenate([self.descriptors, descriptors], dtype=np.float32)
        return names

    def restore(self, arrays: Mapping[str, np.ndarray], **sizes: int) -> None:
        """The inverse of `arrays`; errors as `rbpf.core.checkpoint.read`."""
        super().restore(arrays, length=self.length)
        if (np.diff(self.names, append=self.next_name) <= 0).any():
            raise InputError("the landmarks' names do not ascend, or not below the next one")

    def _cell(self, px: np.ndarray) -> np.ndarray:
        column, line = np.clip(px * self.config.cells / np.array(self.size), 0, self.config.cells - 1).T
        return column.astype(np.int64) + self.config.cells * line.astype(np.int64)
