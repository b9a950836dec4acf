"""How exact what is measured in images is: learnt from what the map makes of it."""

from collections.abc import Callable
from typing import ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, integers, numbers
from rbpf.core.models import Observations
from rbpf.systems.system import MAP_IDS

#: Measured numbers that a landmark's noise is worth before it is seen again, and that of all landmarks at first.
OWN_NUMBERS, PRIOR_NUMBERS = 6.0, 30.0


@final
class LearntNoise(Kept):
    """A factor of the variance that is stated for what is measured, learnt as landmarks are seen: of each its own, or of all.

    A keypoint on a corner of a thing keeps its place; one on an edge with something farther behind it has none, and moves
    along as the view does. Given what the map knows after an update, Rᵢ⁻¹ (e eᵀ + cov e) has p times the factor on its trace
    for p numbers, on average (variational Bayes: S. Särkkä and A. Nummenmaa 2009). A new landmark has the mean of all others'.

    Args:
        alike: no landmark has a factor of its own, but that of all.
        right: as long as the factor of all is not above this, what is stated is right, and it is 1.
    """

    kept: ClassVar = {
        "_ids": integers("learnt", least=0, ascending=True, refers=MAP_IDS),
        "_own": numbers("learnt", 2),
        "_all": numbers(2),
    }
    prefix = "noise/"

    def __init__(self, alike: bool = False, right: float = 0.0) -> None:
        self.alike, self.right = alike, right
        self._ids = np.zeros(0, dtype=np.int64)
        self._own = np.zeros((0, 2))  # of each landmark the sum of these traces, and how many numbers they are of
        self.expect(1.0)

    def expect(self, factor: float) -> None:
        """Begins to learn about all landmarks anew, from a first guess."""
        self._all = np.array([factor * PRIOR_NUMBERS, PRIOR_NUMBERS])  # the same of all there ever were

    @property
    def mean(self) -> float:
        """Of all landmarks."""
        found = float(self._all[0] / self._all[1])
        return found if found > self.right else 1.0

    def factor(self, ids: np.ndarray) -> np.ndarray:
        """Of landmarks (k,), some of which may be new."""
        if self.alike:
            return np.full(ids.size, self.mean)
        own, known = np.zeros((ids.size, 2)), np.isin(ids, self._ids)
        own[known] = self._own[np.searchsorted(self._ids, ids[known])]
        return (OWN_NUMBERS * self._all[0] / self._all[1] + own[:, 0]) / (OWN_NUMBERS + own[:, 1])

    def learn_from(self, group: Observations, expected: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> None:
        """From what an update by a group has left of its innovations, but for outliers.

        `expected` says where landmarks (k,) should be seen by now, (k, p) with covariances (k, p, p).
        """
        assert group.ids is not None
        sure = group.ids >= 0
        if group.log_odds is not None:
            sure &= group.log_odds >= 0.0
        if sure.any():
            ids = group.ids[sure]
            mean, cov = expected(ids)
            self.learn(ids, group.z[sure] - mean, cov, group.cov[sure] / self.factor(ids)[:, None, None])

    def learn(self, ids: np.ndarray, error: np.ndarray, cov: np.ndarray, noise: np.ndarray) -> None:
        """From residuals (k, p) after an update, with covariances (k, p, p), of landmarks (k,) of such noise (k, p, p)."""
        seen = np.einsum("kab,kba->k", np.linalg.inv(noise), error[:, :, None] * error[:, None] + cov)
        if self.alike:
            self._all = self._all + np.array([seen.sum(), error.size])
            return
        held = np.union1d(self._ids, ids)
        own = np.zeros((held.size, 2))
        own[np.searchsorted(held, self._ids)] = self._own
        found = np.column_stack([seen, np.full(ids.size, error.shape[1])])
        own[np.searchsorted(held, ids)] += found
        self._ids, self._own, self._all = held, own, self._all + found.sum(axis=0)

    def remove(self, ids: np.ndarray) -> None:
        kept = ~np.isin(self._ids, ids)
        self._ids, self._own = self._ids[kept], self._own[kept]
