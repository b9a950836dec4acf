"""Pictures of a run beside its batch optimum and beside COLMAP's reconstruction, as PNG files."""

from pathlib import Path
from typing import Any

import numpy as np

from rbpf.lie import Array
from rbpf.runs.plots import COLOURS, Views, label, new_axes, outline, save_figures
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.trajectory import in_space
from rbpf.validation.colmap.compare import ColmapComparison
from rbpf.validation.consistency.against_batch import AgainstBatch
from rbpf.validation.consistency.against_optimisers import BatchErrors
from rbpf.validation.report.comparison_figures import (
    landmark_figure,
    map_figure,
    nees_figure,
    path_figure,
    wide_axes,
)

_BINS = 20


def plot_against_batch(found: AgainstBatch, out: Path) -> list[str]:
    """Map of both, distance of the paths over time, and the landmarks' Gaussians; returns the file names."""
    figures = {
        "gtsam_map.png": _batch_map(found),
        "gtsam_path.png": _batch_path(found),
        "gtsam_landmarks.png": _batch_landmarks(found),
    }
    return save_figures(figures, out)


def plot_against_colmap(found: ColmapComparison, reference: PathAndMap, out: Path) -> list[str]:
    """Both maps and paths in the reference's world, and the landmarks' nearest distances; returns the file names."""
    figures = {"colmap_map.png": _colmap_map(found, reference)}
    if found.cloud is not None:
        figures["colmap_cloud.png"] = _histogram(
            found.cloud.surface_m,
            f"{found.reconstruction.name}: landmarks to the surface of COLMAP's points",
            "distance [m]",
        )
    return save_figures(figures, out)


def _batch_map(found: AgainstBatch) -> Any:
    figure, axes = new_axes(f"{found.name}: filter and batch with 3σ ellipses, seen from above")
    for name, estimate in (("batch", found.optimum.estimate), ("filter", found.filter)):
        at, points = estimate.trajectory.positions, estimate.landmarks
        axes.plot(at[:, 0], at[:, 1], color=COLOURS[name], lw=1.2, label=name)
        for ellipse in outline(points.mean[:, :2], points.cov[:, :2, :2]):
            axes.plot(*ellipse.T, color=COLOURS[name], lw=0.7)
    axes.legend(loc="best", fontsize="small")
    return figure


def _batch_path(found: AgainstBatch) -> Any:
    figure, axes = new_axes(
        f"{found.name}: online filter beside the batch optimum", "distance [m]", "step", equal=False
    )
    axes.plot(found.optimum.steps, found.path.distances, color=COLOURS["filter"], lw=1.0)
    return figure


def _batch_landmarks(found: AgainstBatch) -> Any:
    from matplotlib.figure import Figure

    figure, gaussians = Figure(figsize=(9.0, 4.0)), found.landmarks
    left, right = figure.subplots(1, 2)
    label(left, f"{found.name}: landmarks off the optimum", "σ of the filter", "landmarks", equal=False)
    label(right, "standard deviation, filter over optimum", "ratio (1 is honest)", "", equal=False)
    for axes, values in ((left, gaussians.sigmas), (right, gaussians.sigma_ratio)):
        axes.hist(values, bins=_BINS, color=COLOURS["filter"])
    right.axvline(1.0, color=COLOURS["truth"], lw=0.8, ls="--")
    return figure


def _colmap_map(found: ColmapComparison, reference: PathAndMap) -> Any:
    views = Views.of_camera(reference.trajectory.world_from_body)
    figure, shown = views.axes(f"{found.reconstruction.name}: COLMAP brought onto the run")
    move = found.reference_from_colmap
    cloud, centres = (
        move.transform(found.reconstruction.points),
        move.transform(found.reconstruction.path.positions),
    )
    low, high = _box(reference.landmarks.mean, reference.trajectory.positions)
    cloud = cloud[((cloud >= low) & (cloud <= high)).all(axis=1)]
    at, points = reference.trajectory.positions, reference.landmarks.mean
    for axes, (right, up) in shown:
        axes.plot(
            cloud[:, right], cloud[:, up], ".", color=COLOURS["odometry"], ms=1.5, label="COLMAP's points"
        )
        axes.plot(points[:, right], points[:, up], ".", color=COLOURS["map"], ms=4, label="landmarks")
        axes.plot(at[:, right], at[:, up], color=COLOURS["filter"], lw=1.2, label="filter")
        axes.plot(
            centres[:, right], centres[:, up], "+", color=COLOURS["batch"], ms=6, label="COLMAP's key frames"
        )
    shown[0][0].legend(loc="best", fontsize="small")
    return figure


def _box(points: Array, path: Array) -> tuple[Array, Array]:
    """Corners of what is shown: the map and the path, and a tenth more; COLMAP's far points would make it small."""
    everything = np.concatenate([points, path])
    margin = 0.1 * np.ptp(everything, axis=0)
    return everything.min(axis=0) - margin, everything.max(axis=0) + margin


def _histogram(values: Array, title: str, xlabel: str) -> Any:
    figure, axes = new_axes(title, "landmarks", xlabel, equal=False)
    axes.hist(values, bins=_BINS, color=COLOURS["filter"])
    axes.axvline(float(np.median(values)), color=COLOURS["truth"], lw=0.8, ls="--", label="median")
    axes.legend(loc="best", fontsize="small")
    return figure


def plot_against_posterior(record: RunFolder, errors: BatchErrors) -> list[str]:
    """Paths, expected NEES, landmarks and map of a robot beside the batch posterior; returns the file names."""
    name, path, batch = record.name, record.path, errors.batch
    ours, theirs = path.trajectory().positions, in_space(path.stamps_ns, batch.world_from_robot).positions
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
