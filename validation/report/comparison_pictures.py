"""Plots comparing a run with the truth, its batch optimum and COLMAP's reconstruction."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbpf.core.diagnostics import chi_square_band, chi_square_quantile
from rbpf.errors import InputError
from rbpf.runs import plots
from rbpf.runs.plots import COLOURS, Views, World, draw_map, moved_map, new_axes, save_figures
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.truth import TRUTH
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.consistency.against_groundtruth import TruthErrors, truth_errors
from rbpf.validation.consistency.statistic import inverse_roots

if TYPE_CHECKING:
    from rbpf.validation.colmap.compare import ColmapComparison
    from rbpf.validation.consistency.against_batch import AgainstBatch

NEES = "NEES of the pose"
_LOWEST = 0.01  #: NEES below this fraction of the band are drawn there.


def draw_truth(record: RunFolder, errors: TruthErrors) -> list[str]:
    """Draws NEES, landmarks and map into the run's folder; returns their names behind the run's own path and error."""
    name, world = record.name, World.of(record)
    curve, dim = {"filter": _nees(record, errors)}, errors.whitened.errors.shape[1]
    figures = {"groundtruth_nees.png": consistency_figure(f"{name}: {NEES}", NEES, curve, dim, banded=True)}
    if errors.landmarks is not None:
        found = errors.landmarks
        title = f"{name}: landmarks against the truth"
        figures["groundtruth_landmarks.png"] = landmark_figure(title, found.squares, found.white.shape[1])
        path, true = world.brought(record.trajectory), np.pad(found.truth, ((0, 0), (0, 3 - found.truth.shape[1])))
        title, others = f"{name}: map over the truth, in {world.name}", {"true landmarks": ("truth", true)}
        views = Views.of(record.system, path)
        figures["groundtruth_map.png"] = draw_map(title, views, path.positions, found.map, others)
    return ["path.png", "error.png", *save_figures(figures, record.folder, plots.VECTORS)]


def draw_beside(runs: Sequence[RunFolder], out: Path, formats: Sequence[str]) -> list[str]:
    """Draws runs of one recording together into a folder: paths, errors if there is truth, consistency; returns the names."""
    try:
        figures = {"path": plots.plot_trajectory(*runs), "consistency": plot_consistency(*runs)}
        if (runs[0].folder / TRUTH).is_file():
            figures["error"] = plots.plot_error(*runs)
    except InputError as error:
        them = " and ".join(str(run.folder) for run in runs)
        raise InputError(f"{them} cannot be drawn together, as those of one recording can: {error}") from error
    return save_figures({f"{name}.{ending}": figure for ending in formats for name, figure in figures.items()}, out)


def plot_against_batch(found: "AgainstBatch", out: Path, world: World | None = None) -> list[str]:
    """Expected NEES, landmarks and map compared with the batch posterior, in a world, by default the filter's own.

    Writes PNG files into the folder and returns their names.
    """
    name, theirs, ours, world = found.name, found.optimum.estimate, found.ours, world or World()
    both = {"batch": theirs.trajectory, "filter": found.filter.trajectory}
    motions = {which: world.motion(path) for which, path in both.items()}
    paths = {which: path.transformed(motions[which]) for which, path in both.items()}
    views = Views.of("mono" if isinstance(found.optimum.problem, FeatureLog) else "range-bearing", paths["batch"])
    figures: dict[str, Any] = {}
    cov, cov_batch, delta = found.pose_errors()
    if len(cov):
        roots, ranks = inverse_roots(cov)
        nees = np.einsum("tab,tbc,tca->t", roots, cov_batch + delta[:, :, None] * delta[:, None], roots)
        title, known = f"{name}: expected NEES under the batch posterior", ranks == cov.shape[-1]
        curve = {"filter": (found.optimum.steps[known], nees[known])}
        figures["gtsam_nees.png"] = consistency_figure(title, NEES, curve, cov.shape[-1], banded=True)
    if len(found.landmarks):
        title = f"{name}: landmarks against the batch optimum"
        dim = found.landmarks.delta.shape[-1]
        figures["gtsam_landmarks.png"] = landmark_figure(title, np.square(found.landmarks.sigmas), dim)
        places = moved_map(theirs.landmarks, motions["batch"]).in_space()[0]
        title = f"{name}: map over the batch optimum, in {world.name}"
        others = {"landmarks of the batch": ("batch", places)}
        ours_there = moved_map(ours.landmarks, motions["filter"])
        figures["gtsam_map.png"] = draw_map(title, views, paths["filter"].positions, ours_there, others)
    return save_figures(figures, out, plots.VECTORS)


def plot_against_colmap(found: "ColmapComparison", reference: PathAndMap, out: Path) -> list[str]:
    """Both maps and paths in the reference's world, and the landmarks' nearest distances; returns the file names."""
    views = Views.of_camera(reference.trajectory.world_from_body)
    figure, shown = views.axes(f"{found.reconstruction.name}: COLMAP brought onto the run")
    move = found.reference_from_colmap
    cloud, centres = (move.transform(found.reconstruction.points), move.transform(found.reconstruction.path.positions))
    at, points = reference.trajectory.positions, reference.landmarks.mean
    # Limits: the map and the path, and a tenth more, without COLMAP's far points.
    everything = np.concatenate([points, at])
    margin = 0.1 * np.ptp(everything, axis=0)
    low, high = everything.min(axis=0) - margin, everything.max(axis=0) + margin
    cloud = cloud[((cloud >= low) & (cloud <= high)).all(axis=1)]
    for axes, (right, up) in shown:
        axes.plot(cloud[:, right], cloud[:, up], ".", color=COLOURS["odometry"], ms=1.5, label="COLMAP's points")
        axes.plot(points[:, right], points[:, up], ".", color=COLOURS["map"], ms=4, label="landmarks")
        axes.plot(at[:, right], at[:, up], color=COLOURS["filter"], lw=1.2, label="filter")
        axes.plot(centres[:, right], centres[:, up], "+", color=COLOURS["batch"], ms=6, label="COLMAP's key frames")
    shown[0][0].legend(loc="best", fontsize="small")
    figures = {"colmap_map.png": figure}
    if found.cloud is not None:
        title = f"{found.reconstruction.name}: landmarks to the surface of COLMAP's points"
        figure, axes = new_axes(title, "landmarks", "distance [m]")
        axes.hist(found.cloud.surface_m, bins=20, color=COLOURS["filter"])
        axes.axvline(float(np.median(found.cloud.surface_m)), color=COLOURS["truth"], lw=0.8, ls="--", label="median")
        axes.legend(loc="best", fontsize="small")
        figures["colmap_cloud.png"] = figure
    return save_figures(figures, out, plots.VECTORS)


def plot_consistency(*runs: RunFolder, ax: Any = None) -> Any:
    """Consistency of one or several runs, frame by frame: NEES of the pose, see `truth_errors`.

    Without ground truth it is NIS of the measurements per degree of freedom. Returns the figure; draws into the axes `ax`, if
    they are given.
    """
    known = [(run.folder / TRUTH).is_file() for run in runs]
    curves, dim = {}, 1
    for run in runs:
        name = run.folder.name if len(runs) > 1 else "filter"
        if all(known):
            errors = truth_errors(run)
            curves[name], dim = _nees(run, errors), errors.whitened.errors.shape[1]
        else:
            table = run.table("diagnostics.csv", "nis", "nis_dof")
            rows = np.flatnonzero((table["nis_dof"] > 0) & np.isfinite(table["nis"]))
            curves[name] = rows, table["nis"][rows] / table["nis_dof"][rows]
    words = NEES if all(known) else "NIS per degree of freedom"
    return consistency_figure(f"{runs[0].name}: {words}", words, curves, dim, banded=all(known), ax=ax)


def _nees(run: RunFolder, errors: TruthErrors) -> tuple[np.ndarray, np.ndarray]:
    """Frames (R,) and their squared errors (R,), without unknown ones."""
    white = errors.whitened
    known = white.ranks > 0
    return run.truth.rows[known], white.nees[known]


def consistency_figure(
    title: str, words: str, curves: Mapping[str, tuple[np.ndarray, np.ndarray]], dim: int, banded: bool, ax: Any = None
) -> Any:
    """Normalised squared errors (R,) over the steps (R,) by name, their mean, and the band of a consistent filter."""
    (figure, axes), band = new_axes(title, words, "step", ax=ax), chi_square_band(dim)
    low = band.low if banded else 0.1
    if banded:
        axes.axhspan(low, band.high, color="tab:green", alpha=0.2, label="95 % band of a consistent filter, each step")
    axes.axhline(dim, color="tab:green", lw=0.8, label=f"its mean, {dim}")
    least = 0.5 * low
    for name, (rows, values) in curves.items():
        shown = np.maximum(values, _LOWEST * low)
        least = min(float(shown.min(initial=least)), least)
        axes.plot(rows, shown, lw=1.0, label=name)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.8 * least)
    axes.legend(fontsize="small")
    return figure


def landmark_figure(title: str, squares: np.ndarray, dim: int) -> Any:
    """Sorted distances of landmarks (M,) in σ, with those of a consistent filter."""
    figure, axes = new_axes(title, "distance [σ of the filter]", "landmark")
    places = np.arange(1, squares.size + 1)
    right = np.sqrt(chi_square_quantile((places - 0.5) / squares.size, dim))
    axes.plot(places, np.sqrt(np.sort(squares)), ".", color=COLOURS["map"], label="landmarks, in order")
    axes.plot(places, right, color="tab:green", lw=1.0, label="independent landmarks of a consistent filter")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize="small")
    return figure
