"""A run on its page beside the batch optimum of its measurements, by GTSAM, and beside COLMAP's reconstruction.

A robot's batch posterior N(m_b, P_b) is as good as truth about it: an estimate m_f that claims P_f has there the
expected normalised squared error

    tr P_f⁻¹ (P_b + δ δᵀ),    δ = Log(m_f⁻¹ m_b)

which is d for a filter that lost nothing, and more where it has drifted off or claims too little.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.measurement_files import read_robot_measurements
from rbpf.runs.reading import FilteredPath, PathAndMap, RunFolder
from rbpf.runs.trajectory import in_space
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.colmap.against_colmap import AgainstColmap, compare_folder_with_colmap
from rbpf.validation.colmap.reconstruct import ReconstructionOptions
from rbpf.validation.consistency.against_batch import AgainstBatch, compare, compare_folder
from rbpf.validation.consistency.comparison import Comparison
from rbpf.validation.consistency.statistic import (
    NOISE_FACTOR,
    STATE_FACTOR,
    Statistic,
    degrees_of_freedom,
    variance_ratio,
    whitened_errors,
)
from rbpf.validation.gtsam.batch_problem import AFAR, robot_optimum
from rbpf.validation.gtsam.robot import BatchSolution, solve
from rbpf.validation.metrics.gaussian_differences import figures_of

GTSAM, COLMAP = "gtsam", "colmap"

KEY_FRAMES = 60
"""Most of a run that are reconstructed: matching takes minutes for so many, and grows faster than they do."""

HUBER = 1.345
"""Threshold of the batch's loss: matches in images hold false ones."""


@dataclass(frozen=True)
class BatchErrors:
    """A run beside the batch posterior; the expectations are per degree of freedom, 1 where nothing is lost.

    Attributes:
        batch: the posterior.
        poses: (T,) expected normalised squared errors of the poses; NaN where the filter holds a pose to be exact.
        white: (T, d) δ in units of the filter's deviations.
        landmarks: (M,) likewise of the landmarks.
        sigmas: (M,) squared distances of the landmarks from the batch's in the batch's own σ.
        map: the M landmarks of the run.
    """

    batch: BatchSolution
    poses: np.ndarray
    white: np.ndarray
    landmarks: np.ndarray
    sigmas: np.ndarray
    map: MapEstimate


def compare_robot_with_batch(record: RunFolder) -> tuple[Comparison, BatchErrors]:
    """A range-bearing run beside the batch posterior of the same measurements.

    Raises:
        InputError: the run's measurements are missing or damaged, belong to another run, or do not determine the
            batch problem.
    """
    path, measured = record.path, read_robot_measurements(record.folder)
    if not np.array_equal(measured.stamps_ns, path.stamps_ns):
        raise InputError(
            f"{record.folder}: trajectory and measurements share no common steps, they belong to different runs"
        )
    batch = solve(measured, incremental=len(measured.stamps_ns) > AFAR)
    errors = batch_errors(path, record.map.points(), batch)
    ours, theirs = path.trajectory().positions, in_space(path.stamps_ns, batch.world_from_robot).positions
    apart = float(np.sqrt(np.square(ours - theirs).sum(axis=1).mean()))
    residuals = measured.z.size - sum(point.size for point in batch.landmarks.values())
    figures: dict[str, Any] = {
        "filter_minus_batch_rmse_m": apart,
        "batch_error": float(batch.error),
        "batch_error_right": 0.5 * residuals,
        "batch_iterations": int(batch.iterations),
    }
    statistics = []
    if residuals > 0:
        name = "residuals of the batch optimum"
        statistics.append(variance_ratio(name, 2.0 * batch.error / residuals, residuals, NOISE_FACTOR))
    known = np.isfinite(errors.poses)
    if known.any():
        dof, value = degrees_of_freedom(errors.white[known]), float(errors.poses[known].mean())
        statistics.append(variance_ratio("poses against the batch optimum", value, dof, STATE_FACTOR))
    if errors.sigmas.size:
        figures |= {
            "landmarks_compared": int(errors.sigmas.size),
            "landmark_sigma_difference_median": float(np.sqrt(np.median(errors.sigmas))),
            "landmark_sigma_difference_max": float(np.sqrt(errors.sigmas.max())),
        }
        value = float(errors.landmarks.mean())
        zone, samples = (STATE_FACTOR**-2, STATE_FACTOR**2), float(errors.landmarks.size)
        # the batch posterior is averaged over, so that no chance is left
        name = "landmarks against the batch optimum"
        statistics.append(Statistic(name, value, value, value, zone, samples))
    # Landmarks, and poses at a few instants, as Gaussians beside the batch's; the likelihood of both.
    filtered = PathAndMap(path.stamps_ns, path.mean, path.cov, record.map.points())
    figures |= _densities(compare(filtered, measured, optimum=robot_optimum(measured, batch)))
    accuracy = f"The path is {1e3 * apart:.3g} mm (rms) from the batch optimum of the same measurements."
    return Comparison(GTSAM, accuracy, figures, statistics), errors


