"""Whether a camera filter says honestly how wrong it is: errors of its poses, and how its particles spread the map."""

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


def offdiagonal_eigenvalues(points: np.ndarray, log_weights: np.ndarray) -> np.ndarray:
    """Magnitudes of the eigenvalues of the landmarks' covariance that only the particles can carry, E06 §6.

    Each particle keeps the covariance of each landmark, so that the blocks on the diagonal are set to zero. The
    covariance of N particles has rank N − 1 at most; without its diagonal blocks it has no such bound, and its
    eigenvalues have both signs and sum to zero.

    Args:
        points: (N, K, 3) each particle's means of K landmarks, m.
        log_weights: (N,) normalised.

    Returns:
        (3K,) in descending order, m².
    """
    n, k, _ = points.shape
    weights = np.exp(log_weights)
    spread = (points - np.einsum("n,nkd->kd", weights, points)).reshape(n, 3 * k)
    cov = (weights[:, None] * spread).T @ spread
    blocks = cov.reshape(k, 3, k, 3)
    blocks[np.arange(k), :, np.arange(k)] = 0.0
    return np.sort(np.abs(np.linalg.eigvalsh(cov)))[::-1]


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
