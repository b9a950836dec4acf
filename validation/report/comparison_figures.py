"""Figures that comparisons share, drawn from arrays alone."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from rbpf.core.diagnostics import chi_square_band
from rbpf.runs.plots import COLOURS, SIGMAS, label, outline

CLOSE = 0.95
"""A map's picture holds this fraction of its landmarks; single ones far off do not make it small."""

_LOWEST = 0.01
"""NEES below this fraction of the band are drawn there."""


def wide_axes(positions: np.ndarray) -> tuple[int, int]:
    """The two axes, in their order, along which positions (T, 3) extend most."""
    first, second = sorted(np.argsort(-np.ptp(positions, axis=0), kind="stable")[:2].tolist())
    return first, second


def path_figure(title: str, curves: Mapping[str, np.ndarray], plane: tuple[int, int]) -> Any:
    """Paths (T, 3) by name, in a plane of the world."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axes = figure.subplots()
    right, up = plane
    for name, at in curves.items():
        style = "--" if name == "truth" else "-"
        axes.plot(at[:, right], at[:, up], style, color=COLOURS[name], lw=1.2, label=name)
        axes.plot(at[0, right], at[0, up], "o", color=COLOURS[name], ms=4)
    label(axes, title, f"{'xyz'[right]} [m]", f"{'xyz'[up]} [m]", equal=True)
    axes.legend(fontsize="small")
    return figure


def nees_figure(title: str, rows: np.ndarray, nees: np.ndarray, dim: int) -> Any:
    """Normalised squared errors (R,) of one run over the steps, with the band of an honest filter."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes, band = figure.subplots(), chi_square_band(dim)
    axes.axhspan(band.low, band.high, color="tab:green", alpha=0.2, label="95 % band of an honest filter, each step")
    axes.axhline(band.expected, color="tab:green", lw=0.8, label=f"its mean, {dim}")
    shown = np.maximum(nees, _LOWEST * band.low)
    axes.plot(rows, shown, color=COLOURS["filter"], lw=1.0, label="NEES of the pose")
    label(axes, title, "step", "NEES", equal=False)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.8 * min(float(shown.min(initial=band.low)), 0.5 * band.low))
    axes.legend(fontsize="small")
    return figure


def landmark_figure(title: str, squares: np.ndarray, dim: int) -> Any:
    """Distances of landmarks (M,) in σ, in order, beside those that an honest filter's would have."""
    from matplotlib.figure import Figure
    from scipy.stats import chi2

    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes, count = figure.subplots(), squares.size
    places = np.arange(1, count + 1)
    right = np.sqrt(chi2.ppf((places - 0.5) / count, dim))
    axes.plot(places, np.sqrt(np.sort(squares)), ".", color=COLOURS["map"], label="landmarks, in order")
    axes.plot(places, right, color="tab:green", lw=1.0, label="independent landmarks of an honest filter")
    label(axes, title, "landmark", "distance [σ of the filter]", equal=False)
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize="small")
    return figure


def map_figure(
    title: str,
    path: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
    other: Mapping[str, np.ndarray],
    plane: tuple[int, int],
) -> Any:
    """A map's points (M, 3) with ellipses from (M, 3, 3), over others' by name, in a plane of the world."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axes, chosen = figure.subplots(), list(plane)
    axes.plot(*path[:, chosen].T, color=COLOURS["filter"], lw=0.8, alpha=0.6, label="path of the filter")
    for name, points in other.items():
        axes.plot(*points[:, chosen].T, "+", color=COLOURS[name], ms=7, label=f"landmarks: {name}")
    axes.plot(*mean[:, chosen].T, ".", color=COLOURS["map"], ms=3, label=f"landmarks: filter, {SIGMAS:g}σ")
    ellipses = outline(mean[:, chosen], cov[:, chosen][:, :, chosen])
    axes.plot(ellipses[..., 0].T, ellipses[..., 1].T, color=COLOURS["map"], lw=0.7)
    label(axes, title, f"{'xyz'[chosen[0]]} [m]", f"{'xyz'[chosen[1]]} [m]", equal=True)
    shown = np.concatenate([path[:, chosen], *(points[:, chosen] for points in other.values()), mean[:, chosen]])
    low, high = np.quantile(shown, [0.5 * (1.0 - CLOSE), 0.5 * (1.0 + CLOSE)], axis=0)
    middle, half = 0.5 * (low + high), 0.65 * max(float((high - low).max()), 1e-3)
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal", adjustable="box")
    axes.legend(fontsize="small")
    return figure
