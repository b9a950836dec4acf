"""Does the camera find its way back after the light was out? Many blackouts of a run, one at a time.

Each sequence is filtered once, undisturbed, with checkpoints at even distances. From each checkpoint the run is
continued once more, with a second of black images while the camera moves on, until it is tracked again or three seconds
of light have passed. The pose is judged against the truth a second after the camera was found: a blackout is recovered
from *rightly* within two seconds, rightly but late, *wrongly* (more than 10 cm or 3° worse than the undisturbed run in
the same frame), or not.

The first table has a line per sequence, the second one per failure, with how far recognition came: the landmarks in
view from where the camera truly is, the most corners that were like a landmark and like nothing else, and the most of
them that one pose explained. `blackouts.csv` has all. Where the light comes back on a place that the map does not know,
nothing can be recognised: blackouts with fewer than `LEAST_VISIBLE` landmarks in view are counted apart.

Without sequences a desk and a room are rendered. Sequences without ground truth are judged against the undisturbed run.
"""

from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.runs.plots import save_figures
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.blackout_runs import run_series
from rbpf.validation.blackouts import Blackouts, Outcome, Series
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.textured_desk import TexturedDesk
from rbpf.validation.simulation.textured_room import TexturedRoom
from rbpf.validation.tables import Cell, write_csv, write_table

LEAST_VISIBLE = 8
COLOURS = {"rightly": "tab:green", "late": "tab:olive", "wrongly": "tab:red", "not": "0.4"}


def simulated(out: Path, frames: int, quick: bool) -> list[Path]:
    """A desk and a room, rendered unless they have been before; the desk alone if it has to be quick."""
    size = (320, 240) if quick else (640, 480)
    camera = Pinhole(*size, 0.82 * size[0], 0.82 * size[0], 0.5 * size[0] - 0.5, 0.5 * size[1] - 0.5)
    worlds: dict[str, Any] = {"desk": TexturedDesk(frames=frames, texel_m=0.002 if quick else 0.001)}
    if not quick:
        worlds["room"] = TexturedRoom(frames=frames)
    for name, world in worlds.items():
        if not (out / name).exists():
            simulate_images(world, Imaging(grid=1 if quick else 2), camera, out / name, seed=0)
    return [out / name for name in worlds]


def line(series: Series) -> list[Cell]:
    """Of the first table."""
    verdicts = [series.verdict(one) for one in series.outcomes]
    fair = [one.visible >= LEAST_VISIBLE for one in series.outcomes]
    right = [verdict == "rightly" for verdict in verdicts]
    in_view = np.mean([r for r, f in zip(right, fair, strict=True) if f]) if any(fair) else np.nan
    seconds = [series.seconds(one) for one, r in zip(series.outcomes, right, strict=True) if r]
    counts = [verdicts.count(name) for name in ("rightly", "late", "wrongly", "not")]
    typical = float(np.median(seconds)) if seconds else np.nan
    return [series.name, len(verdicts), *counts, float(np.mean(right)), float(in_view), typical]


def details(series: Series, number: int) -> list[Cell]:
    """Of one blackout."""
    one = series.outcomes[number]
    metres, degrees = series.error(one)
    pairs = max((attempt.pairs for attempt in one.attempts), default=0)
    agreeing = max((attempt.agreeing for attempt in one.attempts), default=0)
    usual = float(series.usual_m[series.judged(one)])
    return [
        series.name, one.dark.start, series.verdict(one), float(series.way_m[number]), one.visible,
        series.seconds(one), metres, usual, degrees, pairs, agreeing, 1e3 * one.seconds_lost,
    ]  # fmt: skip


