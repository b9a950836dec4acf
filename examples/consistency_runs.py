"""Does the filter know how wrong it is? Many simulated runs of both systems, with few and many particles.

The normalised error squared of the pose (NEES), the mean over independent recordings, is 1 per degree of freedom for an
honest filter, and stays in the green band in 95 % of the steps. A filter is over-confident from the step at which it
leaves the band upwards and does not come back (`left_for_good`). The upper pictures have
the curves for three numbers of particles. The lower ones have, for the middle number, what each remedy does to the mean
over all steps: iterating the proposal's linearisation, the exact importance ratio instead of the linearised weight,
re-estimating the start (range-bearing), marginalising the frame of the known points instead of sampling the start
(monocular), or the lack of each.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.systems.filtering import ProposalConfig
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.monte_carlo import Consistency, run_trials
from rbpf.validation.consistency.trials import DeskTrial, RobotTrial, Trial
from rbpf.validation.simulation.point_worlds import DeskWorld
from rbpf.validation.simulation.robot import RobotWorld
from rbpf.validation.tables import write_csv, write_table

MONO, ROBOT = "monocular", "range-bearing"
Trials = dict[str, Callable[[int], Trial]]


def robot_trials(steps: int, particles: tuple[int, ...]) -> tuple[Trials, Trials]:
    """Range-bearing runs by number of particles, and with one thing changed at the middle number."""
    world, base = RobotWorld(steps=steps), RangeBearingConfig(particles=particles[1])
    changed = {
        "bootstrap proposal": replace(base, proposal=ProposalConfig(kind="prior")),
        "one linearisation": replace(base, proposal=ProposalConfig(iterations=1)),
        "linearised weights": replace(base, proposal=ProposalConfig(weights="linearised")),
        "start never re-estimated": replace(base, anchor_every=0),
        "start re-estimated in every step": replace(base, anchor_every=1),
    }
    sizes = {f"{n} particles": RobotTrial(world, RangeBearingConfig(particles=n)) for n in particles}
    return sizes, {name: RobotTrial(world, config) for name, config in changed.items()}


def desk_trials(frames: int, particles: tuple[int, ...]) -> tuple[Trials, Trials]:
    """The same for the camera over a desk."""
    world, base = DeskWorld(frames=frames), MonoConfig(particles=particles[1])
    changed = {
        "start sampled (known points as landmarks)": replace(base, known="points"),
        "three linearisations": replace(base, proposal=ProposalConfig(iterations=3)),
        "linearised weights": replace(base, proposal=ProposalConfig(weights="linearised", iterations=1)),
        "epipolar constraint": replace(base, ray=replace(base.ray, constrain="epipolar")),
    }
    sizes = {f"{n} particles": DeskTrial(world, MonoConfig(particles=n)) for n in particles}
    return sizes, {name: DeskTrial(world, config) for name, config in changed.items()}


def draw_curves(axes: Any, system: str, found: dict[str, Consistency]) -> None:
    """Mean NEES per degree of freedom over time."""
    first = next(iter(found.values()))
    band, dim = first.band(), first.dim
    axes.axhspan(
        band.low / dim, band.high / dim, color="tab:green", alpha=0.25, label="95 % band, honest filter"
    )
    for name, consistency in found.items():
        start = consistency.overconfident_from
        (line,) = axes.plot(consistency.mean_nees / dim, lw=1.1, label=name)
        if start is not None:
            axes.axvline(start, color=line.get_color(), lw=0.8, ls=":")
    runs = len(first.trials)
    axes.set(
        title=f"{system}: NEES of the pose, mean of {runs} runs",
        xlabel="step",
        ylabel="NEES / d",
        yscale="log",
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def draw_remedies(axes: Any, found: dict[str, Consistency]) -> None:
    """Mean over all steps, with its standard error, for poses and landmarks."""
    places = np.arange(len(found))[::-1]
    for shift, what, colour in ((0.12, "pose_nees", "tab:blue"), (-0.12, "landmark_nees", "tab:red")):
        means = [getattr(consistency, what) for consistency in found.values()]
        values, errors = [mean.value for mean in means], [2.0 * mean.error for mean in means]
        axes.errorbar(
            values, places + shift, xerr=errors, fmt="o", color=colour, label=what.replace("_nees", "s")
        )
    axes.axvline(1.0, color="tab:green", lw=1.0)
    axes.set_yticks(places, list(found))
    axes.set(xlabel="NEES / d, ± 2 standard errors", xscale="log")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def table_row(system: str, name: str, consistency: Consistency) -> list[str | int | float]:
    """One line of the table."""
    start = consistency.overconfident_from
    return [
        system, name, len(consistency.trials), consistency.pose_nees.value, consistency.landmark_nees.value,
        consistency.nis.value, consistency.coverage(0.5).value, consistency.coverage(0.9).value,
        consistency.coverage(0.95).value, "never" if start is None else start,
        1e3 * consistency.position_rmse.value, consistency.coalescence,
    ]  # fmt: skip


def main(
    runs: int = 50,
    remedies: int = 20,
    steps: int = 150,
    particles: tuple[int, int, int] = (50, 250, 1000),
    workers: int = 2,
    out: Path = Path("demo/consistency_runs"),
    quick: bool = False,
) -> dict[str, float]:
    """Runs everything and prints the table.

    Args:
        runs: recordings for each number of particles.
        remedies: recordings for each remedy.
        steps: of each recording.
        particles: three numbers of them; remedies are tried with the middle one.
        workers: processes.
        out: folder for picture and tables.
        quick: few short recordings, few particles.
    """
    if quick:
        runs, remedies, steps, particles, workers = 6, 3, 40, (10, 20, 40), 1
    figure = Figure(figsize=(14.0, 9.0), layout="constrained")
    panels = figure.subplots(2, 2)
    rows, curves = [], dict[str, np.ndarray]()
    systems = {MONO: desk_trials(steps, particles), ROBOT: robot_trials(steps, particles)}
    for column, (system, (sizes, changed)) in enumerate(systems.items()):
        found = {name: run_trials(trial, range(runs), workers) for name, trial in sizes.items()}
        middle = f"{particles[1]} particles"
        few = Consistency(found[middle].trials[:remedies])
        tried = {"as it is": few} | {
            name: run_trials(trial, range(remedies), workers) for name, trial in changed.items()
        }
        draw_curves(panels[0, column], system, found)
        draw_remedies(panels[1, column], tried)
        for name, consistency in (found | {f"{middle}, {key}": c for key, c in tried.items()}).items():
            rows.append(table_row(system, name, consistency))
            curves[f"{system}, {name}"] = consistency.mean_nees
    header = [
        "system", "filter", "runs", "poses", "landmarks", "NIS", "in 50 %", "in 90 %", "in 95 %", "over-confident from",
        "error [mm]", "coalescence",
    ]  # fmt: skip
    rows.sort(key=lambda row: str(row[0]))
    write_table(out / "consistency.csv", header, rows)
    steps_of = [[t, *(float(curve[t]) for curve in curves.values())] for t in range(steps)]
    write_csv(out / "nees.csv", ["step", *curves], steps_of)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "consistency.png", dpi=110)
    print(f"picture and tables in {out}")
    return {f"{row[0]}, {row[1]}": float(row[3]) for row in rows}


if __name__ == "__main__":
    tyro.cli(main)
