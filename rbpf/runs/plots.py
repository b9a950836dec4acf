"""Plots of a run of any system, from its folder, without a display; the same set for all systems.

All are in one world, the truth's if there is one (`World`); each is also saved as vector graphics (.pdf) for print.
A further figure of every run is one function from `RunFolder` to a matplotlib figure, entered into `FIGURES`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.core.checkpoint import whole
from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.runs.files import BATCH, GRID
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.trajectory import Alignment, Similarity, Trajectory, associate, fit, in_space, read_tum
from rbpf.runs.truth import LEAST, TRUTH
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.map_estimate import MapEstimate

SIGMAS = 3.0
VECTORS = "pdf"  #: Suffix of a figure's second file in vector graphics, except for thousands of curves.
_MANY = 2000  #: From this number curves are rasterised in vector formats, too, to limit the file's size.
COLOURS = {
    "filter": "tab:blue",
    "truth": "black",
    "batch": "tab:orange",
    "odometry": "tab:grey",
    "map": "tab:red",
    "known": "tab:green",
}

#: The map's plot covers the path and this fraction of the points, so that single distant points do not shrink it.
MAP_FRACTION = 0.9
CAMERA_HZ = 30.0  #: Frame rate of a typical camera, for the timing plot.
#: Weight of the images' up direction relative to that of their rows, which do not tilt with the camera.
_UPRIGHT = 0.05

#: Columns of diagnostics.csv that are not plotted in the first row.
_NOT_COUNTS = {
    "step", "stamp_ns", "ess", "resampled", "log_evidence", "nis", "nis_dof", "lost", "updated", "assumed",
}  # fmt: skip


def draw_run(found: RunFolder, out: Path | None = None, formats: Sequence[str] = ("png", VECTORS)) -> list[str]:
    """Draws all figures of a run into a folder, by default its own; returns their file names."""
    drawn = {name: draw(found) for name, draw in FIGURES.items()}
    if found.system == "range-bearing":
        drawn["ess.png"] = drawn.pop("tracking.png")
    there = {Path(name).stem: figure for name, figure in drawn.items() if figure is not None}
    names = {f"{name}.{ending}": figure for ending in formats for name, figure in there.items()}
    return save_figures(names, out or found.folder)


def plot_trajectory(*runs: RunFolder, ax: Any = None) -> Any:
    """The path, together with truth, odometry and batch optimum, if available.

    Of several runs it is their paths, in one world. Returns the figure: seen from above and, in space, from the side. Into
    the axes `ax`, if they are given, only the view from above is drawn.
    """
    first, world = runs[0], World.of(*runs)
    paths = [world.brought(run.trajectory) for run in runs]
    names = [run.folder.name for run in runs] if len(runs) > 1 else ["filter"]
    colours = [f"C{k}" for k in range(len(runs))] if len(runs) > 1 else [COLOURS["filter"]]
    others = [each for each in other_paths(first, world) if len(runs) == 1 or each[0] == "truth"]
    figure, shown = Views.of(first.system, paths[0]).axes(f"{first.name}: path in {world.name}", ax)
    for axes, (right, up) in shown:
        for name, label_, at in others:
            style = "--" if name == "truth" else "-"
            axes.plot(at[:, right], at[:, up], style, color=COLOURS[name], lw=1.2, label=label_)
        for run, path, name, colour in zip(runs, paths, names, colours, strict=True):
            at, lost = path.positions, lost_frames(run)
            axes.plot(at[:, right], at[:, up], "-", color=colour, lw=1.2, label=name)
            axes.plot(at[0, right], at[0, up], "o", color=colour, ms=5, label="first frame" if run is first else None)
            if lost.any():
                axes.plot(at[lost, right], at[lost, up], ".", color=COLOURS["map"], ms=4, label="lost")
    shown[0][0].legend(loc="best", fontsize="small")
    return figure


def other_paths(found: RunFolder, world: "World") -> list[tuple[str, str, np.ndarray]]:
    """Reference paths of a run: name in `COLOURS`, label and positions (T, 3) of truth, odometry and batch."""
    others = []
    if world.truth is not None and (found.folder / TRUTH).is_file():
        others.append(("truth", "truth", world.truth.positions))
    for name, label_ in (("odometry", "odometry alone"), ("batch", "batch optimum")):
        if (found.folder / f"{name}.tum").is_file():
            others.append((name, label_, world.brought(read_tum(found.folder / f"{name}.tum")).positions))
    return others


def plot_map(found: RunFolder, ax: Any = None) -> Any:
    """Path and map.

    Points with 3σ ellipses, rays, known points; of a laser scanner the occupancy grid. Returns the figure, and takes axes,
    as `plot_trajectory`.
    """
    world = World.of(found)
    path, motion = world.brought(found.trajectory), world.motion(found.trajectory)
    if (found.folder / GRID).is_file():
        return _grid_figure(found, world, path, motion, ax)
    title, measured = f"{found.name}: {SIGMAS:g}σ map in {world.name}", found.measurements
    known = measured.known if isinstance(measured, FeatureLog) else None
    others = {} if known is None else {"known points": ("known", motion.transform(known.positions))}
    return draw_map(title, Views.of(found.system, path), path.positions, moved_map(found.map, motion), others, ax)


def near_box(mean: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mask of the nearby points (M, 3), and the lowest and highest corner of their box with the path (T, 3)."""
    far = np.linalg.norm(mean - np.median(np.concatenate([mean, at]), axis=0), axis=1)
    near = far <= np.quantile(far, MAP_FRACTION) if far.size else np.zeros(0, dtype=bool)
    held = np.concatenate([mean[near], at])
    return near, held.min(axis=0), held.max(axis=0)


