"""A range-bearing run against the batch optimum of the same measurements, and against the batch's own covariances.

The batch posterior N(m_b, P_b) is as good as truth about it: an estimate m_f that claims P_f has there the expected
normalised squared error

    tr P_f⁻¹ (P_b + δ δᵀ),    δ = Log(m_f⁻¹ m_b)

which is d for a filter that lost nothing, and more where it has drifted off or claims too little.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import LieGroup
from rbpf.runs.measurement_files import read_robot_measurements
from rbpf.runs.path_and_map import PathAndMap
from rbpf.runs.plots import save_figures
from rbpf.runs.reading import FilteredPath, RunFolder
from rbpf.runs.trajectory import in_space
from rbpf.sensors.readers.measurements import Measurements
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.consistency.against_batch import compare
from rbpf.validation.consistency.autocorrelation import degrees_of_freedom
from rbpf.validation.consistency.comparison import Comparison
from rbpf.validation.consistency.pose_errors import whitened_errors
from rbpf.validation.consistency.statistic import NOISE_FACTOR, STATE_FACTOR, Statistic, variance_ratio
from rbpf.validation.gtsam.batch_problem import robot_optimum
from rbpf.validation.gtsam.robot import BatchSolution, solve
from rbpf.validation.metrics.gaussian_differences import figures_of
from rbpf.validation.report.comparison_figures import (
    landmark_figure,
    map_figure,
    nees_figure,
    path_figure,
    wide_axes,
)

NAME = "gtsam"
LONG = 300
"""Steps from which the optimiser starts incrementally, because dead reckoning is too far off."""


@dataclass(frozen=True)
class BatchErrors:
    """A run beside the batch posterior; the expectations are per degree of freedom, 1 where nothing is lost.

    Attributes:
        poses: (T,) expected normalised squared errors of the poses; NaN where the filter holds a pose to be exact.
        white: (T, d) δ in units of the filter's deviations.
        landmarks: (M,) likewise of the landmarks.
        sigmas: (M,) squared distances of the landmarks from the batch's in the batch's own σ.
        map: the M landmarks of the run.
    """

    poses: np.ndarray
    white: np.ndarray
    landmarks: np.ndarray
    sigmas: np.ndarray
    map: MapEstimate


def batch_errors(path: FilteredPath, found: MapEstimate, batch: BatchSolution) -> BatchErrors:
    """Compares poses and landmarks with a batch solution with marginals, in one world."""
    poses, white = _expected_poses(path.space, path, batch)
    kept = np.array([name in batch.landmarks for name in found.ids.tolist()], dtype=bool)
    found = MapEstimate(found.ids[kept], found.mean[kept], found.cov[kept])
    names = found.ids.tolist()
    dim = found.mean.shape[1]
    delta = np.array([batch.landmarks[name] for name in names]).reshape(-1, dim) - found.mean
    cov = np.array([batch.cov_landmarks[name] for name in names]).reshape(-1, dim, dim)
    expected = np.einsum("mab,mba->m", np.linalg.pinv(found.cov, hermitian=True), cov + _outer(delta)) / dim
    sigmas = np.einsum("ma,mab,mb->m", delta, np.linalg.pinv(cov, hermitian=True), delta)
    return BatchErrors(poses, white, expected, sigmas, found)


def compare_with_batch(record: RunFolder) -> Comparison:
    """The comparison, with pictures in the run's folder.

    Raises:
        InputError: the run's measurements are missing or damaged, belong to another run, or do not determine the
            batch problem.
    """
    path, measured = record.path, read_robot_measurements(record.folder)
    if not np.array_equal(measured.stamps_ns, path.stamps_ns):
        raise InputError(
            f"{record.folder}: trajectory and measurements share no common steps, they belong to different runs"
        )
    batch = solve(measured, incremental=len(measured.stamps_ns) > LONG)
    errors = batch_errors(path, record.map.points(), batch)
    figures = _figures(path, measured, batch, errors) | _densities(path, record.map.points(), measured, batch)
    apart = figures["filter_minus_batch_rmse_m"]
    accuracy = f"The path is {1e3 * apart:.3g} mm (rms) from the batch optimum of the same measurements."
    statistics = batch_statistics(measured, batch, errors)
    return Comparison(NAME, accuracy, figures, statistics, _draw(record, path, batch, errors))


def batch_statistics(measured: Measurements, batch: BatchSolution, errors: BatchErrors) -> list[Statistic]:
    """Residuals of the optimum, and the filter's poses and landmarks under the batch posterior."""
    count = measured.z.size - sum(point.size for point in batch.landmarks.values())
    out = []
    if count > 0:
        out.append(
            variance_ratio("residuals of the batch optimum", 2.0 * batch.error / count, count, NOISE_FACTOR)
        )
    known = np.isfinite(errors.poses)
    if known.any():
        dof = degrees_of_freedom(errors.white[known])
        value = float(errors.poses[known].mean())
        out.append(variance_ratio("poses against the batch optimum", value, dof, STATE_FACTOR))
    if errors.landmarks.size:
        value = float(errors.landmarks.mean())
        zone = STATE_FACTOR**-2, STATE_FACTOR**2
        samples = float(errors.landmarks.size)
        # the batch posterior is averaged over, so that no chance is left
        out.append(Statistic("landmarks against the batch optimum", value, value, value, zone, samples))
    return out


