"""The report of a run, report.html, made from the files in its folder, so that it can be rebuilt without the recording.

At the top the run and two lights; then the results: the video, which is a file beside the page, the rotatable 3D map, each
comparison with its plots, the run's own figures. The page needs no network: path and map are plotly traces, and plotly.js
(MIT) is embedded from the Python package, 4.8 MB, compressed to 2 MB, which the page unpacks.
"""

import gzip
import json
import shlex
import struct
from base64 import b64encode
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import to_hex

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs import plots
from rbpf.runs.files import GRID, PAGE, VIDEO, write_text
from rbpf.runs.provenance import command_of
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import SYSTEMS
from rbpf.systems.settings import defaults_of
from rbpf.validation.consistency import comparison as verdicts
from rbpf.validation.consistency.comparison import Verdict

_TITLES = {
    "groundtruth": "Against the ground truth", "gtsam": "Against the batch optimum", "colmap": "Against COLMAP",
    "itself": "Innovations", "relations": "Against known relations", "path": "Against another path",
}  # fmt: skip
#: Captions of plots, by name without the comparison's; those of the run itself are from their docstrings.
_CAPTIONS = {
    "nees": "Normalised squared error of the pose: inside the band in 95 of 100 steps of a consistent filter.",
    "landmarks": "Distances of the landmarks in σ, beside those of independent ones of a consistent filter.",
    "map": "The map over what it is compared with.",
    "cloud": "Distances of the landmarks from the surface of COLMAP's points.",
    "ess": "Effective sample size and innovations, frame by frame.",
}
#: Other paths with figures in summary.json, by the prefix of their names.
_OTHERS = {"odometry_": "odometry", "vo_": "odometry", "batch_": "batch", "final_": "final"}
_WORDS = {
    "position_rmse_m": "error of the positions, rms",
    "ate_rmse_m": "… after a rigid alignment",
    "ate_sim3_rmse_m": "… after an alignment with scale",
    "sim3_scale": "scale of that alignment",
    "rpe_translation_rmse_m": "error of the motion per frame",
    "rpe_rotation_rmse_deg": "error of the rotation per frame",
    "ms_per_frame": "time per frame",
}
#: Entries of summary.json that are elsewhere on the page, or redundant.
_ELSEWHERE = {"system", "recording", "finished", "alignment", "path_rmse_m", "remarks", "problems", "failure"}
_UNITS = {"m": "m", "deg": "°", "px": "px", "mb": "MB", "ms": "ms", "s": "s", "rad": "rad", "frame": "ms"}
_WIDE = 1.9  #: Aspect ratio from which on a plot takes the full width of the page.


class Picture(NamedTuple):
    """A picture of the page."""

    name: str
    data: str  #: PNG, as base64.
    caption: str
    wide: bool
    vectors: str  #: Name of the file beside the page with the same plot as vector graphics; "" for none.


