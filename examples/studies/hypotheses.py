"""Unknown data association: which hypotheses are kept, and which one is right in the end?

A robot leaves a hall, passes two similar doors of a corridor, drives a detour without any landmark in view, and returns to
one of the doors, with a position uncertainty of about their distance. The door alone is ambiguous; later landmarks decide.
In addition, worlds in the plane with loops: the fraction of wrong associations, and the consistency.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.consistency_runs import Mean
from examples.studies.joint_map import JOINT, RECORDINGS, loops
from rbpf.lie import SE2
from rbpf.runs.files import write_table
from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import filter_opened, open_robot_log
from rbpf.runs.run import Run
from rbpf.runs.truth import truth_at
from rbpf.sensors.readers import Frame, RobotLog, Truth, open_log
from rbpf.systems.range_bearing.config import AssociationConfig, RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.metrics.scores import score_estimate
from rbpf.validation.simulation.robot import RobotWorld, simulated_log

SPACING = 4.0
"""Between the two doors, metres."""
HALL = np.array([[-1.6, 1.2], [-0.9, -1.0], [0.2, 1.5], [0.8, -1.3], [1.9, 0.4]])
DOORS = np.array([[8.0, 1.0], [8.9, 1.0], [8.0 + SPACING, 1.0], [8.9 + SPACING, 1.0]])
FAR_END, NOISE, RANGE = 21.0, 0.03, 1.8


def corridor(seed: int) -> RobotLog:
    """The robot's log, with the true names; landmarks 5 and 6 are the posts of one door, 7 and 8 those of the other."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([HALL, DOORS])
    places = np.concatenate([np.arange(0.0, FAR_END, 0.5), np.arange(FAR_END, -0.1, -0.5)])
    frames, path = list[Frame](), list[np.ndarray]()
    for t, place in enumerate(places.tolist()):
        # Beyond the doors the wheels slip along the corridor.
        std = np.array([1e-3, 0.8 if t and min(place, places[t - 1]) > 15.0 else 0.02, 0.01])
        pose, cov = np.array([0.0, place, 0.0]), np.diag(std**2)
        delta = None if not t else SE2.retract(SE2.between(path[-1], pose), std * rng.normal(size=3))
        seen = np.flatnonzero(np.linalg.norm(points - pose[1:], axis=1) < RANGE)
        z = points[seen] - pose[1:] + NOISE * rng.normal(size=(seen.size, 2))
        covs = np.repeat(NOISE**2 * np.eye(2)[None], seen.size, axis=0)
        frames.append(Frame(t, delta, None if delta is None else cov, seen, z, covs))
        path.append(pose)
    truth = Truth(np.arange(len(path)), np.array(path), dict(enumerate(points)))
    return RobotLog("corridor", SE2, "position", SE2.identity(), frames, truth=truth)


@dataclass(frozen=True)
class Return:
    """Result of a run in the corridor."""

    error_m: float  #: error of the last pose.
    kept: float  #: fraction of the ambiguous steps in which the right hypothesis was kept.
    rivals: float  #: fraction of them in which a wrong one was kept, too.
    left: int  #: number of hypotheses at the end.


def come_back(seed: int, hypotheses: int = 4) -> Return:
    """Filters a seed's log without names, with a maximum number of hypotheses."""
    log = corridor(seed)
    config = RangeBearingConfig(
        particles=20, seed=seed, association="ml", map="joint", unknown=AssociationConfig(hypotheses=hypotheses)
    )
    slam, truth = RangeBearingSlam.of_log(log, config), log.truth
    assert truth is not None and slam.hypotheses is not None
    there = int(np.argmax(truth.poses[:, 1]))
    right, wrong, error, met = list[bool](), list[bool](), 0.0, False
    for t, (frame, pose) in enumerate(zip(log.frames, truth.poses, strict=True)):
        tracked = slam.take(frame)
        error = float(np.linalg.norm(tracked.pose[1:] - pose[1:]))
        met |= t > there and {7, 8} <= set(frame.landmarks.tolist())
        if met and pose[1] > 8.9 + 0.95 * RANGE:
            off = [abs(each.map.estimate(each.filter.particles).mean[1] - pose[1]) for each in slam.hypotheses.held]
            right.append(min(off) < 0.4 * SPACING)
            wrong.append(max(off) > 0.6 * SPACING)
    return Return(error, float(np.mean(right)), float(np.mean(wrong)), len(slam.hypotheses.held))


def wrong_share(run: Run, log: RobotLog) -> float:
    """Fraction of wrong associations: with another landmark, as new although known, or as clutter."""
    system = run.system
    assert isinstance(system, RangeBearingSlam) and system.hypotheses is not None
    name_of, known, wrong, count = dict[int, int](), set[int](), 0, 0
    for frame, chosen in zip(log.frames, system.hypotheses.held[0].chosen, strict=True):
        for name, landmark in zip(frame.landmarks.tolist(), chosen.tolist(), strict=True):
            count += 1
            if landmark >= 0 and landmark not in name_of:
                wrong += name in known
                name_of[landmark] = name
                known.add(name)
            else:
                wrong += landmark < 0 or name_of[landmark] != name
    return wrong / count