def _expected_poses(
    space: LieGroup, path: FilteredPath, batch: BatchSolution
) -> tuple[np.ndarray, np.ndarray]:
    offset = whitened_errors(space, path.mean, path.cov, batch.world_from_robot)
    inverse = np.linalg.pinv(path.cov, hermitian=True)
    claimed = np.einsum("tab,tba->t", inverse, batch.cov_poses)
    full = offset.ranks == space.dim
    expected = (claimed + offset.nees) / np.maximum(offset.ranks, 1)
    return np.where(full, expected, np.nan), offset.errors


def _figures(
    path: FilteredPath, measured: Measurements, batch: BatchSolution, errors: BatchErrors
) -> dict[str, Any]:
    ours = path.trajectory().positions
    theirs = in_space(path.stamps_ns, batch.world_from_robot).positions
    residuals = measured.z.size - sum(point.size for point in batch.landmarks.values())
    figures: dict[str, Any] = {
        "filter_minus_batch_rmse_m": float(np.sqrt(np.square(ours - theirs).sum(axis=1).mean())),
        "batch_error": float(batch.error),
        "batch_error_right": 0.5 * residuals,
        "batch_iterations": int(batch.iterations),
    }
    if errors.sigmas.size:
        figures |= {
            "landmarks_compared": int(errors.sigmas.size),
            "landmark_sigma_difference_median": float(np.sqrt(np.median(errors.sigmas))),
            "landmark_sigma_difference_max": float(np.sqrt(errors.sigmas.max())),
        }
    return figures


def _densities(
    path: FilteredPath, found: MapEstimate, measured: Measurements, batch: BatchSolution
) -> dict[str, Any]:
    """Landmarks, and poses at a few instants, as Gaussians beside the batch's; the likelihood of both."""
    filtered = PathAndMap(path.stamps_ns, path.mean, path.cov, found)
    beside = compare(filtered, measured, optimum=robot_optimum(measured, batch))
    figures = figures_of("landmarks", beside.landmarks) | figures_of("poses", beside.poses)
    for name, fit in (("filter", beside.fit_filter), ("batch", beside.fit_batch)):
        figures |= {f"{name}_{key}": value for key, value in asdict(fit).items()}
    return figures


def _draw(record: RunFolder, path: FilteredPath, batch: BatchSolution, errors: BatchErrors) -> list[str]:
    name, ours = record.name, path.trajectory().positions
    theirs = in_space(path.stamps_ns, batch.world_from_robot).positions
    plane, known = wide_axes(theirs), np.flatnonzero(np.isfinite(errors.poses))
    figures = {"gtsam_path.png": path_figure(f"{name}: paths", {"batch": theirs, "filter": ours}, plane)}
    if known.size:
        dim = path.space.dim
        title = f"{name}: expected NEES under the batch posterior"
        figures["gtsam_nees.png"] = nees_figure(title, known, dim * errors.poses[known], dim)
    if errors.sigmas.size:
        count, dim = errors.map.mean.shape
        title = f"{name}: landmarks against the batch optimum, in its σ"
        figures["gtsam_landmarks.png"] = landmark_figure(title, errors.sigmas, dim)
        mean, cov, at = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3))
        mean[:, :dim], cov[:, :dim, :dim] = errors.map.mean, errors.map.cov
        at[:, :dim] = [batch.landmarks[i] for i in errors.map.ids.tolist()]
        title = f"{name}: map over the batch optimum"
        figures["gtsam_map.png"] = map_figure(title, ours, mean, cov, {"batch": at}, plane)
    return save_figures(figures, record.folder)


def _outer(vectors: np.ndarray) -> np.ndarray:
    return vectors[:, :, None] * vectors[:, None, :]
