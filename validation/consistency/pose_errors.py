"""Errors of estimated poses, in metres and in units of what the filter believes."""

from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, LieGroup

_NOTHING = 1e-12
"""Variances below this fraction of the largest, or of one, are none."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of a path of T poses, without alignment.

    Attributes:
        distances: (T,) from the true positions, m.
        nees: (T,) normalised error squared eᵀP⁺e, e = Log(mean⁻¹ truth); an honest filter's mean is 6.
    """

    distances: np.ndarray
    nees: np.ndarray

    @property
    def rmse(self) -> float:
        """Root of the mean square distance, m."""
        return float(np.sqrt(np.square(self.distances).mean()))


def pose_errors(world_from_camera: np.ndarray, cov: np.ndarray, truth: np.ndarray) -> PoseErrors:
    """Compares estimated poses with true ones of the same instants.

    Args:
        world_from_camera: (T, 7) estimated.
        cov: (T, 6, 6) in the right chart at the estimate, order [ω, v].
        truth: (T, 7).

    Raises:
        InputError: the lengths differ.
    """
    if not len(world_from_camera) == len(cov) == len(truth):
        raise InputError(
            f"{len(world_from_camera)} poses, {len(cov)} covariances and {len(truth)} true poses do not belong together"
        )
    distances = np.linalg.norm(SE3.translation(world_from_camera) - SE3.translation(truth), axis=1)
    error = SE3.local(world_from_camera, truth)
    nees = np.einsum("ta,tab,tb->t", error, np.linalg.pinv(cov, hermitian=True), error)
    return PoseErrors(distances, nees)


@dataclass(frozen=True)
class WhitenedErrors:
    """Errors of T poses in units of what the filter believes, e = cov^(−1/2) Log(mean⁻¹ truth).

    Attributes:
        errors: (T, d); zero along directions that the filter holds to be known exactly.
        ranks: (T,) how many directions are not.
    """

    errors: np.ndarray
    ranks: np.ndarray

    @property
    def nees(self) -> np.ndarray:
        """(T,) normalised errors squared; the mean of an honest filter's is the rank."""
        return np.square(self.errors).sum(axis=1)


def whitened_errors(space: LieGroup, mean: np.ndarray, cov: np.ndarray, truth: np.ndarray) -> WhitenedErrors:
    """Errors of estimates (T, E) with covariances (T, d, d) in the right chart, from the truth (T, E).

    The symmetric root is taken, so that the axes are the chart's own at all times.
    """
    values, vectors = np.linalg.eigh(cov)
    used = values > _NOTHING * np.maximum(values[:, -1:], _NOTHING)
    scale = np.where(used, 1.0 / np.sqrt(np.where(used, values, 1.0)), 0.0)
    along = np.einsum("tab,ta->tb", vectors, space.local(mean, truth))
    return WhitenedErrors(np.einsum("tab,tb->ta", vectors, scale * along), used.sum(axis=1))