def draw(all_series: list[Series]) -> Figure:
    """Errors over time since the light went out; time to recovery over the distance."""
    figure = Figure(figsize=(12.0, 3.8 * len(all_series)), layout="constrained")
    rows = figure.subplots(len(all_series), 2, squeeze=False)
    for (over_time, over_way), series in zip(rows, all_series, strict=True):
        for one, way in zip(series.outcomes, series.way_m, strict=True):
            colour = COLOURS[series.verdict(one)]
            time = (np.arange(one.errors_m.size) - 1) / series.rate_hz
            over_time.semilogy(time, np.maximum(one.errors_m, 1e-4), lw=0.8, alpha=0.7, color=colour)
            if one.found >= 0:
                over_way.plot(way, series.seconds(one), "o", color=colour, ms=4)
            else:
                over_way.axvline(way, color=colour, lw=0.8, ls=":")
        over_time.set(
            title=series.name, xlabel="time since the light went out [s]", ylabel="error of position [m]"
        )
        over_way.set(xlabel="way in the dark [m] (dotted: not found again)", ylabel="time to recovery [s]")
        for axes in (over_time, over_way):
            axes.grid(alpha=0.3)
    for name, colour in COLOURS.items():
        rows[0, 1].plot([], [], "o", color=colour, label=name)
    rows[0, 1].legend(fontsize="small")
    return figure


def main(
    sequences: tuple[Path, ...] = (),
    blackouts: int = 50,
    first_s: float = 1.0,
    dark_s: float = 1.0,
    within_s: float = 2.0,
    frames: int = 900,
    particles: int = 50,
    seed: int = 0,
    workers: int = 1,
    out: Path = Path("demo/mono_blackouts"),
    quick: bool = False,
) -> dict[str, float]:
    """Blacks out a second at many places of sequences; prints how often the camera finds itself again.

    Args:
        sequences: with ground truth, if their errors are to count; by default a desk and a room are rendered.
        blackouts: on each sequence, at most.
        first_s: the first one is not before this.
        dark_s: how long the light is out.
        within_s: how soon the camera must be found.
        frames: of the rendered sequences.
        particles: of the filter.
        seed: of the filter.
        workers: processes.
        out: folder for picture, tables, checkpoints and rendered sequences.
        quick: four blackouts on a short desk, seen coarsely by few particles, not before 2 s: the map of the first
            seconds has too few landmarks of known depth to recognise anything.
    """
    if quick:
        blackouts, first_s, frames, particles = 4, 2.0, 180, 10
    config = MonoConfig(particles=particles, seed=seed)
    all_series = []
    for folder in sequences or simulated(out, frames, quick):
        plan = Blackouts(folder, config, blackouts, first_s, dark_s, within_s)
        all_series.append(run_series(plan, out, workers))
    header = [
        "sequence",
        "blackouts",
        "rightly",
        "late",
        "wrongly",
        "not",
        "share",
        "share in view",
        "median [s]",
    ]
    write_table(out / "summary.csv", header, [line(series) for series in all_series])
    rows = [details(series, number) for series in all_series for number in range(len(series.outcomes))]
    header = [
        "sequence", "frame", "verdict", "way [m]", "in view", "found after [s]", "error [m]", "undisturbed [m]",
        "error [°]", "pairs", "agreeing", "lost frame [ms]",
    ]  # fmt: skip
    write_csv(out / "blackouts.csv", header, rows)
    if any(row[2] != "rightly" for row in rows):
        write_table(out / "failures.csv", header, [row for row in rows if row[2] != "rightly"])
    save_figures({"mono_blackouts.png": draw(all_series)}, out)
    print(f"picture and tables in {out}")
    return figures_of(all_series)


def figures_of(all_series: list[Series]) -> dict[str, float]:
    """Shares over all sequences, and the errors of those that were found."""
    pairs: list[tuple[Series, Outcome]] = [(series, one) for series in all_series for one in series.outcomes]
    verdicts = [series.verdict(one) for series, one in pairs]
    errors = [series.error(one)[0] for series, one in pairs if series.verdict(one) == "rightly"]
    figures = {
        "blackouts": float(len(verdicts)),
        "recovered": verdicts.count("rightly") / len(verdicts),
        "wrong": verdicts.count("wrongly") / len(verdicts),
        "median error a second later [m]": float(np.median(errors)) if errors else np.nan,
    }
    for name, figure in figures.items():
        print(f"{name}: {figure:.3g}")
    return figures


if __name__ == "__main__":
    tyro.cli(main)
