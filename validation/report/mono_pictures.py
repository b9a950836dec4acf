"""Pictures of a run over images, as PNG files drawn without a screen."""

from pathlib import Path
from typing import Any

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.alignment import Similarity, align
from rbpf.runs.plots import COLOURS, SIGMAS, outline, save_figures
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.slam import world_of
from rbpf.systems.mono.video import VideoRun
from rbpf.validation.gtsam.mono_batch import Batch
from rbpf.validation.metrics.mono_scores import TruePath, true_path
from rbpf.validation.report.mono_curves import error_figure, timings_figure, tracking_figure
from rbpf.validation.report.mono_views import Views, best_views, close_up, draw_particles

MAP_FRACTION = 0.9
"""The map's picture holds the path and this fraction of the points; single points far off do not make it small."""


def plot_mono_run(run: VideoRun, mapped: MapEstimate, out: Path, batch: Batch | None = None) -> list[str]:
    """Draws path, map, particles, error, tracking and times; returns the file names."""
    views, truth = best_views(run.world_from_camera), true_path(run.sequence.truth, run.stamps_ns)
    figures = {
        "path.png": _path(run, views, truth, batch),
        "map.png": _map(run, mapped, views),
        "particles.png": _particles(run, views),
        "tracking.png": tracking_figure(run),
        "timings.png": timings_figure(run),
    }
    if truth is not None:
        figures["error.png"] = error_figure(run, truth, batch)
    return save_figures(figures, out)


def true_into_run(run: VideoRun, truth: TruePath) -> tuple[Similarity, str]:
    """What brings the truth into the run's world, and how it is called."""
    ours, true = SE3.translation(run.world_from_camera[truth.rows]), SE3.translation(truth.world_from_camera)
    if run.known is None:
        return align(true, ours, with_scale=True), "truth, moved and scaled onto the filter"
    return align(true, ours), "truth, moved onto the filter"


def _path(run: VideoRun, views: Views, truth: TruePath | None, batch: Batch | None) -> Any:
    figure, shown = views.axes(f"{run.sequence.name}: path")
    at, lost = SE3.translation(run.world_from_camera), run.lost.astype(bool)
    for axes, (right, up) in shown:
        if truth is not None:
            moved, name = true_into_run(run, truth)
            true = moved.transform(SE3.translation(truth.world_from_camera))
            axes.plot(true[:, right], true[:, up], color=COLOURS["truth"], lw=1.2, ls="--", label=name)
        if batch is not None:
            best = SE3.translation(batch.world_from_camera)
            axes.plot(best[:, right], best[:, up], color=COLOURS["batch"], lw=1.2, label="batch optimum")
        axes.plot(at[:, right], at[:, up], color=COLOURS["filter"], lw=1.2, label="filter")
        axes.plot(at[0, right], at[0, up], "o", color=COLOURS["filter"], ms=5, label="first frame")
        if lost.any():
            axes.plot(at[lost, right], at[lost, up], ".", color=COLOURS["map"], ms=4, label="lost")
    shown[0][0].legend(loc="best", fontsize="small")
    return figure


def _map(run: VideoRun, mapped: MapEstimate, views: Views) -> Any:
    figure, shown = views.axes(f"{run.sequence.name}: map with {SIGMAS:g}σ ellipses")
    at = SE3.translation(run.world_from_camera)
    full = ~mapped.is_ray()
    mean, cov = mapped.mean[full], mapped.cov[full]
    middle = np.median(np.concatenate([mean, at]), axis=0)
    far = np.linalg.norm(mean - middle, axis=1)
    near = far <= np.quantile(far, MAP_FRACTION) if far.size else np.zeros(0, dtype=bool)
    for axes, plane in shown:
        right, up = plane
        axes.plot(at[:, right], at[:, up], color=COLOURS["filter"], lw=1.0, label="camera")
        _map_points(axes, plane, mean, cov)
        if mapped.is_ray().any() and mapped.ray_ends is not None:
            ends = mapped.ray_ends[mapped.is_ray()]
            lines = axes.plot(ends[..., right].T, ends[..., up].T, color=COLOURS["map"], lw=0.7, alpha=0.7)
            lines[0].set_label("rays (depth not known yet)")
        if run.known is not None:
            known = run.known.positions
            axes.plot(known[:, right], known[:, up], "+", color=COLOURS["known"], ms=9, label="known points")
        close_up(axes, plane, np.concatenate([mean[near], at]))
    shown[0][0].legend(loc="best", fontsize="small")
    return figure


def _map_points(axes: Any, plane: tuple[int, int], mean: np.ndarray, cov: np.ndarray) -> None:
    chosen = list(plane)
    axes.plot(mean[:, plane[0]], mean[:, plane[1]], ".", color="black", ms=3, label="points")
    for ellipse in outline(mean[:, chosen], cov[:, chosen][:, :, chosen]):
        axes.plot(*ellipse.T, color="black", lw=0.6, alpha=0.6)


def _particles(run: VideoRun, views: Views) -> Any:
    particles = run.filter.particles
    figure, shown = views.axes(f"{run.sequence.name}: {particles.n} particles at the last frame")
    world, poses = world_of(run.filter), particles.state[:, :7]
    at = SE3.translation(poses if world is None else SE3.between(world.mean, poses))
    turn = SE3.matrix(run.world_from_camera[-1])[:3, :3]
    mean, cov = SE3.translation(run.world_from_camera[-1]), turn @ run.cov[-1][3:, 3:] @ turn.T
    draw_particles(shown, at, particles.weights, mean, cov)
    return figure
