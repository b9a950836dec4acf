"""Which pairs of two sets are possible, so that only these are compared: near on a line, or near to a prediction."""

import numpy as np


def band_pairs(
    first: np.ndarray, second: np.ndarray, reach: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """All pairs (C,), (C,) of numbers (K,) and (M,) that differ by at most the reach (K,) or ()."""
    order = np.argsort(second, kind="stable")
    low = np.searchsorted(second[order], first - reach, side="left")
    count = np.maximum(np.searchsorted(second[order], first + reach, side="right") - low, 0)
    k = np.repeat(np.arange(first.size), count)
    offset = np.arange(k.size) - np.repeat(np.cumsum(count) - count, count)
    return k, order[np.repeat(low, count) + offset]


def gate_pairs(
    z: np.ndarray, noise: np.ndarray, mean: np.ndarray, cov: np.ndarray, gate: float
) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of a measurement and a prediction that are near to one another.

    Args:
        z: (K, p) places of features.
        noise: (K, p, p) their covariances.
        mean: (M, p) predicted places; those that are not finite are near to nothing.
        cov: (M, p, p) their covariances, without the measurements' noise.
        gate: largest squared Mahalanobis distance.

    Returns:
        Rows (C,) of z and (C,) of mean.
    """
    held = np.flatnonzero(np.isfinite(mean).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)))
    mean, cov = mean[held], cov[held]
    widest = np.diagonal(noise, axis1=1, axis2=2).max(axis=0, initial=0.0)
    reach = np.sqrt(gate * (np.diagonal(cov, axis1=1, axis2=2) + widest))
    m, k = band_pairs(mean[:, 0], z[:, 0], reach[:, 0])
    for axis in range(1, z.shape[1]):
        near = np.abs(z[k, axis] - mean[m, axis]) <= reach[m, axis]
        k, m = k[near], m[near]
    near = _squared(z[k] - mean[m], noise[k] + cov[m]) <= gate
    return k[near], held[m[near]]


def _squared(nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (C,) of (C, p) under (C, p, p), by elimination along the pairs; p is 2 or 3."""
    nu, cov = np.ascontiguousarray(nu.T), np.ascontiguousarray(np.moveaxis(cov, 0, -1))
    total = np.zeros(nu.shape[1])
    for j in range(nu.shape[0]):
        total += nu[j] ** 2 / cov[j, j]
        factor = cov[j + 1 :, j] / cov[j, j]
        nu[j + 1 :] -= factor * nu[j]
        cov[j + 1 :, j + 1 :] -= factor[:, None] * cov[None, j, j + 1 :]
    return total
