"""Pictures of a run beside its batch optimum and beside COLMAP's reconstruction, as PNG files."""

from pathlib import Path
from typing import Any

import numpy as np

from rbpf.lie import Array
from rbpf.runs.plots import COLOURS, Views, World, moved_map, new_axes, save_figures
from rbpf.runs.reading import PathAndMap
from rbpf.validation.colmap.compare import ColmapComparison
from rbpf.validation.consistency.against_batch import AgainstBatch
from rbpf.validation.consistency.statistic import inverse_roots
from rbpf.validation.report.comparison_figures import landmark_figure, map_figure, nees_figure, path_figure, wide_axes

_BINS = 20


def plot_against_batch(found: AgainstBatch, out: Path, world: World | None = None) -> list[str]:
    """Paths, expected NEES, landmarks and map beside the batch posterior; returns the file names.

    Args:
        found: the comparison.
        out: folder for the pictures.
        world: in which they are drawn; by default the filter's own.
    """
    name, theirs, ours, world = found.name, found.optimum.estimate, found.ours, world or World()
    both = {"batch": theirs.trajectory, "filter": found.filter.trajectory}
    motions = {which: world.motion(path) for which, path in both.items()}
    paths = {which: motions[which].transform(path.positions) for which, path in both.items()}
    plane = wide_axes(paths["batch"])
    figures = {"gtsam_path.png": path_figure(f"{name}: paths in {world.name}", paths, plane)}
    cov, cov_batch, delta = found.pose_errors()
    if len(cov):
        roots, ranks = inverse_roots(cov)
        nees = np.einsum("tab,tbc,tca->t", roots, cov_batch + delta[:, :, None] * delta[:, None], roots)
        title, known = f"{name}: expected NEES under the batch posterior", ranks == cov.shape[-1]
        figures["gtsam_nees.png"] = nees_figure(title, found.optimum.steps[known], nees[known], cov.shape[-1])
    if len(found.landmarks):
        title = f"{name}: landmarks against the batch optimum"
        figures["gtsam_landmarks.png"] = landmark_figure(title, np.square(found.landmarks.sigmas), found.landmarks.dims)
        rows = np.isin(ours.landmarks.ids, found.landmarks.keys)
        mean, cov = moved_map(ours.landmarks, motions["filter"]).in_space(rows)
        there = np.isin(theirs.landmarks.ids, found.landmarks.keys)
        batch = moved_map(theirs.landmarks, motions["batch"]).in_space(there)[0]
        title = f"{name}: map over the batch optimum, in {world.name}"
        figures["gtsam_map.png"] = map_figure(title, paths["filter"], mean, cov, {"batch": batch}, plane)
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


def _colmap_map(found: ColmapComparison, reference: PathAndMap) -> Any:
    views = Views.of_camera(reference.trajectory.world_from_body)
    figure, shown = views.axes(f"{found.reconstruction.name}: COLMAP brought onto the run")
    move = found.reference_from_colmap
    cloud, centres = (move.transform(found.reconstruction.points), move.transform(found.reconstruction.path.positions))
    low, high = _box(reference.landmarks.mean, reference.trajectory.positions)
    cloud = cloud[((cloud >= low) & (cloud <= high)).all(axis=1)]
    at, points = reference.trajectory.positions, reference.landmarks.mean
    for axes, (right, up) in shown:
        axes.plot(cloud[:, right], cloud[:, up], ".", color=COLOURS["odometry"], ms=1.5, label="COLMAP's points")
        axes.plot(points[:, right], points[:, up], ".", color=COLOURS["map"], ms=4, label="landmarks")
        axes.plot(at[:, right], at[:, up], color=COLOURS["filter"], lw=1.2, label="filter")
        axes.plot(centres[:, right], centres[:, up], "+", color=COLOURS["batch"], ms=6, label="COLMAP's key frames")
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
