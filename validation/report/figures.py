"""What all pictures of runs fraction: axes, colours, ellipses, and PNG files drawn without a screen."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.runs.files import whole

SIGMAS = 3.0
COLOURS = {
    "filter": "tab:blue",
    "truth": "black",
    "batch": "tab:orange",
    "odometry": "tab:grey",
    "map": "tab:red",
    "known": "tab:green",
}


def save_figures(figures: Mapping[str, Any], out: Path) -> list[str]:
    """Saves figures by file name, each whole or not at all; returns the names."""
    for name, figure in figures.items():
        with whole(out / name) as temporary:
            figure.savefig(temporary, format="png", dpi=110, bbox_inches="tight")
    return list(figures)


def new_axes(title: str, ylabel: str = "y [m]", xlabel: str = "x [m]", equal: bool = True) -> tuple[Any, Any]:
    """A figure of one pair of axes, by default of equal scale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 6.0))
    axes = figure.subplots()
    label(axes, title, xlabel, ylabel, equal)
    return figure, axes


def stacked_axes(count: int, title: str) -> tuple[Any, list[Any]]:
    """A figure of pairs of axes one above the other that share what is along them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.0 + 2.0 * count), layout="constrained")
    rows = list(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0])
    rows[0].set_title(title)
    for axes in rows:
        axes.grid(alpha=0.3)
    return figure, rows


def label(axes: Any, title: str, xlabel: str, ylabel: str, equal: bool) -> None:
    """Title, names and grid of a pair of axes."""
    axes.set(title=title, xlabel=xlabel, ylabel=ylabel)
    if equal:
        axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)


def outline(mean: np.ndarray, cov: np.ndarray, points: int = 40) -> np.ndarray:
    """The `SIGMAS` ellipses (..., points, 2) of Gaussians (..., 2), (..., 2, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    circle = SIGMAS * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return mean[..., None, :] + circle @ np.swapaxes(root, -1, -2)
