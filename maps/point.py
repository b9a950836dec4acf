"""Landmarks that are Gaussian points: in the plane or in space, free or in the frame of an anchor."""

from typing import final

import numpy as np

from rbpf.core.models import Landmark
from rbpf.lie import SE2Group, SE3Group


@final
class Point(Landmark):
    """A world point (x, y[, z]) in metres, E06 (6).

    Args:
        dim: 2 or 3.
    """

    def __init__(self, dim: int = 3) -> None:
        self.dim = dim

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """(…, D) → (…, D+1)."""
        return np.concatenate([mean, np.ones((*mean.shape[:-1], 1))], axis=-1)


@final
class AnchoredPoint(Landmark):
    """A point in the frame of an anchor, which is the record's constant: world_from_anchor (E,).

    Args:
        space: SE2 or SE3.
    """

    def __init__(self, space: SE2Group | SE3Group) -> None:
        self.space = space
        self.dim = 2 if isinstance(space, SE2Group) else 3
        self.constants = space.size

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """(…, D) in the anchor's frame → (…, D+1) in the world."""
        assert const is not None
        world = self.space.transform(const, mean)
        return np.concatenate([world, np.ones((*world.shape[:-1], 1))], axis=-1)
