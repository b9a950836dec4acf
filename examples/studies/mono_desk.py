"""A hand-held camera over a desk (E06, section 6): accuracy and consistency of the filter.

Ten simulated recordings, 1 px noise, 25 measurements per frame, four known points. Each is filtered with 50 and 250
particles with per-particle maps and with 50 on a joint map, and adjusted in batch from the same measurements. The table has
position errors without alignment; the batch uses the whole recording for every frame, the filter only the past. The upper
plot has the normalised estimation error squared (NEES) of the pose, averaged over the recordings: 6 is the expected value
for 6 degrees of freedom, and a consistent filter is in the band in 95 % of the frames. Above it a filter is overconfident.
"""

from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from examples.studies.parallel import in_parallel
from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.core.diagnostics import Band, chi_square_band, chi_square_quantile
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.recordings import filter_features as run
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.gtsam.camera import solve_features

SETTINGS = {
    "50 particles": MonoConfig(particles=50, map="particles"),
    "250 particles": MonoConfig(particles=250, map="particles"),
    "joint map, 50 particles": MonoConfig(particles=50),
}


class Job(NamedTuple):
    """One recording."""

    seed: int
    frames: int
    settings: list[MonoConfig]


def solve_and_filter(job: Job) -> tuple[float, list[tuple[float, np.ndarray]]]:
    """Error of the batch [m], and errors and NEES (T,) of the filters."""
    log = simulate_features(DeskWorld(frames=job.frames), Measuring(), MONO, job.seed)
    truth = log.truth.poses
    batch = solve_features(log, InitialEstimate(truth, {}), marginals=False).world_from_body

    def rmse(path: np.ndarray) -> float:
        return float(np.sqrt(np.square(path[:, 4:] - truth[:, 4:]).sum(axis=1).mean()))

    errors = []
    for config in job.settings:
        done = run(log, replace(config, seed=job.seed))
        nees = whitened_errors(SE3, done.log.poses, done.log.covs, truth).nees
        errors.append((rmse(done.log.poses), nees))
    return rmse(batch), errors


def draw(names: list[str], mm: np.ndarray, nees: np.ndarray, band: Band, path: Path) -> None:
    """Plots NEES (C, T) over time, and errors (S, 1 + C) of the batch and the filters."""
    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    upper, lower = figure.subplots(2, 1)
    upper.axhspan(band.low, band.high, color="tab:green", alpha=0.2, label="95 % band of an honest filter")
    upper.axhline(band.expected, color="tab:green", lw=0.8)
    for name, curve in zip(names, nees, strict=True):
        upper.plot(curve, lw=0.9, label=name)
    upper.set(title=f"NEES of the pose, mean of {len(mm)} recordings", xlabel="frame", ylabel="NEES", yscale="log")
    ticks = [2, 4, 6, 10, 20, 50]
    upper.set_yticks(ticks, [f"{tick}" for tick in ticks])
    upper.yaxis.set_minor_formatter(NullFormatter())
    upper.legend(fontsize="small", ncols=2)
    seeds = np.arange(len(mm))
    lower.bar(seeds, mm[:, 0], width=0.7, color="0.85", label="batch adjustment")
    for place, name in enumerate(names):
        lower.plot(seeds + 0.2 * (place - 1), mm[:, 1 + place], "o", ms=5, label=name)
    lower.set(title="Error of the position without alignment", xlabel="recording", ylabel="RMS [mm]", xticks=seeds)
    lower.legend(fontsize="small")
    figure.savefig(path, dpi=110)


def main(
    seeds: int = 10, workers: int = 2, out: Path = Path("demo/mono_desk"), quick: bool = False
) -> dict[str, float]:
    """Simulates, filters and adjusts in batch; prints the table.

    Args:
        seeds: number of recordings.
        workers: processes.
        out: folder for picture and tables.
        quick: two short recordings and few particles.
    """
    frames = 60 if quick else 1000
    seeds, workers = (2, 1) if quick else (seeds, workers)
    settings = [replace(config, particles=30) if quick else config for config in SETTINGS.values()]
    jobs = map(Job, range(seeds), repeat(frames), repeat(settings))
    batch, errors = zip(*in_parallel(solve_and_filter, jobs, workers), strict=True)

    names = list(SETTINGS)
    mm = 1e3 * np.array([[b, *(error for error, _ in of_seed)] for b, of_seed in zip(batch, errors, strict=True)])
    nees = np.array([[nees for _, nees in of_seed] for of_seed in errors])
    band = chi_square_band(6, seeds)
    ratio, of_recording = mm[:, 1:].mean(axis=0) / mm[:, 0].mean(), nees.mean(axis=2) / 6.0
    inside = 100.0 * (nees <= chi_square_quantile(0.95, 6)).mean(axis=(0, 2))

    header = ["recording", "batch [mm]", *(f"{name} [mm]" for name in names), *(f"{name}, NEES / 6" for name in names)]
    table = np.concatenate([mm, of_recording], axis=1)
    rows = [[seed, *table[seed].tolist()] for seed in range(seeds)]
    write_table(out / "errors.csv", header, [*rows, ["mean", *table.mean(axis=0).tolist()]])
    for name, times, of_name, fraction in zip(names, ratio, of_recording.T, inside, strict=True):
        worst = f"{of_name.mean():.2f} (worst {of_name.max():.2f})"
        print(f"{name}: {times:.2f} times the batch's error, NEES / 6 {worst}, {fraction:.0f} % in the 95 % region")
    mean = nees.mean(axis=0)
    write_table(out / "nees.csv", ["frame", *names], [[t, *mean[:, t].tolist()] for t in range(frames)], shown=False)
    draw(names, mm, mean, band, out / "mono_desk.png")
    print(f"picture and tables in {out}")
    return {
        "ratio": float(ratio[1]),
        "ratio_joint": float(ratio[2]),
        "nees": float(of_recording[:, 1].mean()),
        "nees_joint": float(of_recording[:, 2].mean()),
    }


if __name__ == "__main__":
    tyro.cli(main)