def write_report(folder: Path, problems: list[str] | None = None) -> Verdict:
    """Builds `report.html` of a run from the files in its folder; returns the verdict shown at the top.

    `problems` are further warnings, one sentence each.
    """
    from jinja2 import Environment, PackageLoader, select_autoescape

    record, problems = RunFolder.open(folder), list(problems or ())
    # Comparisons in the folder, the truth's first, and the run's own statistics.
    comparisons, damaged = verdicts.read_comparisons(folder)
    comparisons.sort(key=lambda c: (c.against != "groundtruth", c.against))
    problems += damaged
    try:
        comparisons.append(verdicts.compare_with_itself(record))
    except InputError as error:
        problems.append(f"{error}.")
    verdict = replace(verdicts.verdict_of(record, comparisons), problems=tuple(problems))
    drawn = {name for comparison in comparisons for name in comparison.pictures}
    own = {path.name for path in folder.glob("*.png")} - drawn
    ordered = [name for name in plots.FIGURES if name in own] + sorted(own - plots.FIGURES.keys())
    world, turned = plots.World(), ""  # where truth, path or map are damaged
    with suppress(InputError):
        world = plots.World.of(record)
    with suppress(InputError):
        turned = scene(record, world)
    # Do not repeat the sentence at the top.
    sections = [
        {
            "title": _TITLES.get(comparison.against, f"Against {comparison.against}"),
            "accuracy": "" if comparison.accuracy in verdict.path.sentence else comparison.accuracy,
            "statistics": comparison.statistics,
            "figures": {} if comparison.against == "itself" else _told(comparison.figures),
            "images": _images(folder, comparison.pictures),
        }
        for comparison in comparisons
    ]
    beside, alone = _beside(record.summary)
    sections.append({"title": "The run", "beside": beside, "figures": alone, "images": _images(folder, ordered)})
    loader = PackageLoader("rbpf.validation.report", "templates")
    environment = Environment(loader=loader, autoescape=select_autoescape(), trim_blocks=True, lstrip_blocks=True)
    environment.filters["digits"] = digits
    # System, size, date and version.
    day, kind = str(record.summary.get("finished", ""))[:10], SYSTEMS.get(record.system)
    usual = [] if kind is None else [asdict(each) for each in (kind.config(), defaults_of(kind.config, record.config))]
    counted = [f"{record.summary[name]} {name}" for name in ("frames", "particles") if name in record.summary]
    shown = {
        "verdict": verdict,
        "world": world,
        "facts": ", ".join([record.system, *counted, *([day] if day else []), f"rbpf {record.config.get('rbpf', '')}"]),
        # The command that repeats the run; none for a system that is not on the command line.
        "command": "" if kind is None else shlex.join(command_of(record.config, *usual)),
        "remarks": [*record.summary.get("remarks", ()), *verdict.problems],
        "on_frames": record.summary.get("problems", ()),
        "sections": [each for each in sections if any(each.get(part) for part in each if part != "title")],
        "video": VIDEO if (folder / VIDEO).is_file() else None,
        "scene": turned,
        "program": program() if turned else "",
    }
    write_text(folder / PAGE, environment.get_template(PAGE).render(title=record.name, **shown))
    return verdict


def _images(folder: Path, names: list[str]) -> list[Picture]:
    # Links are not followed: they could disclose other files of the machine.
    inside = folder.resolve()
    found = []
    for name in names:
        path = folder / name
        if path.is_file() and path.resolve().is_relative_to(inside):
            data = path.read_bytes()
            width, height = struct.unpack(">II", data[16:24]) if len(data) >= 24 else (1, 1)
            bare = path.stem.rpartition("_")[2]
            drawn = plots.FIGURES.get(name) or (None if bare in _CAPTIONS else plots.FIGURES.get(f"{bare}.png"))
            caption = _CAPTIONS.get(bare, "") if drawn is None else (drawn.__doc__ or "").splitlines()[0]
            beside = path.with_suffix(f".{plots.VECTORS}")
            vectors = beside.name if beside.is_file() else ""
            found.append(Picture(path.stem, b64encode(data).decode(), caption, width > _WIDE * height, vectors))
    return found


def _beside(summary: Mapping[str, Any]) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Figures that other paths also have, as a table with a header, and all others."""
    columns = ["filter", *dict.fromkeys(_OTHERS.values())]
    rows: dict[str, dict[str, str]] = {}
    taken = set(_ELSEWHERE)
    for name in summary:
        for prefix, column in _OTHERS.items():
            bare = name.removeprefix(prefix)
            if bare != name and bare in summary and bare not in _ELSEWHERE:
                rows.setdefault(bare, {"filter": digits(summary[bare], bare)})[column] = digits(summary[name], bare)
                taken |= {name, bare}
            elif bare != name and bare in _ELSEWHERE:
                taken.add(name)
    used = [column for column in columns if any(column in row for row in rows.values())]
    table = {_label(name): [row.get(column, "") for column in used] for name, row in rows.items()}
    alone = {name: value for name, value in summary.items() if name not in taken}
    return ({"": used} | table if table else {}), _told(alone)


def _told(figures: Mapping[str, Any]) -> dict[str, str]:
    """Readable names and numbers, without missing values."""
    found = {}
    for name, value in figures.items():
        if isinstance(value, Mapping):
            found[_label(name)] = ", ".join(f"{inner} {digits(item, name)}" for inner, item in value.items())
        elif value is not None:
            found[_label(name)] = digits(value, name)
    return found


def _label(name: str) -> str:
    """A name in words, without its unit."""
    bare, _, unit = name.rpartition("_")
    return _WORDS.get(name, (bare if unit in _UNITS and bare else name).replace("_", " "))


def digits(value: Any, name: str = "") -> str:
    """A figure with three significant digits, more only before the point, and its unit, from the end of its name."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    unit = _UNITS.get(name.rpartition("_")[2], "")
    if unit == "m" and isinstance(value, float) and 0.0 < abs(value) < 0.1:
        value, unit = 1e3 * value, "mm"
    if isinstance(value, int):
        text = f"{value:,}"
    elif not np.isfinite(value) or (value and not 1e-4 <= abs(value) < 1e9):
        text = f"{value:.2g}"
    else:
        whole = int(np.floor(np.log10(abs(value)))) + 1 if value else 1
        text = f"{value:,.{max(0, 3 - max(whole, 1) if abs(value) >= 1.0 else 3 - whole)}f}"
    return f"{text}{'' if unit == '°' else ' ' if unit else ''}{unit}"


