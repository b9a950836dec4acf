"""Likelihoods of an innovation: Gaussian, truncated Mahalanobis (S05 (6)), Gaussian with outliers.

`kernel_id` and `params` name the compiled twin in `rbpf.kernels.gate`.
"""

from copy import copy
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import Likelihood
from rbpf.errors import InputError


@final
class Gaussian(Likelihood):
    """log N(ν; 0, S)."""

    kernel_id = 0

    def __init__(self) -> None:
        self.params = np.zeros(1)

    def log_density(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """(…, p), (…, p, p) → (…)."""
        return gaussian.log_density(nu, cov)


@final
class TruncatedMahalanobis(Likelihood):
    """−½ min(T_l, νᵀS⁻¹ν), S05 (6); a null match costs T_l/2. It is no density: evidence is not defined.

    What T_l bounds is the weight. That a landmark is not updated by what is clipped does not follow, and S05 does not
    say so: at 4.0 a quarter of the true measurements would be lost, those that contradict the particle's map.

    Args:
        limit: T_l, dimensionless; the paper's is 4.0.
        update_limit: νᵀS⁻¹ν beyond which an observation does not move the state or the landmark either; None is T_l.
    """

    normalised = False
    kernel_id = 1

    def __init__(self, limit: float = 4.0, update_limit: float | None = None) -> None:
        if not limit > 0:
            raise InputError(
                f"the limit T_l of a truncated Mahalanobis likelihood must be positive, got {limit}"
            )
        update_limit = limit if update_limit is None else update_limit
        if not update_limit >= limit:
            raise InputError(
                f"the update_limit of a truncated Mahalanobis likelihood must be at least T_l = {limit:g}, "
                f"got {update_limit}"
            )
        self.params = np.array([limit, update_limit], dtype=float)

    def log_density(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """(…, p), (…, p, p) → (…)."""
        return -0.5 * np.minimum(self.params[0], squared_mahalanobis(nu, cov))

    def inlier(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """Within the limit for updates."""
        return squared_mahalanobis(nu, cov) <= self.params[1]

    def predicted_inlier(self, nu: np.ndarray, cov: np.ndarray, predictive: np.ndarray) -> np.ndarray:
        """Within the limit for updates; for the look-ahead, as probable as an outlier."""
        if self.kernel_id == 1:
            return self.inlier(nu, predictive)
        log_ratio = gaussian.log_det(gaussian.cholesky(predictive)) - gaussian.log_det(gaussian.cholesky(cov))
        return squared_mahalanobis(nu, predictive) + log_ratio <= self.params[0]

    def of_look_ahead(self) -> Likelihood:
        """Whose inliers at the prediction are those that T_l does not bound, Mathematics (truncated-look-ahead)."""
        weighing = copy(self)
        weighing.kernel_id = 3
        return weighing

    def log_outlier(self) -> float:
        """−T_l/2."""
        return -0.5 * float(self.params[0])


@final
class GaussianWithOutliers(Likelihood):
    """log[(1−ε) N(ν; 0, S) + ε/V].

    Args:
        rate: ε, the fraction of outliers, in (0, 1).
        volume: V, of the measurement space in which outliers are uniform, in the measurement's units.
    """

    kernel_id = 2

    def __init__(self, rate: float, volume: float) -> None:
        if not 0 < rate < 1 or not volume > 0:
            raise InputError(f"outliers need a rate in (0, 1) and a positive volume, got {rate} and {volume}")
        self.params = np.array([np.log1p(-rate), np.log(rate / volume)])

    def log_density(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """(…, p), (…, p, p) → (…)."""
        return np.logaddexp(gaussian.log_density(nu, cov) + self.params[0], self.params[1])

    def inlier(self, nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """More probable as an inlier than as an outlier."""
        return gaussian.log_density(nu, cov) + self.params[0] >= self.params[1]

    def log_inlier(self) -> float:
        """log(1−ε)."""
        return float(self.params[0])

    def log_outlier(self) -> float:
        """Log ε/V."""
        return float(self.params[1])


def squared_mahalanobis(nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """νᵀS⁻¹ν, (…, p), (…, p, p) → (…)."""
    white = gaussian.solve_lower(gaussian.cholesky(cov), nu)
    return np.square(white).sum(axis=-1)
