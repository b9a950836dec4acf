"""Figures 7 and 8: new landmarks on their rays in the map, and on their epipolar lines in the image."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from examples.studies.e06.setting import Row, Setting
from examples.studies.e06.worlds import LoopOverDesk
from rbpf.lie import SE3
from rbpf.runs.plots import COLOURS, label, outline, save_figures
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.sensors.readers import ImageSequence
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.system import Tracked
from rbpf.validation.report.video import draw_search

FIRST = 20
"""First frame to be considered: before, the camera is at rest."""

NEAR_M = 1.5
"""Distance from the centre of the map up to which rays are drawn."""


@dataclass
class Shown:
    """The frame with most epipolar lines of landmarks without depth: image, observations, map, path so far."""

    frame: int
    image: np.ndarray
    observation: Mapping[str, np.ndarray]
    found: int
    mapped: MapEstimate
    path: np.ndarray


def found_rays(seen: Mapping[str, np.ndarray]) -> np.ndarray:
    """(K,) which searched features were found and have no depth yet."""
    return np.asarray(np.isfinite(seen["px"]).all(axis=1) & np.isfinite(seen["line"]).all(axis=(1, 2)))


def line_distances(observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Distances (K,) of the found rays from their epipolar lines, px."""
    rows = found_rays(observation)
    start, end, px = observation["line"][rows, 0], observation["line"][rows, 1], observation["px"][rows]
    along = end - start
    length = np.linalg.norm(along, axis=1)
    cross = along[:, 0] * (px - start)[:, 1] - along[:, 1] * (px - start)[:, 0]
    return np.asarray(np.abs(cross) / np.maximum(length, 1e-12))


def line_lengths(observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Lengths (K,) of the epipolar lines of the found rays, px: points for a camera at rest."""
    rows = found_rays(observation)
    return np.asarray(np.linalg.norm(observation["line"][rows, 1] - observation["line"][rows, 0], axis=1))


@cache
def round_a_desk(setting: Setting) -> tuple[ImageSequence, Run, Shown]:
    """The sequence of figures 5, 7 and 8, its run, and the frame with most epipolar lines with the map at that time."""
    # A part of the loop, at the whole loop's pace.
    world = LoopOverDesk(frames=50, laps=0.12, texel_m=0.003) if setting.quick else LoopOverDesk()
    sequence, known = setting.sequence("loop", world)
    best: list[Shown] = []

    def watch(run: Run, _: Tracked) -> None:
        t, frame = len(run.log) - 1, run.frame
        observation = run.log.observed(t)
        lines = int((line_lengths(observation) > 2.0 * run.system.config.search.noise_px).sum())
        if t < FIRST or frame.image is None or (best and lines <= best[0].found):
            return
        path = run.log.poses[: t + 1].copy()
        best[:] = [Shown(t, frame.image, observation, lines, run.system.map(), path)]

    run = filter_opened(open_mono(sequence, setting.config(), known), [watch])
    (shown,) = best
    return sequence, run, shown


def reproduce(setting: Setting) -> list[Row]:
    """Draws the frame and its map."""
    _, run, shown = round_a_desk(setting)
    figures = {"figure_7.png": _draw_map(shown), "figure_8.png": _draw_image(shown, run)}
    save_figures(figures, setting.out)
    all_lines = np.concatenate(
        [line_distances(observation) for observation in map(run.log.observed, range(len(run.log)))]
    )
    rms = float(np.sqrt(np.mean(all_lines**2)))
    return [
        Row("Fig. 7", f"landmarks on rays in the map, frame {shown.frame}", "drawn",
            f"{int(shown.mapped.is_ray().sum())}", float(shown.mapped.is_ray().sum())),
        Row("Fig. 8", "of these seen on epipolar lines longer than 2 px", "drawn", f"{shown.found}",
            float(shown.found)),
        Row("Fig. 8", "distance of what is found from its epipolar line, whole sequence", "zero for a perfect pose",
            f"rms {rms:.2f} px", rms),
    ]  # fmt: skip


def _draw_map(shown: Shown) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 7.0), layout="constrained")
    axes = figure.subplots()
    label(axes, f"map at frame {shown.frame}: new landmarks on their rays (Fig. 7)", "x [m]", "y [m]", equal=True)
    full, rays = ~shown.mapped.is_ray(), shown.mapped.is_ray()
    mean, cov = shown.mapped.mean[full], shown.mapped.cov[full]
    camera = SE3.translation(shown.path)
    assert shown.mapped.ray_ends is not None
    ends = shown.mapped.ray_ends[rays]
    axes.plot(ends[..., 0].T, ends[..., 1].T, color=COLOURS["map"], lw=0.8)
    axes.plot([], [], color=COLOURS["map"], label="rays (±2σ of inverse depth)")
    for ellipse in outline(mean[:, :2], cov[:, :2, :2]):
        axes.plot(*ellipse.T, color=COLOURS["filter"], lw=0.6)
    axes.plot(*mean[:, :2].T, ".", color="black", ms=4, label="landmarks of known depth, 3σ")
    axes.plot(*camera[:, :2].T, color=COLOURS["known"], lw=1.2, label="camera")
    axes.plot(*camera[-1, :2], "o", color=COLOURS["known"])
    middle = np.median(np.concatenate([mean, camera]), axis=0)
    axes.set_xlim(middle[0] - NEAR_M, middle[0] + NEAR_M)
    axes.set_ylim(middle[1] - NEAR_M, middle[1] + NEAR_M)
    axes.set_aspect("equal", adjustable="box")
    axes.legend(fontsize="small")
    return figure


def _draw_image(shown: Shown, run: Run) -> Any:
    from matplotlib.figure import Figure

    camera = run.system.camera
    found, searched = (run.log[name][shown.frame] for name in ("found", "searched"))
    text = f"frame {shown.frame}   found {found} of {searched}   (Fig. 8)"
    picture = draw_search(shown.image, shown.observation, (text, ""), (camera.width, camera.height))
    figure = Figure(figsize=(picture.shape[1] / 110.0, picture.shape[0] / 110.0))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(picture)
    axes.set_axis_off()
    return figure
