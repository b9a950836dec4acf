"""Pictures of a stereo run, as PNG files drawn without a screen."""

from pathlib import Path
from typing import Any

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.alignment import align
from rbpf.runs.plots import COLOURS, SIGMAS, Views, close_up, outline, save_figures, stacked_axes
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.stereo.run import StereoRun
from rbpf.validation.gtsam.mono_batch import Batch
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.metrics.mono_scores import TruePath, true_path
from rbpf.validation.metrics.stereo_scores import compared

MAP_FRACTION = 0.9
"""The map's picture holds the path and this fraction of the points; single points far off do not make it small."""


def plot_stereo_run(run: StereoRun, mapped: MapEstimate, out: Path, batch: Batch | None = None) -> list[str]:
    """Draws path, map, particles, error, tracking and times; returns the file names."""
    views, truth = Views.of_camera(run.world_from_camera), true_path(run.truth, run.stamps_ns)
    figures = {
        "path.png": _path(run, views, truth, batch),
        "map.png": _map(run, mapped, views),
        "particles.png": _particles(run, views),
        "tracking.png": _tracking(run),
        "timings.png": _timings(run),
    }
    if truth is not None:
        figures["error.png"] = _error(run, truth)
    return save_figures(figures, out)


def _path(run: StereoRun, views: Views, truth: TruePath | None, batch: Batch | None) -> Any:
    figure, shown = views.axes(f"{run.name}: path")
    at, alone = SE3.translation(run.world_from_camera), SE3.translation(run.odometry)
    for axes, (right, up) in shown:
        if truth is not None:
            true = SE3.translation(truth.world_from_camera)
            true = align(true, at[truth.rows]).transform(true)
            axes.plot(
                true[:, right], true[:, up], color=COLOURS["truth"], lw=1.2, ls="--", label="truth, moved"
            )
        axes.plot(alone[:, right], alone[:, up], color=COLOURS["odometry"], lw=1.0, label="odometry alone")
        if batch is not None:
            best = SE3.translation(batch.world_from_camera)
            axes.plot(best[:, right], best[:, up], color=COLOURS["batch"], lw=1.2, label="batch optimum")
        axes.plot(at[:, right], at[:, up], color=COLOURS["filter"], lw=1.2, label="filter")
        axes.plot(at[0, right], at[0, up], "o", color=COLOURS["filter"], ms=5, label="first pair")
    shown[0][0].legend(loc="best", fontsize="small")
    return figure


def _map(run: StereoRun, mapped: MapEstimate, views: Views) -> Any:
    figure, shown = views.axes(f"{run.name}: map with {SIGMAS:g}σ ellipses")
    at, mean, cov = SE3.translation(run.world_from_camera), mapped.mean, mapped.cov
    middle = np.median(np.concatenate([mean, at]), axis=0)
    far = np.linalg.norm(mean - middle, axis=1)
    near = far <= np.quantile(far, MAP_FRACTION) if far.size else np.zeros(0, dtype=bool)
    for axes, plane in shown:
        axes.plot(at[:, plane[0]], at[:, plane[1]], color=COLOURS["filter"], lw=1.0, label="camera")
        axes.plot(mean[:, plane[0]], mean[:, plane[1]], ".", color=COLOURS["map"], ms=2, label="landmarks")
        ellipses = outline(mean[near][:, plane], cov[near][:, plane][:, :, plane])
        axes.plot(ellipses[..., 0].T, ellipses[..., 1].T, color="black", lw=0.4, alpha=0.4)
        close_up(axes, plane, np.concatenate([mean[near], at]))
    shown[0][0].legend(loc="best", fontsize="small")
    return figure


