"""Does a filter run for ever? 100,000 frames of a camera and of a robot, in worlds whose points come and go.

Both keep a fixed lag of their paths and forget landmarks that have not been seen for long. One row per 1,000 frames:
the processor's time for a step, the memory of the process and all that the filter refers to, and how far off it is.
Tables and picture say whether anything grows.
"""

from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.simulation.streams import CameraStream, RobotStream, Turnover
from rbpf.validation.soak import COLUMNS, Window, camera_steps, robot_steps, soak
from rbpf.validation.sweep.parallel import in_parallel
from rbpf.validation.tables import write_csv, write_table

SYSTEMS = "camera", "robot"
SETTLED = 0.1
"""The first fraction of a run fills the map and is not compared."""


@dataclass(frozen=True)
class Job:
    """One run."""

    system: str
    frames: int
    every: int
    particles: int
    lag: int
    out: Path


def run(job: Job) -> list[Window]:
    """Filters one stream; its table grows with it, so that a run that is stopped leaves what it measured."""
    turnover, windows = Turnover(), list[Window]()
    if job.system == "camera":
        camera = CameraStream(turnover, seed=0)
        done = soak(
            camera, *camera_steps(camera, MonoConfig(job.particles, lag=job.lag)), job.frames, job.every
        )
    else:
        robot = RobotStream(turnover, seed=0)
        config = RangeBearingConfig(job.particles, lag=job.lag)
        done = soak(robot, *robot_steps(robot, config), job.frames, job.every)
    for window in done:
        windows.append(window)
        write_csv(job.out / f"{job.system}.csv", COLUMNS, [list(astuple(row)) for row in windows])
    return windows


def growth(values: np.ndarray) -> float:
    """Median of the last third of a run over that of the first third, once it has settled."""
    settled = values[max(1, round(SETTLED * values.size)) :]
    third = max(1, settled.size // 3)
    return float(np.median(settled[-third:]) / np.median(settled[:third]))


def main(
    frames: int = 100_000,
    every: int = 1000,
    particles: int = 20,
    lag: int = 100,
    workers: int = 2,
    out: Path = Path("demo/soak"),
    quick: bool = False,
) -> dict[str, float]:
    """Runs both and prints the table.

    Args:
        frames: of each stream.
        every: frames per row of the tables.
        particles: of both filters.
        lag: steps of the paths that are kept.
        workers: processes.
        out: folder for tables and picture.
        quick: a few frames, in this process.
    """
    if quick:
        frames, every, particles, lag, workers = 360, 60, 5, 20, 1
    jobs = [Job(system, frames, every, particles, lag, out) for system in SYSTEMS]
    columns, figures, rows = {}, {}, []
    for system, windows in zip(SYSTEMS, in_parallel(run, jobs, workers), strict=True):
        columns[system] = dict(
            zip(COLUMNS, np.array([astuple(w) for w in windows], dtype=float).T, strict=True)
        )
        last = windows[-1]
        for name in ("ms_per_frame", "resident_mb", "held_kb", "nodes", "error_m"):
            figures[f"{system}, {name}"] = growth(columns[system][name])
        grown = [
            figures[f"{system}, {name}"] for name in ("ms_per_frame", "resident_mb", "held_kb", "error_m")
        ]
        rows.append([system, last.frames, last.started, last.landmarks, *grown])
    header = ["stream", "frames", "landmarks ever", "at the end"]
    write_table(out / "growth.csv", [*header, "time x", "memory x", "held x", "error x"], rows)
    draw(columns, out / "soak.png")
    print(f"tables and picture in {out}; a growth of 1 is none")
    return figures


def draw(columns: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Time, memory, what is held and the error, by frame."""
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    shown = {
        "ms_per_frame": "median processor time of a step [ms]",
        "resident_mb": "memory of the process [MB]",
        "held_kb": "held by the filter [kB]",
        "error_m": "RMS error [m]",
    }
    for axes, (name, label) in zip(figure.subplots(2, 2).flat, shown.items(), strict=True):
        for system, column in columns.items():
            axes.plot(column["frames"], column[name], lw=1.0, label=system)
        axes.set(xlabel="frame", ylabel=label)
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
