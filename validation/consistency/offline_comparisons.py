"""A run over images on its page: beside the batch optimum of its measurements, and beside COLMAP's reconstruction."""

from dataclasses import asdict, replace

import numpy as np

from rbpf.runs.reading import RunFolder
from rbpf.validation.colmap.against_colmap import compare_folder_with_colmap
from rbpf.validation.colmap.pipeline import ReconstructionOptions
from rbpf.validation.consistency.against_batch import AgainstBatch, compare_folder
from rbpf.validation.consistency.comparison import Comparison
from rbpf.validation.consistency.statistic import STATE_FACTOR, Statistic
from rbpf.validation.metrics.gaussian_differences import Differences, figures_of
from rbpf.validation.report.offline_pictures import plot_against_batch, plot_against_colmap

KEY_FRAMES = 60
"""Most of a run that are reconstructed: matching takes minutes for so many, and grows faster than they do."""

HUBER = 1.345
"""Threshold of the batch's loss: matches in images hold false ones."""


def compare_camera_with_batch(record: RunFolder) -> Comparison:
    """The batch optimum, with pictures in the run's folder; errors as `compare_folder`."""
    found = compare_folder(record.folder, robust=HUBER)
    apart = 1e3 * found.path.rmse
    accuracy = f"The path is {apart:.3g} mm (rms) from the batch optimum of the same measurements."
    named = (("landmarks", found.landmarks), ("poses", found.poses))
    statistics = [_apart(name, differences) for name, differences in named if len(differences)]
    return Comparison(
        "gtsam", accuracy, _figures(found), statistics, plot_against_batch(found, record.folder)
    )


def compare_camera_with_colmap(record: RunFolder) -> Comparison:
    """COLMAP's reconstruction of every n-th image; errors as `compare_folder_with_colmap`."""
    usual = ReconstructionOptions()
    every = max(usual.every, -(-len(record.path.mean) // KEY_FRAMES))
    found = compare_folder_with_colmap(record.folder, replace(usual, every=every))
    figures = {f"run_{name}": value for name, value in found.run.as_dict().items()}
    if found.truth is not None:
        figures |= {f"truth_{name}": value for name, value in found.truth.as_dict().items()}
    accuracy = f"The path is {1e3 * found.run.path.rmse:.3g} mm (rms) from COLMAP's reconstruction of the same images."
    pictures = plot_against_colmap(found.run, RunFolder.open(record.folder).estimate, record.folder)
    return Comparison("colmap", accuracy, figures, [], pictures)


def _figures(found: AgainstBatch) -> dict[str, object]:
    """Single numbers for the page; the rows behind them are `AgainstBatch.as_dict`'s."""
    figures: dict[str, object] = {
        "gauge": found.gauge,
        "scale": found.scale,
        "filter_minus_batch_rmse_m": found.path.rmse,
        "filter_minus_batch_max_m": found.path.max,
        "batch_error": found.optimum.error,
    }
    figures |= figures_of("landmarks", found.landmarks) | figures_of("poses", found.poses)
    for name, fit in (("filter", found.fit_filter), ("batch", found.fit_batch)):
        figures |= {f"{name}_{key}": value for key, value in asdict(fit).items()}
    return figures


def _apart(name: str, differences: Differences) -> Statistic:
    """Squared distance from the optimum in the filter's own deviations; a filter that lost nothing stays below one."""
    value = float(np.square(differences.sigmas).mean() / differences.dims)
    title = f"{name} against the batch optimum"
    return Statistic(title, value, value, value, (0.0, STATE_FACTOR**2), float(len(differences)))
