"""Pictures of a run, as PNG files drawn without a screen."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.runs.alignment import align
from rbpf.runs.plots import COLOURS, SIGMAS, new_axes, outline, save_figures
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.range_bearing.run import Run
from rbpf.validation.metrics.scores import as_trajectory, truth_at


def plot_run(run: Run, summary: MapEstimate, out: Path, others: dict[str, np.ndarray]) -> list[str]:
    """Draws path, map, particles and diagnostics; returns the file names.

    Args:
        run: what was filtered.
        summary: its map.
        out: the run's folder.
        others: further paths (T, E) to draw, by name ("odometry", "batch").
    """
    pictures = {
        "path.png": _draw_path,
        "map.png": _draw_map,
        "particles.png": _draw_particles,
        "ess.png": _draw_diagnostics,
    }
    return save_figures({name: draw(run, summary, others) for name, draw in pictures.items()}, out)


def _positions(run: Run, poses: np.ndarray) -> np.ndarray:
    return as_trajectory(run.log, np.arange(poses.shape[0]), poses).positions


@dataclass(frozen=True)
class _TrueWorld:
    """The truth in the filter's frame: positions (T, 3) at the run's instants, landmarks (M, 3)."""

    path: np.ndarray
    landmarks: np.ndarray


def _truth(run: Run) -> _TrueWorld | None:
    """The truth moved by the rigid alignment of its path to the filter's."""
    log = run.log
    if log.truth is None:
        return None
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    rows, poses = truth_at(log.space, log.truth, stamps)
    if rows.size < 3:
        return None
    true, ours = _positions(run, poses), _positions(run, run.progress.mean[rows])
    alignment = align(true, ours)
    points = np.array([np.append(p, 0.0)[:3] for p in log.truth.landmarks.values()]).reshape(-1, 3)
    return _TrueWorld(alignment.transform(true), alignment.transform(points))


def _draw_path(run: Run, summary: MapEstimate, others: dict[str, np.ndarray]) -> Any:
    figure, axes = new_axes(f"{run.log.name}: path, seen from above")
    for name, poses in others.items():
        at = _positions(run, poses)
        axes.plot(at[:, 0], at[:, 1], color=COLOURS[name], lw=1, label=name)
    truth = _truth(run)
    if truth is not None:
        axes.plot(
            truth.path[:, 0],
            truth.path[:, 1],
            color=COLOURS["truth"],
            lw=1.2,
            ls="--",
            label="truth, rigidly aligned",
        )
    at = _positions(run, run.progress.mean)
    axes.plot(at[:, 0], at[:, 1], color=COLOURS["filter"], lw=1.2, label="filter")
    axes.legend(loc="best", fontsize="small")
    return figure


def _draw_map(run: Run, summary: MapEstimate, others: dict[str, np.ndarray]) -> Any:
    figure, axes = new_axes(f"{run.log.name}: map with {SIGMAS:g}σ ellipses, seen from above")
    at = _positions(run, run.progress.mean)
    axes.plot(at[:, 0], at[:, 1], color=COLOURS["filter"], lw=0.6, alpha=0.5, label="filter")
    truth = _truth(run)
    if truth is not None and truth.landmarks.size:
        at = truth.landmarks
        axes.plot(at[:, 0], at[:, 1], "+", color=COLOURS["truth"], ms=7, label="truth, aligned by the path")
    axes.plot(summary.mean[:, 0], summary.mean[:, 1], ".", color=COLOURS["map"], ms=3, label="landmarks")
    for ellipse in outline(summary.mean[:, :2], summary.cov[:, :2, :2]):
        axes.plot(*ellipse.T, color=COLOURS["map"], lw=0.8)
    axes.legend(loc="best", fontsize="small")
    return figure


def _draw_particles(run: Run, summary: MapEstimate, others: dict[str, np.ndarray]) -> Any:
    particles = run.filter.particles
    figure, axes = new_axes(f"{run.log.name}: {particles.n} particles at the last step; area is weight")
    at = _positions(run, particles.state)
    axes.scatter(at[:, 0], at[:, 1], s=400 * particles.weights, color=COLOURS["filter"], alpha=0.5)
    mean = _positions(run, run.progress.mean[-1:])[0]
    axes.plot(mean[0], mean[1], "x", color=COLOURS["map"], label="mean")
    axes.legend(loc="best", fontsize="small")
    return figure


def _draw_diagnostics(run: Run, summary: MapEstimate, others: dict[str, np.ndarray]) -> Any:
    from matplotlib.figure import Figure

    progress, steps = run.progress, np.arange(run.progress.ess.size)
    figure = Figure(figsize=(8.0, 6.0))
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(steps, progress.ess, lw=0.8, color=COLOURS["filter"], label="effective sample size")
    limit = run.config.resampling.ess_threshold * run.config.particles
    upper.axhline(limit, color=COLOURS["map"], lw=0.8, ls="--", label="resampling below")
    upper.set(title=f"{run.log.name}: effective sample size and innovations", ylabel="particles")
    upper.legend(loc="best", fontsize="small")
    seen = progress.rows > 0
    ratio = progress.nis[seen] / progress.rows[seen]
    lower.plot(steps[seen], ratio, ".", ms=2, color=COLOURS["filter"], label="NIS / degrees of freedom")
    lower.axhline(1.0, color=COLOURS["truth"], lw=0.8, label="honest filter's mean")
    lower.set(xlabel="step", ylabel="ratio", yscale="log")
    lower.legend(loc="best", fontsize="small")
    return figure
