"""A loop of one camera in a room of points: how soon its error is that of the batch once old landmarks are seen again.

Known association, ten images a second, 18 m, four points known at the start. A filter knows only the past, so it is compared
with the batch adjustment of all measurements so far, whose last pose is the best estimate at that time, and with that of the
whole recording. The filter's map is in sub-maps, and in one Gaussian. Errors are means over every second frame.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.parallel import in_parallel
from examples.studies.point_worlds import MONO, Measuring, RoomWorld, simulate_features
from rbpf.errors import InputError
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
    """The first frame, after half a lap, that observes three landmarks of the first two seconds.

    Raises InputError: there is none, with four seconds after it.
    """
    first = np.unique(np.concatenate([frame.landmarks for frame in log.frames[: 2 * RATE_HZ]]))
    for t in range(int(0.5 * FRAMES_PER_LAP), len(log.frames) - 4 * RATE_HZ + 1):
        if np.isin(log.frames[t].landmarks, first).sum() >= 3:
            return t
    raise InputError("the camera does not see three of its first landmarks again: take more points or measurements")


def errors_in(job: Job) -> np.ndarray:
    """Mean position error [m] and NEES per degree of freedom (paths, 2 * spans); NaN for a map that diverged.

    The batch has no NEES.
    """
    world = RoomWorld(frames=round(LAPS * FRAMES_PER_LAP), laps=LAPS, points=job.points)
    log = simulate_features(world, Measuring(measurements=job.measurements), MONO, job.seed)
    truth, stamps = log.truth.poses, log.truth.stamps_ns
    returns = frame_of_return(log)
    error, nees = (np.full((len(PATHS), len(truth)), np.nan) for _ in range(2))

    def adjusted(frames: int) -> np.ndarray:
        """Errors (T,) of the batch adjustment of the first frames, begun at the truth."""
        past = replace(log.truth, poses=truth[:frames], stamps_ns=stamps[:frames])
        measured = replace(log, frames=log.frames[:frames], truth=past)
        optimum = solve_features(measured, InitialEstimate(past.poses, {}), marginals=False)
        return np.linalg.norm(optimum.world_from_body[:, 4:] - past.poses[:, 4:], axis=1)

    for path, submap in enumerate([job.submap, job.points]):
        with suppress(InputError):
            done = filter_features(log, MonoConfig(submap=submap, seed=job.seed)).log
            error[path] = np.linalg.norm(done.poses[:, 4:] - truth[:, 4:], axis=1)
            nees[path] = whitened_errors(SE3, done.poses, done.covs, truth).nees / 6.0
    for t in range(returns - RATE_HZ, returns + 4 * RATE_HZ, job.every):
        error[PATHS.index("batch so far"), t] = adjusted(t + 1)[-1]
    error[PATHS.index("batch")] = adjusted(len(truth))
    spans = [
        slice(returns + int(RATE_HZ * start), returns + int(RATE_HZ * end), job.every) for start, end in SPANS.values()
    ]
    return np.stack([each[:, span].mean(axis=1) for span in spans for each in (error, nees)], axis=1)


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
    found = np.array(list(in_parallel(errors_in, jobs, workers)))
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
    in_second = dict(zip(PATHS, mean[:, 2 * list(SPANS).index("1 to 2 s")].tolist(), strict=True))
    print(
        ", ".join(f"{path} {metres:.3f} m" for path, metres in in_second.items()), "one to two seconds after the return"
    )
    return in_second


if __name__ == "__main__":
    tyro.cli(main)
