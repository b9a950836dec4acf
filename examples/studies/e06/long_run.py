"""Figure 6: a hundred seconds at frame rate."""

import time
from dataclasses import replace
from typing import Any

import numpy as np

from examples.studies.e06.setting import Row, Setting, true_poses
from examples.studies.e06.worlds import LoopOverDesk
from rbpf.lie import SE3
from rbpf.runs.plots import COLOURS, SIGMAS, label, outline, save_figures
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.system import Tracked

FRAME_S = 1.0 / 30.0
WARM_UP = 5
"""Number of first frames, not counted, in which kernels are loaded."""

LAP = 430
"""Frames of one lap."""

WIDTH = 320
"""Width of the images, as three thousand of them take long to render."""

LANDMARKS, LEAST, MOST, PARTICLES = 265, 20, 30, 50
"""The paper's value."""


def reproduce(setting: Setting) -> list[Row]:
    """Filters the sequence."""
    frames = 40 if setting.quick else 3000
    setting = replace(setting, width=WIDTH)
    world = LoopOverDesk(frames=frames, laps=frames / LAP, texel_m=0.002)
    sequence, known = setting.sequence("long_loop", world)
    clock: list[float] = []

    def note(run: Run, _: Tracked) -> None:
        clock.append(time.process_time())

    run = filter_opened(open_mono(sequence, setting.config(), known), [note])
    mapped = run.system.map()
    cpu = np.diff(clock, prepend=clock[0])
    save_figures({"figure_6.png": _draw(run, mapped, true_poses(sequence), cpu)}, setting.out)
    return _rows(run, cpu)


def _rows(run: Run, cpu: np.ndarray) -> list[Row]:
    counted = run.log["seconds"][WARM_UP:]
    fraction, slowest = float((counted <= FRAME_S).mean()), 1e3 * float(counted.max())
    found = float(run.log["found"].mean())
    points, rays = int(run.log["points"][-1]), int(run.log["rays"][-1])
    held = points + rays
    within = float(((run.log["found"] >= LEAST) & (run.log["found"] <= MOST)).mean())
    lost = int(run.log.lost().sum())
    median = f"median {1e3 * np.median(counted):.1f} ms, slowest {slowest:.0f} ms"
    own = f"{1e3 * np.median(cpu[WARM_UP:]):.1f} ms of processor time, decoding and notes included"
    frames, particles = run.log.stamps_ns.size, run.system.config.particles
    return [
        Row("Fig. 6", f"landmarks after {frames} frames, {particles} particles", f"{LANDMARKS} after 3000, {PARTICLES}",
            f"{held} ({points} points, {rays} rays)", float(held), held >= LANDMARKS),
        Row("Fig. 6", "observations per frame", f"{LEAST} to {MOST}",
            f"mean {found:.1f}, {within:.0%} of the frames within", found, LEAST <= found <= MOST),
        Row("Fig. 6", f"fraction of frames under 33 ms ({run.system.camera.width} px wide)", "all (30 Hz)",
            f"{fraction:.1%}; {median}; {own}", fraction, fraction == 1.0),
        Row("Fig. 6", "frames in which the camera was lost", "none told", f"{lost}", float(lost), lost == 0),
    ]  # fmt: skip


def _draw(run: Run, mapped: MapEstimate, truth: np.ndarray, cpu: np.ndarray) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.0, 6.5), layout="constrained")
    panels: Any = figure.subfigures(1, 2, width_ratios=(1.0, 1.1))
    above, rows = panels[0].subplots(), panels[1].subplots(3, 1, sharex=True)
    _draw_map(above, run, mapped, truth)
    frames = np.arange(run.log["seconds"].size)
    held = np.stack([run.log["points"], run.log["rays"]], axis=1)
    rows[0].plot(frames, held.sum(axis=1), color="black", label="landmarks")
    rows[0].plot(frames, held[:, 0], color=COLOURS["filter"], label="of known depth")
    rows[1].plot(frames, run.log["found"], color=COLOURS["known"], lw=0.6, label="observations")
    rows[1].axhspan(LEAST, MOST, color="0.5", alpha=0.15, label="the paper's 20 to 30")
    rows[2].plot(frames[WARM_UP:], 1e3 * run.log["seconds"][WARM_UP:], ".", ms=1.5, label="time on the clock")
    rows[2].plot(frames[WARM_UP:], 1e3 * cpu[WARM_UP:], ".", ms=1.0, alpha=0.5, label="processor time, all threads")
    rows[2].axhline(1e3 * FRAME_S, color=COLOURS["map"], ls="--", lw=0.8, label="30 Hz")
    high = float(np.quantile(1e3 * run.log["seconds"][WARM_UP:], 0.995))
    rows[2].set(xlabel="frame", ylabel="ms", ylim=(0.0, max(40.0, 1.2 * high)))
    for axes in rows:
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _draw_map(axes: Any, run: Run, mapped: MapEstimate, truth: np.ndarray) -> None:
    full = ~mapped.is_ray()
    mean, cov = mapped.mean[full], mapped.cov[full]
    label(axes, f"map from above: {full.sum()} points with {SIGMAS:g}σ (Fig. 6)", "x [m]", "y [m]", equal=True)
    for ellipse in outline(mean[:, :2], cov[:, :2, :2]):
        axes.plot(*ellipse.T, color=COLOURS["map"], lw=0.4)
    axes.plot(*mean[:, :2].T, ".", color="black", ms=2)
    axes.plot(*SE3.translation(truth)[:, :2].T, color=COLOURS["truth"], lw=0.8, ls="--", label="true path")
    axes.plot(*SE3.translation(run.log.poses)[:, :2].T, color=COLOURS["filter"], lw=0.8, label="filter")
    axes.legend(fontsize="small")
