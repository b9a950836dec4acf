"""Landmark descriptors and landmark management: candidates are created, confirmed and dropped (S05 §IV–V).

S05 adds 10 to 15 SIFT features per frame whose descriptors differ sufficiently from those in the map, drops one that is not
re-observed within three frames, and confirms it as a landmark after three observations. Until then it is a candidate. Here
there are at most 60 candidates, and new ones are spread over the image. Names of landmarks and candidates are integers that
are never reused.
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

#: Least distance of a new descriptor from others, by its length: those of one point are mostly closer.
DISTINCT = {36: 0.12, 128: 0.3}


@dataclass(frozen=True)
class NewLandmarkConfig(Ranged):
    """Selection of new landmarks, and how long candidates are kept."""

    max_per_frame: Annotated[CountOrNone, Formerly("per_frame")] = 15  #: new candidates in a frame at most.
    #: least distance of a new descriptor from those stored and from other new ones; None for `DISTINCT`.
    distinct: Annotated[float | None, Range(ge=0.0, le=2.0)] = None
    #: least distance of a new candidate's pixel from those of matched features and of other new candidates.
    spacing_px: NotNegative = 10.0
    #: columns and rows of the grid over which new candidates are spread.
    cells: Annotated[int, Range(ge=1, le=1000)] = 6
    patience: Count = 3  #: frames without an observation after which a candidate is dropped.
    #: observations that confirm a candidate as a landmark, the first one included.
    observations: Annotated[Count, Formerly("sightings")] = 3
    max_candidates: Annotated[CountOrNone, Formerly("waiting")] = 60  #: candidates at most.


@final
class LandmarkManager(Kept):
    """Stores descriptors of landmarks and candidates, and counts their observations frame by frame.

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
        #: Name, number of observations, and frame of the last observation, of each.
        self._table = np.zeros((0, 3), dtype=np.int64)

    def __len__(self) -> int:
        return len(self._table)

    @property
    def names(self) -> np.ndarray:
        """(M,) names of all landmarks and candidates, ascending."""
        return self._table[:, 0]

    @property
    def observations(self) -> np.ndarray:
        """(M,) number of observations of each."""
        return self._table[:, 1]

    @property
    def unseen_for(self) -> np.ndarray:
        """(M,) frames since the last observation of each."""
        return self.frame - self._table[:, 2]

    @property
    def confirmed(self) -> np.ndarray:
        """(M,) whether each is a landmark."""
        return self.observations >= self.config.observations

    def find(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (k,) of landmarks (k,), and whether each is stored (k,); if not, its row is meaningless."""
        rows = np.minimum(np.searchsorted(self.names, names), max(len(self) - 1, 0))
        return rows, (self.names[rows] == names) if len(self) else np.zeros(rows.shape, dtype=bool)

    def rows(self, names: np.ndarray) -> np.ndarray:
        """Rows (k,) of landmarks (k,). Raises InputError: one is not stored."""
        names = np.asarray(names, dtype=np.int64)
        rows, held = self.find(names)
        if not held.all():
            raise InputError(f"there is no landmark named {names[~held][0]}")
        return rows

    def match(self, descriptors: np.ndarray, limits: MatchLimits) -> np.ndarray:
        """The landmark (K,) of each descriptor (K, d), each once, NULL for none. Raises InputError: d is another one."""
        if descriptors.ndim != 2 or descriptors.shape[1] != self.length:
            raise InputError(f"descriptors must be (K, {self.length}), got {descriptors.shape}")
        matches = match_all(descriptors, self.descriptors, limits)
        names = np.full(len(descriptors), NULL, dtype=np.int64)
        names[matches.first] = self.names[matches.second]
        return names

    def nearest(self, descriptors: np.ndarray) -> np.ndarray:
        """Distance (K,) of each descriptor (K, d) to the nearest stored one, infinite if there is none."""
        return distances(two_best(descriptors, self.descriptors)[0])

    def copied(self) -> "LandmarkManager":
        """A copy, to try out the effect of a frame."""
        other = copy(self)
        other._table = self._table.copy()  # nothing else is changed in place
        return other

    def observe(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begins a frame that re-observes landmarks (k,); returns names (j,) and rows (j,) of those dropped.

        Raises InputError: one is not stored.
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
        """Selects the features (k,) of a frame that become new candidates, in their order.

        Args:
            px: (K, 2) pixels of features that matched no landmark, best first.
            descriptors: (K, d) float32 of length 1.
            nearest: (K,) distances of these from the nearest stored descriptor, infinite if there is none.
            taken: (L, 2) pixels of the features that did match.
        """
        room = min(self.config.max_per_frame, self.config.max_candidates - int((~self.confirmed).sum()))
        distinct = self.config.distinct
        if distinct is None:
            distinct = DISTINCT.get(self.length, 0.0)
        # Features of the emptiest cells first; within a cell in their order.
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
            # Distant enough from stored landmarks and from others of the frame, in the image and by descriptor.
            others = np.concatenate([taken, px[chosen]])
            if nearest[row] < distinct:
                continue
            if (np.square(others - px[row]).sum(axis=1) < self.config.spacing_px**2).any():
                continue
            if not (distances(descriptors[chosen] @ descriptors[row]) < distinct).any():
                chosen.append(row)
        return np.array(sorted(chosen), dtype=np.int64)

    def add(self, descriptors: np.ndarray) -> np.ndarray:
        """Adds candidates with descriptors (k, d), first observed in this frame; returns their names (k,)."""
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
            raise InputError("the landmarks' names are not ascending, or not below the next new name")

    def _cell(self, px: np.ndarray) -> np.ndarray:
        column, line = np.clip(px * self.config.cells / np.array(self.size), 0, self.config.cells - 1).T
        return column.astype(np.int64) + self.config.cells * line.astype(np.int64)