#: Maximum elements drawn of each kind, so that the page is small enough to send and to view on a telephone.
PATH_POINTS, FRUSTUMS, LANDMARKS, ELLIPSOIDS, CELLS = 4000, 60, 20_000, 400, 40_000
#: Half the width and height of a frustum, and its depth, of its size; its size as a fraction of the scene's.
_CORNERS = np.array([[-0.6, -0.45, 1.0], [0.6, -0.45, 1.0], [0.6, 0.45, 1.0], [-0.6, 0.45, 1.0]])
_SIZE = 0.02
_COLOURS = {name: to_hex(colour) for name, colour in plots.COLOURS.items()}


@cache
def program() -> str:
    """plotly.js, packed by gzip, as base64."""
    source = files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return b64encode(gzip.compress(source, 6, mtime=0)).decode()


def scene(found: RunFolder, world: plots.World) -> str:
    """Path, cameras, map, truth, odometry and batch optimum of a run in one world, as JSON with `data` and `layout`."""
    path, motion = world.brought(found.trajectory), world.motion(found.trajectory)
    at, views = path.positions, plots.Views.of(found.system, path)
    landmarks = plots.moved_map(found.map, motion)
    mean, cov = landmarks.points().in_space()
    has_grid = (found.folder / GRID).is_file()
    if has_grid:
        mean = motion.transform(np.pad(_some(found.grid.walls(), CELLS), ((0, 0), (0, 1))))
    near, low, high = plots.near_box(mean, at)
    size = max(float((high - low).max()), 1e-3)
    traces = [_line(at, "path", "filter", 4)]
    traces += [_line(positions, label, name, 2) for name, label, positions in plots.other_paths(found, world)]
    if (lost := plots.lost_frames(found)).any():
        traces.append(_points(at[lost], "lost", "map", 3))
    traces.append(_line(_frustums(path.world_from_body, found.system, _SIZE * size), "poses", "filter", 1))
    if has_grid:
        traces.append(_points(mean, "walls", "truth", 1))
    elif len(mean):
        traces.append(_points(_some(mean[near], LANDMARKS), "landmarks", "truth", 2))
        name = f"{plots.SIGMAS:g}σ"
        if landmarks.mean.shape[1] == 2:
            rings = np.pad(plots.outline(mean[near][:, :2], cov[near][:, :2, :2]), ((0, 0), (0, 0), (0, 1)))
            traces.append(_line(_strips(_some(rings, ELLIPSOIDS)), name, "truth", 1))
        else:
            traces.append(_ellipsoids(_some(mean[near], ELLIPSOIDS), _some(cov[near], ELLIPSOIDS), name))
    # Features of unknown depth, by the ends of their rays (R, 2, 3).
    rays = np.zeros((0, 2, 3)) if landmarks.ray_ends is None else landmarks.ray_ends[landmarks.is_ray()]
    if len(rays):
        traces.append(_line(_strips(rays), "rays (depth not known yet)", "map", 1) | {"visible": "legendonly"})
    # Equal scale of all axes, with a longest side of fixed length, for planar and spatial worlds.
    margin = 0.05 * size
    sides = dict(zip("xyz", ((high - low + 2.0 * margin) / (size + 2.0 * margin)).tolist(), strict=True))
    axes = {
        f"{axis}axis": {"title": {"text": f"{axis} [m]"}, "range": [a - margin, b + margin]}
        for axis, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
    }
    # As in the maps: from above and slightly from the side, with up on top.
    up = np.zeros(3)
    vertical = 2 if views.side is None else views.side[1]
    up[vertical] = -1.0 if views.down else 1.0
    eye = 0.8 * up - 0.7 * np.eye(3)[views.top[1]] * (-1.0 if views.down else 1.0) + 0.25 * np.eye(3)[views.top[0]]
    camera = {name: dict(zip("xyz", v.tolist(), strict=True)) for name, v in (("up", up), ("eye", eye))}
    layout = {
        "scene": {**axes, "aspectmode": "manual", "aspectratio": sides, "camera": camera},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"orientation": "h", "y": 0.0, "yanchor": "top"},
    }
    return json.dumps({"data": traces, "layout": layout}).replace("<", "\\u003c")


