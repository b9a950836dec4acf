"""A landmark known to lie on a curve: several weighted Gaussians along it."""

from typing import final

import numpy as np

from rbpf.models import Landmark, Records


@final
class MixturePoint(Landmark):
    """A world point as C weighted Gaussians, as the ring that a range-only beacon leaves.

    Args:
        components: C, at least 2.
        dim: 2 or 3.
        dominant: it is ready to become a single Gaussian when one component has this weight.
    """

    def __init__(self, components: int, dim: int = 2, dominant: float = 0.99) -> None:
        self.components = components
        self.dim = dim
        self.dominant = dominant

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """(…, D) → (…, D+1)."""
        return np.concatenate([mean, np.ones((*mean.shape[:-1], 1))], axis=-1)

    def ready(self, records: Records) -> np.ndarray:
        """Whether one component dominates, (N, K)."""
        assert records.log_weights is not None
        return records.log_weights.max(axis=-1) >= np.log(self.dominant)


def ring(centre: np.ndarray, radius: np.ndarray, std_radius: float, components: int) -> Records:
    """Gaussians along a circle, for a beacon whose range alone was measured.

    Args:
        centre: (N, 2) positions of the sensor.
        radius: (K,) ranges, metres.
        std_radius: of the ranges, metres.
        components: C; neighbours overlap at one standard deviation along the circle.

    Returns:
        Records with means (N, K, C, 2), covariances (N, K, C, 2, 2) and equal weights.
    """
    angle = 2 * np.pi * np.arange(components) / components
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    across = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    mean = centre[:, None, None, :] + radius[None, :, None, None] * along
    half_step = radius * np.sin(np.pi / components)
    cov = std_radius**2 * along[:, :, None] * along[:, None, :] + np.multiply.outer(
        half_step**2, across[:, :, None] * across[:, None, :]
    )
    n, k = centre.shape[0], radius.size
    weights = np.full((n, k, components), -np.log(components))
    return Records(mean, np.broadcast_to(cov, (n, k, components, 2, 2)).copy(), None, weights)
