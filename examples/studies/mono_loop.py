"""A loop of one camera in a room of points: how soon its error is that of the batch once old landmarks are seen again.

Known association, 25 measurements a frame, ten images a second, 18 m. A filter knows only the past, so it is compared with the
batch adjustment of all measurements so far, whose last pose is the best estimate at that time, and with that of the whole
recording. The filter's map is in sub-maps, and in one Gaussian.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.parallel import in_parallel
from examples.studies.point_worlds import MONO, Measuring, RoomWorld, simulate_features
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.recordings import filter_features
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.gtsam.camera import solve_features

RATE_HZ, FRAMES_PER_LAP, LAPS = 10, 307.7, 1.105
SPANS = {"before": (-1.0, 0.0), "0 to 1 s": (0.0, 1.0), "1 to 2 s": (1.0, 2.0), "2 to 4 s": (2.0, 4.0)}
PATHS = "sub-maps", "one Gaussian", "batch so far", "batch"


@dataclass(frozen=True)
class Job:
    """A world, how much of it is measured, the size of a sub-map, and which frames count: one in so many."""

    seed: int
    points: int
    measurements: int
    submap: int
    every: int


def frame_of_return(log: FeatureLog) -> int:
    """The first frame, after half a lap, that observes three landmarks of the first two seconds."""
    first = np.unique(np.concatenate([frame.landmarks for frame in log.frames[: 2 * RATE_HZ]]))
    late = range(int(0.5 * FRAMES_PER_LAP), len(log.frames))
    return next(t for t in late if np.isin(log.frames[t].landmarks, first).sum() >= 3)


def walk(job: Job) -> np.ndarray:
    """Mean position error [m] and NEES per degree of freedom (paths, 2 * spans); of the batch there is no NEES."""
    world = RoomWorld(frames=round(LAPS * FRAMES_PER_LAP), laps=LAPS, points=job.points)
    log = simulate_features(world, Measuring(measurements=job.measurements), MONO, job.seed)
    truth, stamps = log.truth.poses, log.truth.stamps_ns
    back, found = frame_of_return(log), np.full((len(PATHS), 2, len(truth)), np.nan)

    def off(path: np.ndarray, frames: int) -> np.ndarray:
        return np.linalg.norm(path[:, 4:] - truth[:frames, 4:], axis=1)

    def adjusted(frames: int) -> np.ndarray:
        """Errors (T,) of the batch adjustment of the first frames, begun at the truth."""
        so_far = replace(log.truth, poses=truth[:frames], stamps_ns=stamps[:frames])
        so_far = replace(log, frames=log.frames[:frames], truth=so_far)
        optimum = solve_features(so_far, InitialEstimate(truth[:frames], {}), marginals=False)
        return off(optimum.world_from_body, frames)

    for row, submap in enumerate([job.submap, job.points]):
        done = filter_features(log, MonoConfig(submap=submap, seed=job.seed)).log
        found[row] = off(done.poses, len(truth)), whitened_errors(SE3, done.poses, done.covs, truth).nees / 6.0
    for t in range(back - RATE_HZ, back + 4 * RATE_HZ, job.every):
        found[2, 0, t] = adjusted(t + 1)[-1]
    found[3, 0] = adjusted(len(truth))
    spans = [slice(back + int(RATE_HZ * a), back + int(RATE_HZ * b), job.every) for a, b in SPANS.values()]
    return np.concatenate([found[:, :, span].mean(axis=2) for span in spans], axis=1)


def main(
    seeds: int = 8,
    points: int = 400,
    measurements: int = 25,
    submap: int = 80,
    workers: int = 2,
    out: Path = Path("demo/mono_loop"),
    quick: bool = False,
) -> dict[str, float]:
    """Simulates, filters and adjusts; prints the table.

    Args:
        seeds: number of worlds.
        points: on the walls.
        measurements: in a frame.
        submap: landmarks of a sub-map.
        workers: processes.
        out: folder for the table and the plot.
        quick: one world, and few frames of it.
    """
    seeds, workers, every = (1, 1, 10) if quick else (seeds, workers, 2)
    jobs = [Job(seed, points, measurements, submap, every) for seed in range(seeds)]
    found = np.array(list(in_parallel(walk, jobs, workers)))
    mean = found.mean(axis=0)
    header = ["seed", "path", *(f"{span}{of}" for span in SPANS for of in (" [m]", ", NEES / 6"))]
    of_seeds = [(str(seed), of_paths) for seed, of_paths in enumerate(found)]
    rows = [
        [seed, path, *row.tolist()]
        for seed, of_paths in [*of_seeds, ("mean", mean)]
        for path, row in zip(PATHS, of_paths, strict=True)
    ]
    write_table(out / "loops.csv", header, rows)
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for path, of_path in zip(PATHS, mean, strict=True):
        axes.semilogy(list(SPANS), of_path[::2], "o-", label=path)
    axes.set(ylabel="mean error of the position [m]", title="Time since three old landmarks are seen again")
    axes.legend()
    figure.savefig(out / "mono_loop.png", dpi=110)
    second = dict(zip(PATHS, mean[:, 2 * list(SPANS).index("1 to 2 s")].tolist(), strict=True))
    print(", ".join(f"{path} {metres:.3f} m" for path, metres in second.items()), "one to two seconds after the return")
    return second


if __name__ == "__main__":
    tyro.cli(main)
