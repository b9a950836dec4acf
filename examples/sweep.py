"""A sweep over numbers of particles and of linearisations, in parallel, into one table.

The same as `rbpf sweep CONFIG.yaml`: particles × seeds × sequences × options. Finished runs are stored in `rows.jsonl`,
so that an interrupted sweep continues from them. The plot shows the path's error by number of particles, for all seeds
and their median.
"""

from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.runs.files import write_table
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from rbpf.validation.sweep import SweepFile, plan, sweep

OPTIONS = {
    "bootstrap": {"proposal.kind": "prior"},
    "refined once": {"proposal.iterations": 1},
    "refined three times": {"proposal.iterations": 3},
}


def main(
    seeds: int = 10,
    steps: int = 150,
    particles: tuple[int, ...] = (10, 30, 100, 300),
    workers: int = 2,
    scheduler: str | None = None,
    out: Path = Path("demo/sweep"),
    quick: bool = False,
) -> dict[str, float]:
    """Runs the sweep and prints the medians.

    Args:
        seeds: number of seeds of the filter.
        steps: number of steps of the recording.
        particles: numbers of particles.
        workers: number of processes.
        scheduler: address of a Dask scheduler whose workers run instead.
        out: folder for recording, table and plot.
        quick: few seeds, steps and particles, in this process.
    """
    if quick:
        seeds, steps, particles, workers = 2, 30, (10, 40), 1
    simulate_robot(RobotWorld(steps=steps), out / "log", seed=0)
    asked = SweepFile("range-bearing", ["log"], list(particles), seeds, OPTIONS)
    rows = sweep(plan(asked, out), out, workers, scheduler)
    errors = {
        (option, n): [1e3 * row["path_rmse_m"] for row in rows if (row["option"], row["particles"]) == (option, n)]
        for option in OPTIONS
        for n in particles
    }
    table = [[option, *(float(np.median(errors[option, n])) for n in particles)] for option in OPTIONS]
    write_table(out / "medians.csv", ["error of the path [mm]", *map(str, particles)], table)
    draw(errors, particles, out / "sweep.png")
    print(f"{len(rows)} runs in {out / 'table.csv'}")
    return {f"{option}, {n}": float(np.median(found)) for (option, n), found in errors.items()}


def draw(errors: dict[tuple[str, int], list[float]], particles: tuple[int, ...], path: Path) -> None:
    """Plots the error by number of particles and option."""
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes = figure.subplots()
    for option in OPTIONS:
        (line,) = axes.plot(particles, [np.median(errors[option, n]) for n in particles], label=option)
        for n in particles:
            axes.plot([n] * len(errors[option, n]), errors[option, n], ".", color=line.get_color(), alpha=0.4)
    axes.set(xscale="log", yscale="log", xlabel="particles", ylabel="error of the path [mm]")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