def _particles(run: StereoRun, views: Views) -> Any:
    particles = run.filter.particles
    figure, shown = views.axes(f"{run.name}: {particles.n} particles at the last update")
    at, best = SE3.translation(particles.state), run.at_update
    turn = SE3.rotation(best.mean)
    mean, cov = SE3.translation(best.mean), turn @ best.cov[3:, 3:] @ turn.T
    for axes, (right, up) in shown:
        axes.scatter(
            at[:, right], at[:, up], s=1000 * particles.weights, color=COLOURS["filter"], alpha=0.5,
            label="particles; area is weight",
        )  # fmt: skip
        chosen = [right, up]
        ellipse = outline(mean[chosen], cov[np.ix_(chosen, chosen)])
        axes.plot(*ellipse.T, color=COLOURS["map"], lw=1.0, label=f"{SIGMAS:g}σ of the pose")
        axes.plot(mean[right], mean[up], "x", color=COLOURS["map"], label="mean")
        axes.ticklabel_format(useOffset=False)
        axes.tick_params(axis="x", labelrotation=30)
    shown[0][0].legend(loc="best", fontsize="small")
    return figure


def _error(run: StereoRun, truth: TruePath) -> Any:
    """Error of the position along the truth's axes after rigid alignment, beside what the filter believes (3σ)."""
    estimate, reference = compared(run, run.world_from_camera, truth)
    moved = ate(estimate, reference, "rigid").alignment
    error = moved.transform(estimate.positions) - reference.positions
    turn = moved.rotation @ SE3.rotation(run.world_from_camera[truth.rows])
    cov = turn @ run.cov[truth.rows][:, 3:, 3:] @ turn.mT
    band = SIGMAS * np.sqrt(np.maximum(np.einsum("taa->ta", cov), 0.0))
    figure, rows = stacked_axes(3, f"{run.name}: error of the position after the rigid alignment")
    for axis, axes in enumerate(rows):
        low, high = -1e3 * band[:, axis], 1e3 * band[:, axis]
        axes.fill_between(truth.rows, low, high, color=COLOURS["filter"], alpha=0.2, lw=0, label="3σ")
        axes.plot(truth.rows, 1e3 * error[:, axis], color=COLOURS["filter"], lw=1.0, label="error")
        axes.axhline(0.0, color="black", lw=0.5)
        axes.set_ylabel(f"{'xyz'[axis]} [mm]")
    rows[0].legend(loc="best", fontsize="small")
    rows[-1].set_xlabel("pair")
    return figure


def _tracking(run: StereoRun) -> Any:
    """Features and landmarks, and the effective sample size at the updates."""
    figure, (upper, lower) = stacked_axes(2, f"{run.name}: features and filter")
    pairs, at = np.arange(run.features.size), np.flatnonzero(run.updated)
    upper.plot(pairs, run.features, color="0.6", lw=1.0, label="features")
    upper.plot(pairs, run.agreeing, color=COLOURS["odometry"], lw=1.0, label="agree with the motion")
    upper.plot(at, run.observed[at], color=COLOURS["known"], lw=1.0, label="landmarks that weigh")
    upper.set(ylabel="number", ylim=(0, None))
    lower.plot(at, run.ess[at], color=COLOURS["filter"], lw=0.8, label="effective sample size")
    limit = run.config.resampling.ess_threshold * run.config.particles
    lower.axhline(limit, color=COLOURS["map"], lw=0.8, ls="--", label="resampling below")
    lower.set(xlabel="pair", ylabel="particles", ylim=(0, None))
    for axes in (upper, lower):
        axes.legend(loc="best", fontsize="small")
    return figure


def _timings(run: StereoRun) -> Any:
    """Time per pair by stage; decoding apart (S05 Fig. 7)."""
    figure, (axes,) = stacked_axes(1, f"{run.name}: time per pair")
    stages = {"features": run.seconds_features, "odometry": run.seconds_odometry}
    stages |= {"matching with the map": run.seconds_matching, "filter": run.seconds_filter}
    axes.stackplot(
        np.arange(run.seconds.size),
        *(1e3 * seconds for seconds in stages.values()),
        labels=list(stages),
        alpha=0.7,
        lw=0,
    )
    high = 2.5 * float(np.median(1e3 * run.seconds))  # pairs that compile run out of the picture
    axes.set(xlabel="pair", ylabel="ms", ylim=(0.0, high))
    axes.legend(loc="best", fontsize="small")
    return figure
