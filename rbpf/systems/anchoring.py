"""Poses relative to a frame that each particle knows in a world of its own."""

from dataclasses import dataclass

import numpy as np

from rbpf.core.particles import Estimate, Prior, mixture_estimate
from rbpf.lie import LieGroup


@dataclass(frozen=True)
class Anchored:
    """The frame in each particle's own world: world_from_frame (N, E), and a factor (N, d, d) of its covariance there."""

    mean: np.ndarray
    factor: np.ndarray


def relative_estimate(space: LieGroup, anchored: Anchored, state: np.ndarray, log_weights: np.ndarray) -> Estimate:
    """Mean and covariance of states (N, E) relative to the frame, x_0⁻¹ · x."""
    relative = space.between(anchored.mean, state)
    factor = space.adjoint(space.inverse(relative)) @ anchored.factor
    return mixture_estimate(Prior(space, relative, np.zeros((1, space.dim)), factor), None, log_weights)