UNKNOWN = replace(JOINT, association="ml")
FILTERS = {
    "named, joint": JOINT,
    "joint": UNKNOWN,
    "joint, one hypothesis": replace(UNKNOWN, unknown=AssociationConfig(hypotheses=1)),
}


def in_world(world: RobotWorld, runs: int) -> list[list[str | int | float]]:
    """A row per filter: means over logs of seeds 0, 1, …, which are also the filter's."""
    rows = list[list[str | int | float]]()
    for name, config in FILTERS.items():
        found = []
        for seed in range(runs):
            log = simulated_log(world, seed)
            run = filter_opened(open_robot_log(log, replace(config, seed=seed)))
            assert log.truth is not None
            truth = truth_at(log.space, log.truth, run.log.stamps_ns, "first frame")
            assert truth is not None
            errors = whitened_errors(log.space, run.log.poses, run.log.covs, truth.poses)
            nees = errors.nees[errors.ranks > 0] / log.space.dim
            shift = log.space.translation(run.log.poses) - log.space.translation(truth.poses)
            wrong = 0.0 if config.association == "known" else 100.0 * wrong_share(run, log)
            path = float(np.sqrt(np.square(shift).sum(axis=1).mean()))
            found.append((float(nees.mean()), path, wrong, 1e3 * float(np.median(run.log["seconds"]))))
        means = [Mean.of(column) for column in zip(*found, strict=True)]
        rows.append([name, runs, means[0].value, means[0].error, means[1].value, means[2].value, means[3].value])
    return rows


def recorded(folder: Path, recordings: Sequence[str], seeds: int) -> list[list[str | int | float]]:
    """A row per recording and filter: mean and spread of the path's error over the seeds, metres."""
    rows = list[list[str | int | float]]()
    for recording in recordings:
        log = open_log(folder / recording)
        for name, config in FILTERS.items():
            found = []
            for seed in range(seeds):
                run = filter_opened(open_robot_log(log, replace(config, seed=seed)))
                scores = score_estimate(PathAndMap.of_run(run), run.truth, config.association == "ml")
                path = scores["ate_rmse_m" if "mrclam" in recording else "path_rmse_m"]
                landmarks = run.system.map().ids.size
                found.append((path, landmarks, 1e3 * float(np.median(run.log["seconds"]))))
            paths, landmarks, speed = np.array(found).T
            rows.append([recording, name, seeds, paths.mean(), np.ptp(paths), landmarks.mean(), speed.min()])
    return rows


def main(
    returns: int = 12,
    runs: int = 5,
    steps: int = 400,
    recordings: Path | None = None,
    seeds: int = 3,
    out: Path = Path("demo/hypotheses"),
    quick: bool = False,
) -> dict[str, float]:
    """Prints the tables, with the fraction of right returns as the result, if there are any.

    Args:
        returns: number of runs in the corridor, with seeds 0, 1, ….
        runs: number of worlds in the plane, with seeds 0, 1, ….
        steps: of each.
        recordings: folder of the recorded logs; None skips them.
        seeds: number of seeds of the filter on each recording, 0, 1, ….
        out: folder for the tables.
        quick: few and short runs.
    """
    if quick:
        returns, runs, steps = 2, 1, 30
    out.mkdir(parents=True, exist_ok=True)
    rows, results = list[list[str | int | float]](), dict[str, float]()
    if returns:
        figure = Figure(figsize=(7.0, 3.0), layout="constrained")
        axes = figure.subplots()
        for most in (4, 1):
            found = [come_back(seed, most) for seed in range(returns)]
            good = float(np.mean([each.error_m < 0.5 for each in found]))
            kept, worst = min(each.kept for each in found), max(each.error_m for each in found)
            rows.append([most, returns, 100.0 * good, 100.0 * kept, worst])
            results[f"{most} hypotheses"] = good
            axes.plot([each.error_m for each in found], "o", label=f"{most} hypotheses")
        axes.set(xlabel="seed", ylabel="error at the end [m]")
        axes.legend()
        figure.savefig(out / "corridor.png", dpi=110)
        header = ["hypotheses", "runs", "end right [%]", "right one held [%]", "largest error [m]"]
        write_table(out / "corridor.csv", header, rows)
    if runs:
        header = ["filter", "runs", "NEES / d", "± s.e.", "path [m]", "wrong [%]", "ms per step"]
        write_table(out / "worlds.csv", header, in_world(loops(steps), runs))
    if recordings is not None:
        header = ["recording", "filter", "seeds", "path [m]", "range", "landmarks", "ms per step"]
        write_table(out / "recordings.csv", header, recorded(recordings, RECORDINGS, seeds))
    return results


if __name__ == "__main__":
    tyro.cli(main)
