"""A run on its page beside the batch optimum of its measurements, by GTSAM, and beside COLMAP's reconstruction."""

from dataclasses import asdict, replace
from typing import Any

from rbpf.runs.reading import RunFolder
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.colmap.against_colmap import AgainstColmap, compare_folder_with_colmap
from rbpf.validation.colmap.reconstruct import ReconstructionOptions
from rbpf.validation.consistency.against_batch import AgainstBatch, compare
from rbpf.validation.consistency.comparison import RESIDUALS, Comparison
from rbpf.validation.consistency.statistic import NOISE_FACTOR, variance_ratio
from rbpf.validation.gtsam.batch_problem import Optimum, Told, read_problem, solve_problem
from rbpf.validation.gtsam.observations import HUBER
from rbpf.validation.metrics.gaussian_differences import figures_of

GTSAM, COLMAP = "gtsam", "colmap"

KEY_FRAMES = 60
"""Most of a run that are reconstructed: matching takes minutes for so many, and grows faster than they do."""


def solve_run(record: RunFolder, most: int | None = None, on_iteration: Told | None = None) -> Optimum:
    """The batch optimum of a run's measurements: with Huber's loss for matches in images, which hold false ones.

    Args:
        record: the run.
        most: see `solve_problem`.
        on_iteration: likewise.

    Raises:
        InputError: the run's measurements are missing or damaged, belong to another run, or do not determine the
            batch problem; or the optimiser does not converge.
    """
    problem = read_problem(record.folder)
    robust = HUBER if isinstance(problem, FeatureLog) else None
    return solve_problem(problem, record.path.mean, robust, most, on_iteration)


def compare_with_batch(record: RunFolder, optimum: Optimum | None = None) -> tuple[Comparison, AgainstBatch]:
    """A run beside the batch posterior of the same measurements, from `solve_run` where it is known; errors as that."""
    problem = read_problem(record.folder)
    found = compare(record.estimate, problem, optimum=optimum or solve_run(record))
    figures: dict[str, Any] = {
        "gauge": found.gauge,
        "scale": found.scale,
        "filter_minus_batch_rmse_m": found.path.rmse,
        "filter_minus_batch_max_m": found.path.max,
        "path_spread_m": found.optimum.estimate.trajectory.spread,
        "batch_error": found.optimum.error,
    }
    statistics = found.statistics()
    if not isinstance(problem, FeatureLog):
        residuals = problem.z.size - found.optimum.estimate.landmarks.mean.size
        figures["batch_error_right"] = 0.5 * residuals
        if residuals > 0:
            value = 2.0 * found.optimum.error / residuals
            statistics.insert(0, variance_ratio(RESIDUALS, value, residuals, NOISE_FACTOR))
    accuracy = f"The path is {1e3 * found.path.rmse:.3g} mm (rms) from the batch optimum of the same measurements"
    return Comparison(GTSAM, f"{accuracy}.", figures | _densities(found), statistics), found


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