def draw_map(
    title: str, views: "Views", at: Array, landmarks: MapEstimate, others: dict[str, tuple[str, Array]], ax: Any = None
) -> Any:
    """A path (T, 3) and a map of its world: points with 3σ ellipses, rays; others' points (K, 3), with a name in `COLOURS`."""
    figure, shown = views.axes(title, ax)
    mean, cov = landmarks.points().in_space()
    # Limits include nearby points with a margin; distant ones (rays) are cut off.
    near, low, high = near_box(mean, at)
    middle, half = 0.5 * (low + high), 0.55 * max(float((high - low).max()), 1e-3)
    for axes, plane in shown:
        right, up = plane
        axes.plot(at[:, right], at[:, up], color=COLOURS["filter"], lw=1.0, label="path")
        dense: Any = {"color": "black", "rasterized": len(mean) > _MANY}
        axes.plot(mean[:, right], mean[:, up], ".", ms=3, label=f"landmarks, {SIGMAS:g}σ", **dense)
        ellipses = outline(mean[near][:, plane], cov[near][:, plane][:, :, plane])
        axes.plot(ellipses[..., 0].T, ellipses[..., 1].T, lw=0.5, alpha=0.5, **dense)
        if landmarks.ray_ends is not None and landmarks.is_ray().any():
            ends = landmarks.ray_ends[landmarks.is_ray()]
            lines = axes.plot(ends[..., right].T, ends[..., up].T, color=COLOURS["map"], lw=0.7, alpha=0.7)
            lines[0].set_label("rays (depth not known yet)")
        for name, (colour, places) in others.items():
            axes.plot(places[:, right], places[:, up], "+", color=COLOURS[colour], ms=9, label=name)
        across, along = ((middle[axis] - half, middle[axis] + half) for axis in plane)
        axes.set(xlim=across, ylim=along[::-1] if axes.yaxis_inverted() else along)
        axes.set_aspect("equal", adjustable="box")
    shown[0][0].legend(loc="best", fontsize="small")
    return figure


