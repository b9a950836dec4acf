"""Path and map as a scene that can be turned, for the report: plotly's traces, and its program, packed into the page.

The program (plotly.js, MIT) comes from the Python package of the same name. It is 4.8 MB, packed 2 MB; the page unpacks it by
itself, without a network.
"""

import gzip
import json
from base64 import b64encode
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.files import GRID
from rbpf.runs.plots import COLOURS, SIGMAS, Views, World, lost_frames, moved_map, near_box, other_paths, outline
from rbpf.runs.reading import RunFolder
from rbpf.systems.map_estimate import MapEstimate

#: Most of each that are drawn: a page is to be sent and turned on a telephone.
PATH_POINTS, FRUSTUMS, LANDMARKS, ELLIPSOIDS, CELLS = 4000, 60, 20_000, 400, 40_000
#: Half the width and height of a frustum, and its depth, of its size; its size as a fraction of the scene's.
_CORNERS = np.array([[-0.6, -0.45, 1.0], [0.6, -0.45, 1.0], [0.6, 0.45, 1.0], [-0.6, 0.45, 1.0]])
_SIZE = 0.02
_HEX = {
    "blue": "#1f77b4",
    "orange": "#ff7f0e",
    "grey": "#7f7f7f",
    "red": "#d62728",
    "green": "#2ca02c",
    "black": "#222",
}
_COLOURS = {name: _HEX[colour.removeprefix("tab:")] for name, colour in COLOURS.items()}


@cache
def program() -> str:
    """plotly.js, packed by gzip, as base64."""
    source = files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return b64encode(gzip.compress(source, 6, mtime=0)).decode()


