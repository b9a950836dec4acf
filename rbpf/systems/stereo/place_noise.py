"""How far a keypoint is from the place of its landmark: learnt from what the map makes of it."""

from typing import final

import numpy as np

from rbpf.core.checkpoint import integers, numbers, read
from rbpf.systems.system import MAP_IDS

#: Measured numbers that a landmark's noise is worth before it is seen again, and that of all landmarks at first.
OWN_NUMBERS, PRIOR_NUMBERS = 6.0, 30.0
_SCHEMA = {
    "ids": integers("learnt", least=0, ascending=True, refers=MAP_IDS),
    "own": numbers("learnt", 2),
    "all": numbers(2),
}


@final
class PlaceNoise:
    """What each landmark's keypoint adds to its noise: a factor of the variance that its scale says, learnt as it is seen.

    A keypoint on a corner of a thing keeps its place; one on an edge with something farther behind it has none, and moves
    along as the view does. Given what the map knows after an update, Rᵢ⁻¹ (e eᵀ + cov e) has 3 times the factor on its trace,
    on average (variational Bayes: S. Särkkä and A. Nummenmaa 2009). A new landmark has the mean of all others'.
    """

    def __init__(self) -> None:
        self._ids = np.zeros(0, dtype=np.int64)
        self._own = np.zeros((0, 2))  # of each landmark the sum of these traces, and how many numbers they are of
        self._all = np.full(2, PRIOR_NUMBERS)  # the same of all there ever were; at first as the scale says

    def factor(self, ids: np.ndarray) -> np.ndarray:
        """Of landmarks (k,), some of which may be new."""
        own, known = np.zeros((ids.size, 2)), np.isin(ids, self._ids)
        own[known] = self._own[np.searchsorted(self._ids, ids[known])]
        return (OWN_NUMBERS * self._all[0] / self._all[1] + own[:, 0]) / (OWN_NUMBERS + own[:, 1])

    def learn(self, ids: np.ndarray, error: np.ndarray, cov: np.ndarray, noise: np.ndarray) -> None:
        """From residuals (k, 3) after an update, with covariances (k, 3, 3), of landmarks (k,) of such noise (k, 3, 3)."""
        seen = np.einsum("kab,kba->k", np.linalg.inv(noise), error[:, :, None] * error[:, None] + cov)
        held = np.union1d(self._ids, ids)
        own = np.zeros((held.size, 2))
        own[np.searchsorted(held, self._ids)] = self._own
        found = np.column_stack([seen, np.full(ids.size, error.shape[1])])
        own[np.searchsorted(held, ids)] += found
        self._ids, self._own, self._all = held, own, self._all + found.sum(axis=0)

    def remove(self, ids: np.ndarray) -> None:
        kept = ~np.isin(self._ids, ids)
        self._ids, self._own = self._ids[kept], self._own[kept]

    def arrays(self) -> dict[str, np.ndarray]:
        return {"noise/ids": self._ids, "noise/own": self._own, "noise/all": self._all}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self._ids, self._own, self._all = read(arrays, _SCHEMA, "noise/").values()
