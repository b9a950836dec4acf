"""Colours for points by how certain they are: dark blue (certain) to yellow (uncertain), on a logarithmic scale."""

import numpy as np
from numpy.typing import NDArray

from rbpf.lie import Array

_STOPS = np.array([[13, 8, 135], [126, 3, 168], [204, 71, 120], [248, 149, 64], [240, 249, 33]], dtype=float)
_QUANTILES = (0.05, 0.95)


def standard_deviations(cov: Array) -> Array:
    """Root of the mean variance per axis of covariances (…, n, n) [m]: (…)."""
    return np.sqrt(np.trace(cov, axis1=-2, axis2=-1) / cov.shape[-1])


def colours_by_sigma(std: Array) -> NDArray[np.uint8]:
    """RGB (M, 3) of standard deviations (M,); the scale reaches from their 5 % to their 95 % quantile."""
    if not len(std):
        return np.zeros((0, 3), dtype=np.uint8)
    logs = np.log(np.maximum(std, np.finfo(float).tiny))
    low, high = np.quantile(logs, _QUANTILES)
    fraction = np.clip((logs - low) / max(float(high - low), np.finfo(float).tiny), 0.0, 1.0)
    at = fraction * (len(_STOPS) - 1)
    stops = np.arange(len(_STOPS))
    return np.stack([np.interp(at, stops, channel) for channel in _STOPS.T], axis=-1).round().astype(np.uint8)