def _some(rows: np.ndarray, most: int) -> np.ndarray:
    """At most this many of the rows, evenly chosen."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(int)]


def _packed(rows: np.ndarray, names: str = "xyz", kind: str = "f4") -> dict[str, Any]:
    """Positions (M, 3), or other rows of three numbers, in plotly's compact encoding."""
    columns = zip(names, rows.T.astype(f"<{kind}"), strict=True)
    return {name: {"dtype": kind, "bdata": b64encode(column.tobytes()).decode()} for name, column in columns}


def _line(places: np.ndarray, name: str, colour: str, width: int) -> dict[str, Any]:
    """A line, broken at positions that are NaN."""
    drawn = {"color": _COLOURS[colour], "width": width}
    places = places if np.isnan(places).any() else _some(places, PATH_POINTS)
    return {"type": "scatter3d", "mode": "lines", "name": name, "line": drawn, "hoverinfo": "name", **_packed(places)}


def _points(places: np.ndarray, name: str, colour: str, size: int) -> dict[str, Any]:
    drawn = {"color": _COLOURS[colour], "size": size}
    return {"type": "scatter3d", "mode": "markers", "name": name, "marker": drawn, **_packed(places)}


def _strips(lines: np.ndarray) -> np.ndarray:
    """Lines (L, P, 3) as one line with gaps."""
    return np.pad(lines, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 3)


def _frustums(world_from_body: np.ndarray, system: str, size: float) -> np.ndarray:
    """Some poses as pyramids, with the base in the viewing direction: z for a camera, x for a robot."""
    corners = size * _CORNERS
    if system in ("range-bearing", "laser"):
        corners = corners[:, [2, 0, 1]] * [1.0, 1.0, 0.0]
    a, b, c, d = corners
    top = np.zeros(3)
    outlines = np.array([top, a, b, c, d, a, top, b, top, c, top, d])
    return _strips(SE3.transform(_some(world_from_body, FRUSTUMS)[:, None], outlines))


def _ellipsoids(mean: np.ndarray, cov: np.ndarray, name: str) -> dict[str, Any]:
    """Ellipsoids of Gaussians (M, 3), (M, 3, 3), each of 6 × 8 patches, as one mesh."""
    rings, around = 7, 8
    height = np.linspace(0.0, np.pi, rings)[:, None]
    turn = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    ball = np.stack(
        [np.sin(height) * np.cos(turn), np.sin(height) * np.sin(turn), np.cos(height) + 0.0 * turn], axis=-1
    ).reshape(-1, 3)
    values, vectors = np.linalg.eigh(cov)
    roots = plots.SIGMAS * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    corners = mean[:, None] + ball @ roots.mT
    ring, k = np.mgrid[: rings - 1, :around]
    here, right = around * ring + k, around * ring + (k + 1) % around
    patches = np.stack([here, right, here + around, right, right + around, here + around], axis=-1).reshape(-1, 3)
    faces = (patches[None] + len(ball) * np.arange(len(mean))[:, None, None]).reshape(-1, 3)
    look = {"color": _COLOURS["odometry"], "opacity": 0.35, "hoverinfo": "skip", "showlegend": True}
    return {"type": "mesh3d", "name": name, **look, **_packed(corners.reshape(-1, 3)), **_packed(faces, "ijk", "i4")}
