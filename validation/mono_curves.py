"""Curves over the frames of a run over images: error, what was found, times."""

from typing import Any

import numpy as np

from rbpf.systems.mono.video import VideoRun
from rbpf.validation.figures import COLOURS

CAMERA_HZ = 30.0


def tracking_figure(run: VideoRun) -> Any:
    """Landmarks looked for and found, effective sample size, innovations."""
    figure, (upper, middle, lower) = _rows(3, f"{run.sequence.name}: search and filter")
    frames = np.arange(run.found.size)
    upper.plot(frames, run.searched, color="0.6", lw=1.0, label="looked for")
    upper.plot(frames, run.found, color=COLOURS["known"], lw=1.0, label="found")
    upper.set(ylabel="landmarks", ylim=(0, None))
    middle.plot(frames, run.ess, color=COLOURS["filter"], lw=0.8, label="effective sample size")
    limit = run.config.resampling.ess_threshold * run.config.particles
    middle.axhline(limit, color=COLOURS["map"], lw=0.8, ls="--", label="resampling below")
    middle.set(ylabel="particles", ylim=(0, None))
    seen = (run.nis_dof > 0) & np.isfinite(run.nis) & (run.nis > 0)
    ratio = run.nis[seen] / run.nis_dof[seen]
    lower.plot(frames[seen], ratio, ".", ms=3, color=COLOURS["filter"], label="NIS / degrees of freedom")
    lower.axhline(1.0, color="black", lw=0.8, label="honest filter's mean")
    lower.set(xlabel="frame", ylabel="ratio", yscale="log")
    for axes in (upper, middle, lower):
        _shade_lost(axes, run)
        axes.legend(loc="best", fontsize="small")
    return figure


def timings_figure(run: VideoRun) -> Any:
    """Time per frame by stage; decoding apart."""
    figure, (axes,) = _rows(1, f"{run.sequence.name}: time per frame")
    frames = np.arange(run.seconds.size)
    search, rest = 1e3 * run.seconds_search, 1e3 * (run.seconds - run.seconds_search)
    axes.stackplot(frames, search, rest, labels=["search in the image", "filter"], alpha=0.7, lw=0)
    axes.plot(frames, 1e3 * run.seconds_waiting, color="black", lw=0.6, label="waiting for the decoded image")
    axes.axhline(1e3 / CAMERA_HZ, color=COLOURS["map"], lw=0.8, ls="--", label=f"{CAMERA_HZ:g} Hz")
    high = max(
        1e3 / CAMERA_HZ, 2.5 * float(np.median(search + rest))
    )  # frames that compile run out of the picture
    axes.set(xlabel="frame", ylabel="ms", ylim=(0.0, 1.3 * high))
    axes.legend(loc="best", fontsize="small")
    return figure


def _rows(count: int, title: str) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.0 + 2.0 * count), layout="constrained")
    rows = list(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0])
    rows[0].set_title(title)
    for axes in rows:
        axes.grid(alpha=0.3)
    return figure, rows


def _shade_lost(axes: Any, run: VideoRun) -> None:
    lost = np.flatnonzero(run.lost)
    for number, group in enumerate(
        np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1) if lost.size else []
    ):
        name = "lost" if number == 0 else None
        axes.axvspan(group[0] - 0.5, group[-1] + 0.5, color=COLOURS["map"], alpha=0.2, lw=0, label=name)
