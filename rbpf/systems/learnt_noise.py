"""Learns the noise of image measurements from the residuals of the map."""

from collections.abc import Callable
from typing import ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, integers, numbers
from rbpf.core.models import Observations
from rbpf.systems.system import MAP_IDS

#: Prior strength, in measured components, of a landmark's noise factor, and of the common one.
OWN_NUMBERS, PRIOR_NUMBERS = 6.0, 30.0
LEAST_REDUNDANCY = 0.05  #: Least redundancy per measured component: a smaller one tells little about the noise.
OUTLYING = 4.0  #: Landmarks beyond this multiple of the median landmark's variance (two σ) are outliers.
RECENT = 200  #: Number of landmarks in the median, those with the largest ids.
EXACT = 1e-4  #: Lower bound of the median landmark's variance relative to the stated one: simulations may have none.
NOBODY = -2  #: A name that no landmark has, unlike −1, which stands for features without a landmark.
RIGHT = 1.1  #: Tolerance of a correct standard deviation, as in the report.


@final
class LearntNoise(Kept):
    """Learns a factor of the stated measurement variance from re-observed landmarks: one per landmark, or a common one.

    A keypoint on the corner of an object stays at its position; one on an occlusion boundary slides as the view changes. The
    factor is a variance component (W. Förstner 1979): Σ eᵀR⁻¹e of the residuals e after updates, over their redundancy Σ (p −
    tr R⁻¹ cov e) for p components each. A new landmark has the mean factor of all others.

    Args:
        shared: all landmarks have one factor, except outliers: theirs is larger by the ratio of their variance to `OUTLYING`
            times that of the median landmark. Sliding landmarks would otherwise drag a map whose other landmarks are stable.
        right: of a shared factor: up to it the stated noise counts as right, and the factor is 1.
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
        self._own = np.zeros((0, 2))  # the two sums of each landmark
        self._median = self._own, 1.0  # the sums at the last median, and the median
        self.expect(1.0)

    def expect(self, factor: float) -> None:
        """Restarts the learning of the common factor from an initial guess."""
        self._all = np.array([factor * PRIOR_NUMBERS, PRIOR_NUMBERS])  # the same over all landmarks so far

    @property
    def mean(self) -> float:
        """The factor over all landmarks."""
        found = float(self._all[0] / self._all[1])
        return found if found > self.right else 1.0

    def factor(self, ids: np.ndarray) -> np.ndarray:
        """The factor of landmarks (k,), some of which may be new."""
        own, at = np.zeros((ids.size, 2)), np.searchsorted(self._ids, ids)
        known = np.append(self._ids, NOBODY)[at] == ids
        own[known] = self._own[at[known]]
        usual = self._usual() if self.shared else float(self._all[0] / self._all[1])
        found = (OWN_NUMBERS * usual + own[:, 0]) / (OWN_NUMBERS + own[:, 1])
        return self.mean * np.maximum(found / (OUTLYING * usual), 1.0) if self.shared else found

    def _usual(self) -> float:
        """Factor of the median landmark, among the latest that have been observed often enough."""
        if self._median[0] is not self._own:
            total, numbers = self._own[-RECENT:].T
            tells = numbers >= OWN_NUMBERS
            median = float(np.median(total[tells] / numbers[tells])) if tells.any() else 1.0
            self._median = self._own, max(median, EXACT)
        return self._median[1]

    def learn_from(self, group: Observations, expected: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> None:
        """Learns from the residuals that an update leaves of a group's inliers.

        `expected` predicts landmarks (k,) after the update: (k, p) with covariances (k, p, p).
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
        """Learns from residuals (k, p) of landmarks (k,), of covariances (k, p, p), after an update with noise (k, p, p)."""
        information, p = np.linalg.inv(noise), error.shape[1]
        # The update's noise is the stated one times the factor so far.
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