def _grid_figure(found: RunFolder, world: "World", path: Trajectory, motion: Similarity, ax: Any) -> Any:
    """Path and occupancy grid: black occupied, white free, grey unknown."""
    from matplotlib.transforms import Affine2D

    grid, (figure, shown) = found.grid, Views((0, 1), None).axes(f"{found.name}: map in {world.name}", ax)
    axes = shown[0][0]
    # Drawn as a transformed image: a mesh of as many cells would take minutes and gigabytes.
    extent = grid.cell_m * np.array(grid.log_odds.shape[::-1])
    corners = grid.corner + extent * [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    at = motion.transform(np.pad(corners, ((0, 0), (0, 1))))[:, :2]
    place = np.vstack([np.column_stack([at[1] - at[0], at[2] - at[0], at[0]]), [0.0, 0.0, 1.0]])
    shades, unit = np.sign(grid.log_odds).astype(np.int8), (0.0, 1.0, 0.0, 1.0)
    image = axes.imshow(shades, "Greys", vmin=-1, vmax=1, origin="lower", extent=unit, interpolation="nearest")
    image.set_transform(Affine2D(place) + axes.transData)
    axes.dataLim.update_from_data_xy(at, ignore=True)
    axes.margins(0.0)
    axes.autoscale()
    axes.plot(path.positions[:, 0], path.positions[:, 1], color=COLOURS["filter"], lw=0.7, label="path")
    axes.legend(loc="best", fontsize="small")
    return figure


def particles_figure(found: RunFolder) -> Any:
    """Particles of the last frame, and mean and covariance of the position."""
    poses, weights = found.particles
    world = World.of(found)
    path, motion = world.brought(found.trajectory), world.motion(found.trajectory)
    figure, shown = Views.of(found.system, path).axes(f"{found.name}: {len(poses)} particles at the last frame")
    at = motion.transform(in_space(np.zeros(len(poses), dtype=np.int64), poses).positions)
    turn = motion.scale * motion.rotation
    mean, cov = path.positions[-1], turn @ position_covariances(found.path)[-1] @ turn.T
    for axes, (right, up) in shown:
        axes.scatter(
            at[:, right], at[:, up], s=1000 * weights, color=COLOURS["filter"], alpha=0.5,
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


def error_figure(found: RunFolder) -> Any | None:
    """Position error along the truth's axes, with the filter's 3σ bounds.

    None without truth.
    """
    if not (found.folder / TRUTH).is_file():
        return None
    truth, path = found.truth, found.path
    rows, how = truth.rows, truth.alignment
    estimate, reference = path.at(rows).trajectory, in_space(path.stamps_ns[rows], truth.poses)
    moved = fit(how, estimate.positions, reference.positions)
    error = moved.transform(estimate.positions) - reference.positions
    turned = moved.scale * moved.rotation
    cov = turned @ position_covariances(path)[rows] @ turned.T
    band = SIGMAS * np.sqrt(np.maximum(np.einsum("taa->ta", cov), 0.0))
    used = [axis for axis in range(3) if error[:, axis].any() or band[:, axis].any()] or [0]
    name = "no alignment" if how == "none" else f"after a {how} alignment of each"
    unit, word = (1e3, "mm") if np.abs(error).max(initial=0.0) < 1.0 else (1.0, "m")
    figure, panels = stacked_axes(len(used), f"{found.name}: error of the position, {name}")
    batch = None
    if (found.folder / BATCH).is_file():
        batch, true = associate(read_tum(found.folder / BATCH), reference, 0)
        at_batch = np.searchsorted(path.stamps_ns, true.stamps_ns)
        batch_error = fit(how, batch.positions, true.positions).transform(batch.positions) - true.positions
    lost = lost_frames(found)
    for axes, axis in zip(panels, used, strict=True):
        # The limits follow the errors; wide bounds in some frames are cut off.
        reach = 1.1 * unit * max(np.abs(error[:, axis]).max(), 1.2 * np.quantile(band[:, axis], 0.95))
        low, high = -unit * band[:, axis], unit * band[:, axis]
        label_ = f"{SIGMAS:g}σ of the filter"
        axes.fill_between(rows, low, high, color=COLOURS["filter"], alpha=0.2, lw=0, label=label_)
        if batch is not None:
            axes.plot(at_batch, unit * batch_error[:, axis], color=COLOURS["batch"], lw=1.0, label="error of the batch")
        axes.plot(rows, unit * error[:, axis], color=COLOURS["filter"], lw=1.0, label="error of the filter")
        axes.axhline(0.0, color="black", lw=0.5)
        axes.set(ylabel=f"{'xyz'[axis]} [{word}]", ylim=(-reach, reach) if reach > 0.0 else None)
        shade(axes, lost)
    panels[0].legend(loc="best", fontsize="small")
    panels[-1].set_xlabel("frame")
    return figure


def plot_error(*runs: RunFolder, ax: Any = None) -> Any:
    """Distance of each position from the truth, frame by frame, of one or several runs; into the axes `ax`, if given.

    Raises InputError: the first has no truth.
    """
    if not (runs[0].folder / TRUTH).is_file():
        raise InputError(f"{runs[0].folder} has no ground truth to draw errors from")
    world = World.of(*runs)
    assert world.truth is not None
    figure, axes = new_axes(f"{runs[0].name}: error in {world.name}", "error [m]", "frame", ax)
    for run in runs:
        moved = world.brought(run.trajectory)
        at, true = associate(moved, world.truth, 0)
        error = np.linalg.norm(at.positions - true.positions, axis=1)
        axes.plot(np.searchsorted(moved.stamps_ns, at.stamps_ns), error, lw=1.0, label=run.folder.name)
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="best", fontsize="small")
    return figure


def tracking_figure(found: RunFolder) -> Any:
    """Counts of observations, effective sample size and innovations, frame by frame."""
    table = found.table("diagnostics.csv", "step", "ess", "nis", "nis_dof")
    counts = {name: values for name, values in table.items() if name not in _NOT_COUNTS}
    shares = {name: counts.pop(name) for name, values in list(counts.items()) if (np.mod(values, 1.0) > 0.0).any()}
    # Columns after `updated` are valid only for frames with an update.
    updated, names = np.flatnonzero(table.get("updated", np.ones(table["step"].size))), list(table)
    of_update = names[names.index("updated") :] if "updated" in names else names
    rows = (["number"] if counts else []) + (["share"] if shares else []) + ["ess"]
    rows += ["nis"] if (table["nis_dof"] > 0).any() else []
    figure, panels = stacked_axes(len(rows), f"{found.name}: observations and filter")
    for axes, row in zip(panels, rows, strict=True):
        if row in ("number", "share"):
            for name, values in (counts if row == "number" else shares).items():
                at = updated if name in of_update else np.arange(values.size)
                axes.plot(at, values[at], lw=1.0, label=name.replace("_", " "))
            axes.set(ylabel=row, ylim=(0, None))
        elif row == "ess":
            axes.plot(updated, table["ess"][updated], color=COLOURS["filter"], lw=0.8, label="effective sample size")
            limit = found.config["resampling"]["ess_threshold"] * found.config["particles"]
            axes.axhline(limit, color=COLOURS["map"], lw=0.8, ls="--", label="resampling below")
            axes.set(ylabel="particles", ylim=(0, None))
        else:
            shown = (table["nis_dof"] > 0) & np.isfinite(table["nis"]) & (table["nis"] > 0)
            ratio = table["nis"][shown] / table["nis_dof"][shown]
            name = "NIS / degrees of freedom"
            axes.plot(table["step"][shown], ratio, ".", ms=3, color=COLOURS["filter"], label=name)
            axes.axhline(1.0, color="black", lw=0.8, label="mean of a consistent filter")
            axes.set(ylabel="ratio", yscale="log")
        shade(axes, table.get("lost", np.zeros(table["step"].size)).astype(bool))
        axes.legend(loc="best", fontsize="small")
    panels[-1].set_xlabel("frame")
    return figure


def timings_figure(found: RunFolder) -> Any:
    """Milliseconds per frame by stage, one over the other; frames that include compilation are cut off."""
    table = found.table("timings.csv", "step", "milliseconds")
    stages = {n.removesuffix("_ms").replace("_", " "): v for n, v in table.items() if n.endswith("_ms")}
    waiting = stages.pop("waiting for image", None)
    stages = stages or {"filter": table["milliseconds"]}
    figure, (axes,) = stacked_axes(1, f"{found.name}: time per frame")
    axes.stackplot(table["step"], *stages.values(), labels=list(stages), alpha=0.7, lw=0)
    high = 2.5 * max(float(np.median(table["milliseconds"])), 1e-3)
    if waiting is not None:
        axes.plot(table["step"], waiting, color="black", lw=0.6, label="waiting for the decoded image")
        axes.axhline(1e3 / CAMERA_HZ, color=COLOURS["map"], lw=0.8, ls="--", label=f"{CAMERA_HZ:g} Hz")
        high = max(1.3e3 / CAMERA_HZ, high)
    axes.set(xlabel="frame", ylabel="ms", ylim=(0.0, high))
    axes.legend(loc="best", fontsize="small")
    return figure


FIGURES: Mapping[str, Callable[[RunFolder], Any | None]] = {
    "path.png": plot_trajectory,
    "map.png": plot_map,
    "particles.png": particles_figure,
    "error.png": error_figure,
    "tracking.png": tracking_figure,
    "timings.png": timings_figure,
}


@dataclass(frozen=True)
class World:
    """The world of all plots of a run: the truth's if the recording has one, else the run's own.

    `alignment` is applied to filter, odometry and batch separately; `truth` is at the frames that have one.
    """

    name: str = "the run's own world"
    alignment: Alignment = "none"
    truth: Trajectory | None = None

    @classmethod
    def of(cls, found: RunFolder, *others: RunFolder) -> "World":
        """The world of a run, with the most general alignment that any of the further runs needs."""
        if not (found.folder / TRUTH).is_file():
            if not others:
                return cls()
            free: Alignment = "similarity" if found.system == "mono" else "rigid"
            return cls(f"the world of {found.folder.name}, {free} alignment", free, found.trajectory)
        truth = found.truth
        alignments = [truth.alignment, *(run.truth.alignment for run in others if (run.folder / TRUTH).is_file())]
        free = max(alignments, key=("none", "rigid", "similarity").index)
        how = "" if free == "none" else f", {free} alignment"
        return cls(f"the truth's world{how}", free, in_space(found.path.stamps_ns[truth.rows], truth.poses))

    def motion(self, estimate: Trajectory) -> Similarity:
        """The alignment of an estimate; the identity with too few true poses."""
        if self.truth is not None and self.alignment != "none":
            ours, true = associate(estimate, self.truth, 0)
            if len(ours) >= LEAST:
                return fit(self.alignment, ours.positions, true.positions)
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def brought(self, estimate: Trajectory) -> Trajectory:
        return estimate.transformed(self.motion(estimate))


def moved_map(found: MapEstimate, motion: Similarity) -> MapEstimate:
    """A map transformed by a similarity, reduced to the plane for a planar map."""
    motion = motion.in_dimension(found.mean.shape[1])
    turn = motion.scale * motion.rotation
    ends = None if found.ray_ends is None else motion.transform(found.ray_ends)
    return replace(found, mean=motion.transform(found.mean), cov=turn @ found.cov @ turn.T, ray_ends=ends)


def position_covariances(path: PathAndMap) -> np.ndarray:
    """(T, 3, 3) of the positions along the axes of the run's world; zero in z for a path in the plane."""
    local = path.cov_poses[:, -3:, -3:]
    if path.space.dim == 3:
        local = np.pad(local[:, 1:, 1:], ((0, 0), (0, 1), (0, 1)))
    turn = SE3.rotation(path.trajectory.world_from_body)
    return np.asarray(turn @ local @ turn.mT)


def lost_frames(found: RunFolder) -> np.ndarray:
    """(T,) bool: whether the run was lost, or its motion only assumed, by its diagnostics."""
    try:
        table = found.table("diagnostics.csv")
    except InputError:
        table = {}
    lost = table.get("lost", table.get("assumed", np.zeros(len(found.trajectory))))
    if lost.size != len(found.trajectory):
        raise InputError(f"{found.folder / 'diagnostics.csv'}: expected a row of each frame, found {lost.size}")
    return lost > 0


@dataclass(frozen=True)
class Views:
    """Views of a world: from above and, in space, from the side; each has the axes to the right and up.

    `down` says whether the vertical axis points down, as a camera's y axis does.
    """

    top: tuple[int, int]
    side: tuple[int, int] | None
    down: bool = False

    @classmethod
    def of(cls, system: str, path: Trajectory) -> "Views":
        """For a path of a system: up is z for a robot, for a camera perpendicular to its images' rows."""
        if system in ("range-bearing", "laser"):
            flat = not np.ptp(path.positions[:, 2]) > 0.0
            return cls((0, 1), None if flat else (0, 2))
        return cls.of_camera(path.world_from_body)

    @classmethod
    def of_camera(cls, world_from_camera: np.ndarray) -> "Views":
        """For a path (T, 7): a camera is rarely rolled, so the vertical is perpendicular to its images' rows."""
        turn = SE3.rotation(world_from_camera)
        upper = -turn[:, :, 1].mean(axis=0)
        score = np.square(turn[:, :, 0]).mean(axis=0) - _UPRIGHT * np.abs(upper)
        vertical = int(np.argmin(score))
        first, second = (vertical + 1) % 3, (vertical + 2) % 3
        down = bool(upper[vertical] < 0.0)
        top = (second, first) if down else (first, second)
        return cls(top, (top[0], vertical), down)

    def axes(self, title: str, ax: Any = None) -> tuple[Any, list[tuple[Any, list[int]]]]:
        """A figure, and its axes with the world axes they show; given axes show the view from above."""
        planes = [plane for plane in (self.top, self.side) if plane is not None]
        if ax is not None:
            label(ax, title, f"{'xyz'[self.top[0]]} [m]", f"{'xyz'[self.top[1]]} [m]", equal=True)
            return ax.figure, [(ax, list(self.top))]
        figure = blank(7.0 * len(planes), 5.6 if len(planes) == 1 else 6.3)
        figure.suptitle(title)
        panels = figure.subplots(1, len(planes), squeeze=False)[0]
        shown = [(axes, list(plane)) for axes, plane in zip(panels, planes, strict=True)]
        for (axes, (right, up)), view in zip(shown, ("from above", "from the side"), strict=False):
            label(axes, f"seen {view}", f"{'xyz'[right]} [m]", f"{'xyz'[up]} [m]", equal=True)
        if self.down:
            shown[1][0].invert_yaxis()
        return figure, shown


def shade(axes: Any, lost: np.ndarray) -> None:
    """Marks frames (T,) in which the system was lost."""
    if lost.any():
        axes.fill_between(
            np.arange(lost.size), 0, 1, where=lost, transform=axes.get_xaxis_transform(), color=COLOURS["map"],
            alpha=0.2, lw=0, label="lost",
        )  # fmt: skip


def save_figures(figures: Mapping[str, Any], out: Path, *also: str) -> list[str]:
    """Saves figures atomically by file name, whose suffix is the format; returns the names.

    `also` are endings of further files of each.
    """
    for name, figure in figures.items():
        # Dollar signs in names are not formulas; tick labels of logarithmic axes are.
        for axes in figure.axes:
            legend = axes.get_legend()
            for text in (axes.title, *(() if legend is None else legend.get_texts())):
                text.set_parse_math(False)
        for path in (out / name, *((out / name).with_suffix(f".{ending}") for ending in also)):
            ending, dpi = path.suffix[1:], 110 if path.suffix == ".png" else 220
            dated = {"CreationDate": None} if ending == "pdf" else None  # the same figure, the same bytes
            with whole(path) as temporary:
                figure.savefig(temporary, format=ending, dpi=dpi, metadata=dated)
            figure.set_layout_engine("none")  # the layout is the same for the next file, and expensive
    return list(figures)


def blank(width: float, height: float) -> Any:
    """An empty figure of a size [inches], which notebooks display."""
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        def _repr_png_(self) -> bytes:
            buffer = BytesIO()
            self.savefig(buffer, format="png", dpi=80)
            return buffer.getvalue()

    return ShownFigure(figsize=(width, height), layout="constrained")


def new_axes(title: str, ylabel: str, xlabel: str, ax: Any = None) -> tuple[Any, Any]:
    """A figure of one pair of axes; that of `ax`, if it is given."""
    axes = blank(7.0, 5.6).subplots() if ax is None else ax
    label(axes, title, xlabel, ylabel, equal=False)
    return axes.figure, axes


def stacked_axes(count: int, title: str) -> tuple[Any, list[Any]]:
    """A figure of stacked axes with a shared x axis."""
    figure = blank(7.0 + 0.6 * count, 5.6 + 0.48 * count)  # aspect of the other figures
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


def outline(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """The `SIGMAS` ellipses (..., 40, 2) of Gaussians (..., 2), (..., 2, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    circle = SIGMAS * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return mean[..., None, :] + circle @ np.swapaxes(root, -1, -2)