def scene(found: RunFolder, world: World) -> str:
    """Path, cameras, map, truth, odometry and batch optimum of a run in one world, as JSON with `data` and `layout`."""
    path, motion = world.brought(found.trajectory), world.motion(found.trajectory)
    at, views = path.positions, Views.of(found.system, path)
    landmarks = moved_map(found.map, motion)
    mean, cov = landmarks.points().in_space()
    has_grid = (found.folder / GRID).is_file()
    if has_grid:
        rows, columns = np.nonzero(found.grid.log_odds > 0.0)
        cells = found.grid.corner + found.grid.cell_m * (np.column_stack([columns, rows]) + 0.5)
        mean = motion.transform(np.pad(_some(cells, CELLS), ((0, 0), (0, 1))))
    near, low, high = near_box(mean, at)
    size = max(float((high - low).max()), 1e-3)
    traces = [_line(at, "path", "filter", 4)]
    for name, label, positions in other_paths(found, world):
        traces.append(_line(positions, label, name, 2))
    if (lost := lost_frames(found)).any():
        traces.append(_points(at[lost], "lost", "map", 3))
    traces.append(_line(_frustums(path.world_from_body, found.system, _SIZE * size), "poses", "filter", 1))
    if has_grid:
        traces.append(_points(mean, "walls", "truth", 1))
    elif len(mean):
        traces.append(_points(_some(mean[near], LANDMARKS), "landmarks", "truth", 2))
        name = f"{SIGMAS:g}σ"
        if landmarks.mean.shape[1] == 2:
            rings = np.pad(outline(mean[near][:, :2], cov[near][:, :2, :2]), ((0, 0), (0, 0), (0, 1)))
            traces.append(_line(_strips(_some(rings, ELLIPSOIDS)), name, "truth", 1))
        else:
            traces.append(_ellipsoids(_some(mean[near], ELLIPSOIDS), _some(cov[near], ELLIPSOIDS), name))
    if (rays := _rays(landmarks)) is not None:
        traces.append(_line(_strips(rays), "rays (depth not known yet)", "map", 1) | {"visible": "legendonly"})
    # Everything in one scale, the longest side of the same length, whether the world is flat or not.
    margin = 0.05 * size
    sides = dict(zip("xyz", ((high - low + 2.0 * margin) / (size + 2.0 * margin)).tolist(), strict=True))
    axes = {
        f"{axis}axis": {"title": {"text": f"{axis} [m]"}, "range": [a - margin, b + margin]}
        for axis, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
    }
    # As on the maps: from above and a little from the side, with what is up on top.
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
    """At most so many of the rows, evenly chosen."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(int)]


def _packed(places: np.ndarray) -> dict[str, Any]:
    """Places (M, 3) as plotly reads them in few bytes."""
    columns = places.T.astype("<f4")
    return {
        axis: {"dtype": "f4", "bdata": b64encode(c.tobytes()).decode()} for axis, c in zip("xyz", columns, strict=True)
    }


def _line(places: np.ndarray, name: str, colour: str, width: int) -> dict[str, Any]:
    """A line, broken where a place is NaN."""
    drawn = {"color": _COLOURS[colour], "width": width}
    places = places if np.isnan(places).any() else _some(places, PATH_POINTS)
    return {"type": "scatter3d", "mode": "lines", "name": name, "line": drawn, "hoverinfo": "name", **_packed(places)}


def _points(places: np.ndarray, name: str, colour: str, size: int) -> dict[str, Any]:
    drawn = {"color": _COLOURS[colour], "size": size}
    return {"type": "scatter3d", "mode": "markers", "name": name, "marker": drawn, **_packed(places)}


def _strips(lines: np.ndarray) -> np.ndarray:
    """Lines (L, P, 3) as one with gaps."""
    return np.pad(lines, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 3)


def _frustums(world_from_body: np.ndarray, system: str, size: float) -> np.ndarray:
    """Some poses as pyramids, the base in the direction of view: of a camera along z, of a robot along x."""
    corners = size * _CORNERS
    if system in ("range-bearing", "laser"):
        corners = corners[:, [2, 0, 1]] * [1.0, 1.0, 0.0]
    a, b, c, d = corners
    top = np.zeros(3)
    outlines = np.array([top, a, b, c, d, a, top, b, top, c, top, d])
    poses = _some(world_from_body, FRUSTUMS)
    return _strips(SE3.transform(poses[:, None], outlines))


def _rays(landmarks: MapEstimate) -> np.ndarray | None:
    """The ends (R, 2, 3) of features whose depth is not known; None where there are none."""
    chosen = landmarks.is_ray()
    return None if landmarks.ray_ends is None or not chosen.any() else landmarks.ray_ends[chosen]


def _ellipsoids(mean: np.ndarray, cov: np.ndarray, name: str) -> dict[str, Any]:
    """Ellipsoids of Gaussians (M, 3), (M, 3, 3), each of 6 × 8 patches, as one mesh."""
    rings, around = 7, 8
    height = np.linspace(0.0, np.pi, rings)[:, None]
    turn = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    ball = np.stack(
        [np.sin(height) * np.cos(turn), np.sin(height) * np.sin(turn), np.cos(height) + 0.0 * turn], axis=-1
    ).reshape(-1, 3)
    values, vectors = np.linalg.eigh(cov)
    roots = SIGMAS * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    corners = mean[:, None] + ball @ roots.mT
    ring, k = np.mgrid[: rings - 1, :around]
    here, right = around * ring + k, around * ring + (k + 1) % around
    patches = np.stack([here, right, here + around, right, right + around, here + around], axis=-1).reshape(-1, 3)
    faces = (patches[None] + len(ball) * np.arange(len(mean))[:, None, None]).reshape(-1, 3).astype("<i4")
    drawn = {axis: {"dtype": "i4", "bdata": b64encode(c.tobytes()).decode()}
             for axis, c in zip("ijk", faces.T, strict=True)}  # fmt: skip
    look = {"color": _COLOURS["odometry"], "opacity": 0.35, "hoverinfo": "skip", "showlegend": True}
    return {"type": "mesh3d", "name": name, **look, **_packed(corners.reshape(-1, 3)), **drawn}
