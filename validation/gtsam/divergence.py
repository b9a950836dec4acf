"""How different two Gaussians are, for stacks of them.

The difference of the means is told in units of one's standard deviations; S. Kullback and R. Leibler (1951) and
A. Bhattacharyya (1943) compare the whole densities, in natural units of information.
"""

import numpy as np

from rbpf.lie import Array


def mahalanobis(delta: Array, cov: Array) -> Array:
    """sqrt(δᵀ P⁻¹ δ) of (…, n) and (…, n, n): (…)."""
    return np.sqrt(np.einsum("...i,...i->...", delta, _solve(cov, delta)))


def kullback_leibler(delta: Array, cov_p: Array, cov_q: Array) -> Array:
    """KL(p ‖ q) of Gaussians whose means differ by δ (…, n), with covariances (…, n, n) [nats]: (…)."""
    trace = np.trace(np.linalg.solve(cov_q, cov_p), axis1=-2, axis2=-1)
    shift = np.einsum("...i,...i->...", delta, _solve(cov_q, delta))
    return np.asarray(0.5 * (trace + shift - delta.shape[-1] + _log_det(cov_q) - _log_det(cov_p)))


def bhattacharyya(delta: Array, cov_p: Array, cov_q: Array) -> Array:
    """Bhattacharyya's distance, −log ∫ √(p q); symmetric and 0 for equal Gaussians: (…)."""
    middle = 0.5 * (cov_p + cov_q)
    shift = np.einsum("...i,...i->...", delta, _solve(middle, delta))
    return 0.125 * shift + 0.5 * (_log_det(middle) - 0.5 * (_log_det(cov_p) + _log_det(cov_q)))


def sigma_ratio(cov_p: Array, cov_q: Array) -> Array:
    """Mean standard deviation of p over that of q, (|P| / |Q|)^(1/2n): below 1 where p is the more certain: (…)."""
    return np.asarray(np.exp(0.5 * (_log_det(cov_p) - _log_det(cov_q)) / cov_p.shape[-1]), dtype=np.float64)


def _solve(cov: Array, delta: Array) -> Array:
    return np.asarray(np.linalg.solve(cov, delta[..., None])[..., 0], dtype=np.float64)


def _log_det(cov: Array) -> Array:
    return np.asarray(np.linalg.slogdet(cov)[1], dtype=np.float64)