def batch_errors(path: FilteredPath, found: MapEstimate, batch: BatchSolution) -> BatchErrors:
    """Compares poses and landmarks with a batch solution with marginals, in one world."""
    offset = whitened_errors(path.space, path.mean, path.cov, batch.world_from_robot)
    claimed = np.einsum("tab,tba->t", np.linalg.pinv(path.cov, hermitian=True), batch.cov_poses)
    poses = (claimed + offset.nees) / np.maximum(offset.ranks, 1)
    poses = np.where(offset.ranks == path.space.dim, poses, np.nan)
    kept = np.array([name in batch.landmarks for name in found.ids.tolist()], dtype=bool)
    found = MapEstimate(found.ids[kept], found.mean[kept], found.cov[kept])
    names, dim = found.ids.tolist(), found.mean.shape[1]
    delta = np.array([batch.landmarks[name] for name in names]).reshape(-1, dim) - found.mean
    cov = np.array([batch.cov_landmarks[name] for name in names]).reshape(-1, dim, dim)
    spread = cov + delta[:, :, None] * delta[:, None, :]
    landmarks = np.einsum("mab,mba->m", np.linalg.pinv(found.cov, hermitian=True), spread) / dim
    sigmas = np.einsum("ma,mab,mb->m", delta, np.linalg.pinv(cov, hermitian=True), delta)
    return BatchErrors(batch, poses, offset.errors, landmarks, sigmas, found)


def compare_camera_with_batch(record: RunFolder) -> tuple[Comparison, AgainstBatch]:
    """A run over images beside the batch optimum of its measurements; errors as `compare_folder`."""
    found = compare_folder(record.folder, robust=HUBER)
    apart = 1e3 * found.path.rmse
    accuracy = f"The path is {apart:.3g} mm (rms) from the batch optimum of the same measurements."
    # Squared distance from the optimum in the filter's own deviations: a filter that lost nothing stays below one.
    statistics = []
    for name, differences in (("landmarks", found.landmarks), ("poses", found.poses)):
        if len(differences):
            value = float(np.square(differences.sigmas).mean() / differences.dims)
            zone, samples = (0.0, STATE_FACTOR**2), float(len(differences))
            title = f"{name} against the batch optimum"
            statistics.append(Statistic(title, value, value, value, zone, samples))
    figures = {
        "gauge": found.gauge,
        "scale": found.scale,
        "filter_minus_batch_rmse_m": found.path.rmse,
        "filter_minus_batch_max_m": found.path.max,
        "batch_error": found.optimum.error,
    }
    return Comparison(GTSAM, accuracy, figures | _densities(found), statistics), found


def compare_camera_with_colmap(record: RunFolder) -> tuple[Comparison, AgainstColmap]:
    """A run over images beside COLMAP's reconstruction of every n-th; errors as `compare_folder_with_colmap`."""
    usual = ReconstructionOptions()
    every = max(usual.every, -(-len(record.path.mean) // KEY_FRAMES))
    found = compare_folder_with_colmap(record.folder, replace(usual, every=every))
    figures = {f"run_{name}": value for name, value in found.run.as_dict().items()}
    if found.truth is not None:
        figures |= {f"truth_{name}": value for name, value in found.truth.as_dict().items()}
    accuracy = f"The path is {1e3 * found.run.path.rmse:.3g} mm (rms) from COLMAP's reconstruction of the same images."
    return Comparison(COLMAP, accuracy, figures), found


def _densities(found: AgainstBatch) -> dict[str, Any]:
    """Single numbers of the Gaussians for the page; the rows behind them are `AgainstBatch.as_dict`'s."""
    figures = figures_of("landmarks", found.landmarks) | figures_of("poses", found.poses)
    for name, fit in (("filter", found.fit_filter), ("batch", found.fit_batch)):
        figures |= {f"{name}_{key}": value for key, value in asdict(fit).items()}
    return figures
