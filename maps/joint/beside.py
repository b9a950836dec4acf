"""Old landmarks next to the sub-map that a joint map is making, where measurements do not say which landmark they are of."""

from collections.abc import Mapping
from copy import copy
from typing import NamedTuple

import numpy as np

from rbpf.core import checkpoint
from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.maps.joint.columns import JointColumns


class Beside(NamedTuple):
    """Old landmarks (K,) at `points` (K, D) as seen from the end of the present sub-map, which does not have them.

    Its own landmarks (M,) are at `theirs` (M, D): as these move, so do the others, by `slope` (KD, MD); `rest` (KD, KD) is
    what is then uncertain about them.
    """

    ids: np.ndarray
    points: np.ndarray
    own: np.ndarray
    theirs: np.ndarray
    slope: np.ndarray
    rest: np.ndarray

    def widened(self, held: JointColumns, mean: np.ndarray, cov: Array) -> tuple[JointColumns, np.ndarray, Array]:
        """What is held, of means (N, n) and covariance (n, n), and beside it what is not."""
        own, new, dim = held.holds(self.own), ~held.holds(self.ids) & (self.ids >= 0), self.points.shape[1]
        columns = held.of_one_kind(self.own[own]).columns.ravel()
        at, rows = np.repeat(own, dim), np.repeat(new, dim)
        slope, rest = self.slope[np.ix_(rows, at)], self.rest[np.ix_(rows, rows)]
        moved, cross = mean[:, columns] - self.theirs[own].ravel(), slope @ cov[columns]
        wide = copy(held)
        wide.add(self.ids[new], held.kinds[0], np.full(int(new.sum()), -1), held.clones[:0])
        mean = np.concatenate([mean, self.points[new].ravel() + moved @ slope.T], axis=1)
        return wide, mean, np.block([[cov, cross.T], [cross, rest + cross[:, columns] @ slope.T]])

    @classmethod
    def restored(cls, arrays: Mapping[str, np.ndarray], dim: int) -> "Beside":
        """What a checkpoint has held of D numbers for each landmark. Raises InputError: it is damaged."""
        schema = {
            "ids": checkpoint.integers("others", least=0), "points": checkpoint.numbers("others", dim),
            "own": checkpoint.integers("own", least=0), "theirs": checkpoint.numbers("own", dim),
            "slope": checkpoint.numbers("rows", "columns"), "rest": checkpoint.numbers("rows", "rows"),
        }  # fmt: skip
        found = cls(**checkpoint.read(arrays, schema, "joint/beside/"))
        if found.slope.shape != (found.points.size, found.theirs.size):
            raise InputError("the array joint/beside/slope does not fit the landmarks beside it")
        return found
