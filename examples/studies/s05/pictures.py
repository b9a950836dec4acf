"""Figs. 4 to 6, maps and trajectories from above, and Fig. 7, time per frame."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from examples.studies.s05.record import Best, Paths, Record
from rbpf.lie import SE3
from rbpf.runs.run import Run

MIDDLE = 0.98
"""Fraction of the landmarks within the plots, along each axis."""

STAGES = "features", "odometry", "matching", "filter"


def draw_maps(record: Record, paths: Paths, best: Best, file: Path) -> None:
    """Plots side by side: the best particle, visual odometry, and wheel odometry, each with its map."""
    figure = Figure(figsize=(18.0, 7.0), layout="constrained")
    shown = {
        "Fig. 4: best particle": (best.places, best.path),
        "Fig. 5: visual odometry alone": (record.places(paths.odometry, best.names), paths.odometry),
        "Fig. 6: wheels alone": (record.places(paths.wheels, best.names), paths.wheels),
    }
    everything = np.concatenate([places for places, _ in shown.values()])[:, [0, 2]]
    low, high = np.quantile(everything, [0.5 - 0.5 * MIDDLE, 0.5 + 0.5 * MIDDLE], axis=0)
    true = SE3.translation(paths.truth)
    for axes, (title, (places, path)) in zip(figure.subplots(1, 3), shown.items(), strict=True):
        at = SE3.translation(path)
        axes.plot(places[:, 0], places[:, 2], "r.", ms=0.8, label=f"{len(places)} landmarks")
        axes.plot(true[:, 0], true[:, 2], "k--", lw=0.8, label="truth")
        axes.plot(at[:, 0], at[:, 2], color="tab:blue", lw=1.3, label="trajectory")
        if places is best.places:
            axes.plot(best.cloud[:, 0], best.cloud[:, 2], "c.", ms=4, label="particles")
        axes.set(title=title, xlabel="x [m]", ylabel="z [m]", aspect="equal")
        axes.set(xlim=(low[0] - 1.0, high[0] + 1.0), ylim=(low[1] - 1.0, high[1] + 1.0))
        axes.legend(fontsize="small", loc="upper right")
    figure.savefig(file, dpi=110)


def draw_errors(paths: Paths, stamps_ns: np.ndarray, file: Path) -> None:
    """Plots the distance from the truth over the drive."""
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    axes = figure.subplots()
    true = SE3.translation(paths.truth)
    for name in ("filter", "odometry", "wheels"):
        off = np.linalg.norm(SE3.translation(getattr(paths, name)) - true, axis=1)
        axes.plot(1e-9 * (stamps_ns - stamps_ns[0]), off, lw=1.0, label=name)
    axes.set(xlabel="s", ylabel="distance from the truth [m]", title="the first camera is the world")
    axes.legend(fontsize="small")
    figure.savefig(file, dpi=110)


def draw_time(run: Run, seconds_features: np.ndarray, file: Path) -> None:
    """Plots Fig. 7: milliseconds of each pair, by stage."""
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    axes: Any = figure.subplots()
    stages = {name: 1e3 * run.log[f"seconds_{name}"] for name in STAGES}
    stages["features"] = 1e3 * seconds_features
    axes.stackplot(np.arange(len(run.log)), *stages.values(), labels=list(stages), lw=0, alpha=0.7)
    highest = np.quantile(sum(stages.values()), 0.995)
    axes.set(xlabel="pair", ylabel="ms", ylim=(0.0, 1.2 * highest), title="time per pair")
    axes.legend(fontsize="small", loc="upper left")
    figure.savefig(file, dpi=110)
