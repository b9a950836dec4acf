"""How exact what is measured in images is: learnt from what the map makes of it."""

from collections.abc import Callable
from typing import ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, integers, numbers
from rbpf.core.models import Observations
from rbpf.systems.system import MAP_IDS

#: Measured numbers that a landmark's noise is worth before it is seen again, and that of all landmarks at first.
OWN_NUMBERS, PRIOR_NUMBERS = 6.0, 30.0
LEAST_REDUNDANCY = 0.05  #: Of each measured number: where the residual is all but explained away, little is learnt.
OUTLYING = 4.0  #: Times the variance of the median landmark, beyond which one is an outlier: two standard deviations.
RECENT = 200  #: Landmarks of which the median is taken, those with the largest ids.
EXACT = 1e-4  #: Times what is stated, least variance of the median landmark: pixels of a simulation may have none.
NOBODY = -2  #: No landmark's name, behind those that are known; −1 stands for what has none.
RIGHT = 1.1  #: Times a standard deviation, up to which it is right: as much as a report has for right.


@final
class LearntNoise(Kept):
    """A factor of the variance that is stated for what is measured, learnt as landmarks are seen: of each its own, or of all.

    A keypoint on a corner of a thing keeps its place; one on an edge with something farther behind it has none, and slides
    as the view changes. The factor is a variance component (W. Förstner 1979), Σ eᵀR⁻¹e of the residuals e after updates,
    over their redundancy Σ (p − tr R⁻¹ cov e) of p measured numbers each. A new landmark has the mean of all others'.

    Args:
        shared: all landmarks have one factor, but outliers: they have as many times more as their variance is beyond
            `OUTLYING` times that of the median landmark. What slides would else take along a map whose other landmarks keep
            their places, however well they do.
        right: of a shared factor, up to which what is stated is right, and it is 1.
    """

    kept: ClassVar = {
        "_ids": integers("learnt", least=0, ascending=True, refers=MAP_IDS),
        "_own": numbers("learnt", 2),
        "_all": numbers(2),
    }
    prefix = "noise/"

    def __init__(self, shared: bool = False, right: float = 0.0) -> None:
        self.shared, self.right = shared, right
        self._ids = np.zeros(0, dtype=np.int64)
        self._own = np.zeros((0, 2))  # of each landmark the two sums
        self._median = self._own, 1.0  # of which sums it is the median, and the median
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
        own, at = np.zeros((ids.size, 2)), np.searchsorted(self._ids, ids)
        known = np.append(self._ids, NOBODY)[at] == ids
        own[known] = self._own[at[known]]
        usual = self._usual() if self.shared else float(self._all[0] / self._all[1])
        found = (OWN_NUMBERS * usual + own[:, 0]) / (OWN_NUMBERS + own[:, 1])
        return self.mean * np.maximum(found / (OUTLYING * usual), 1.0) if self.shared else found

    def _usual(self) -> float:
        """Factor of the median landmark, among the last that have been seen often enough to tell."""
        if self._median[0] is not self._own:
            total, numbers = self._own[-RECENT:].T
            tells = numbers >= OWN_NUMBERS
            median = float(np.median(total[tells] / numbers[tells])) if tells.any() else 1.0
            self._median = self._own, max(median, EXACT)
        return self._median[1]

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
            self.learn(ids, group.z[sure] - mean, cov, group.cov[sure])

    def learn(self, ids: np.ndarray, error: np.ndarray, cov: np.ndarray, noise: np.ndarray) -> None:
        """From residuals (k, p) of landmarks (k,) after an update with the noise (k, p, p); of covariances (k, p, p)."""
        information, p = np.linalg.inv(noise), error.shape[1]
        # The noise that the update had is what is stated times the factor so far.
        squared = self.factor(ids) * np.einsum("ka,kab,kb->k", error, information, error)
        redundancy = p - np.einsum("kab,kba->k", information, cov)
        found = np.column_stack([squared, np.maximum(redundancy, LEAST_REDUNDANCY * p)])
        at = np.searchsorted(self._ids, ids)
        new = np.append(self._ids, NOBODY)[at] != ids
        order = np.argsort(ids[new])
        self._ids = np.insert(self._ids, at[new][order], ids[new][order])
        self._own = np.insert(self._own, at[new][order], 0.0, axis=0)
        self._own[np.searchsorted(self._ids, ids)] += found
        if self.shared:
            found = found[self.factor(ids) <= self.mean]  # without outliers
        self._all = self._all + found.sum(axis=0)

    def remove(self, ids: np.ndarray) -> None:
        kept = ~np.isin(self._ids, ids)
        self._ids, self._own = self._ids[kept], self._own[kept]
