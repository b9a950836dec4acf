"""Which features become landmarks: candidates are started, confirmed and dropped (S05 §IV–V).

S05 adds 10 to 15 SIFT features per frame whose descriptors are sufficiently distinct from those held, drops one that is
not seen again within three frames, and calls it a landmark once it has been seen three times. Until then it is a
candidate. Here candidates are 60 at most, and new ones are spread over the image. Landmarks and candidates go by names,
whole numbers that are never used again.
"""

from dataclasses import dataclass
from typing import Annotated, final

import numpy as np

from rbpf.core.checkpoint import integers, read
from rbpf.errors import InputError
from rbpf.ranges import Count, CountOrNone, Formerly, NotNegative, Range, Ranged
from rbpf.sensors.descriptors import distances

#: Least distance of a new descriptor from others, by its length: descriptors of one place are mostly nearer.
DISTINCT = {36: 0.12, 128: 0.3}
_KEPT = {"table": integers("landmarks", 3, least=0), "counters": integers(2, least=0)}


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
class LandmarkManager:
    """Counts observations of landmarks and candidates, frame by frame, in images of a size (width, height) [px].

    Call `observe`, then `select`, then `add`.
    """

    def __init__(self, config: NewLandmarkConfig, size: tuple[int, int]) -> None:
        self.config = config
        self.size = size
        self.frame = 0  #: Frames so far.
        self.next_name = 0
        #: Of each descriptor held its name, how often it was seen, and the frame in which it was seen last.
        self._table = np.zeros((0, 3), dtype=np.int64)

    @property
    def names(self) -> np.ndarray:
        """(M,) of the descriptors held, ascending."""
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

    def observe(self, names: np.ndarray) -> np.ndarray:
        """Begins a frame in which landmarks (k,) were seen again; returns names (j,) of those dropped.

        Raises InputError: one is not held.
        """
        names = np.asarray(names, dtype=np.int64)
        rows = np.searchsorted(self.names, names)
        known = rows < self.names.size
        known[known] = self.names[rows[known]] == names[known]
        if not known.all():
            raise InputError(f"there is no landmark named {names[~known][0]}")
        self.frame += 1
        self._table[rows, 1] += 1
        self._table[rows, 2] = self.frame
        overdue = ~self.confirmed & (self.frame - self._table[:, 2] >= self.config.patience)
        dropped = self.names[overdue].copy()
        self._table = self._table[~overdue]
        return dropped

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
            distinct = DISTINCT.get(descriptors.shape[1], 0.0)
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

    def add(self, count: int) -> np.ndarray:
        """Takes in new descriptors, seen for the first time in this frame; returns their names (count,)."""
        names = np.arange(self.next_name, self.next_name + count)
        self.next_name += count
        new = np.column_stack([names, np.ones(count, dtype=np.int64), np.full(count, self.frame)])
        self._table = np.concatenate([self._table, new])
        return names

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {"key_manager/table": self._table.copy(), "key_manager/counters": np.array([self.frame, self.next_name])}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`; errors as `rbpf.core.checkpoint.read`."""
        found = read(arrays, _KEPT, "key_manager/")
        self._table, (self.frame, self.next_name) = found["table"], found["counters"].tolist()
        if (np.diff(self.names, append=self.next_name) <= 0).any():
            raise InputError("the names of the landmarks that are counted do not ascend below the next one")

    def _cell(self, px: np.ndarray) -> np.ndarray:
        column, line = np.clip(px * self.config.cells / np.array(self.size), 0, self.config.cells - 1).T
        return column.astype(np.int64) + self.config.cells * line.astype(np.int64)
