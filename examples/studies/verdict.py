"""Validation of the verdict: runs with known faults, assessed without and with ground truth.

A robot drives among landmarks. In eight runs the filter's model has one fault: sensor or odometry noise too large or too
small, a bias of the odometry of one standard deviation, a fifth of the observations with wrong association, or a wrong
sign of the measured angle's derivative with respect to the landmark. Two runs have no fault, and in two the only fault is
that few particles with per-particle maps drive loops, so that they share one past; with a joint map the same loops are
right. The last one is a camera without known points, whose scale is arbitrary. A run without ground truth is assessed by
its innovations and by the batch posterior of its measurements. The verdicts are shown with the facts: the fraction of
poses in the 95 % region, and the ratio of actual to claimed errors of poses and landmarks; those of the camera in the
world of its first pose, which is exact in a simulation.

`--worlds N` shows how often the verdict is wrong: joint maps in N worlds for each of `FAULTS`, assessed without the truth,
with it, and by a truth alone with stated errors three times those of the filter. A fault's runs are right if their errors,
in the mean over the worlds, are as claimed within `STATE_FACTOR`.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal
from unittest import mock

import numpy as np
import tyro
from scipy.signal import lfilter

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.core.models import Jacobians
from rbpf.lie import SE2, SE3
from rbpf.runs.files import write_table
from rbpf.runs.folder import write_run, write_trajectory
from rbpf.runs.plots import new_axes, save_figures
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import filter_features, filter_opened, open_robot_log
from rbpf.runs.run import Run
from rbpf.runs.truth import Precision, RunTruth, write_truth
from rbpf.sensors.range_bearing import RangeBearing
from rbpf.sensors.readers import Frame, RobotLog
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.against_batch import compare_with_batch
from rbpf.validation.consistency.against_groundtruth import LANDMARKS, NEES, compare_with_truth, truth_errors
from rbpf.validation.consistency.comparison import Verdict, compare_with_itself, verdict_of
from rbpf.validation.consistency.statistic import STATE_FACTOR
from rbpf.validation.simulation.robot import RobotWorld, simulated_log


def scale_sensor_noise(log: RobotLog, factor: float) -> RobotLog:
    """Claims standard deviations of all observations that are `factor` times the right ones."""
    return _changed(log, lambda frame: replace(frame, cov_z=factor**2 * frame.cov_z))


def scale_odometry_noise(log: RobotLog, factor: float) -> RobotLog:
    """Claims standard deviations of all motions that are `factor` times the right ones."""

    def change(frame: Frame) -> Frame:
        return frame if frame.cov_delta is None else replace(frame, cov_delta=factor**2 * frame.cov_delta)

    return _changed(log, change)


def bias_odometry(log: RobotLog, sigmas: float) -> RobotLog:
    """Adds a constant forward bias to each step's odometry, in standard deviations."""
    forward = 1 if log.space.dim == SE2.dim else 3

    def change(frame: Frame) -> Frame:
        if frame.delta is None or frame.cov_delta is None:
            return frame
        shift = np.zeros(log.space.dim)
        shift[forward] = sigmas * np.sqrt(frame.cov_delta[forward, forward])
        return replace(frame, delta=log.space.retract(frame.delta, shift))

    return _changed(log, change)


def swap_names(log: RobotLog, fraction: float, rng: np.random.Generator) -> RobotLog:
    """Gives a fraction of the observations the name of another landmark, one not observed in the same step."""
    every = np.unique(np.concatenate([frame.landmarks for frame in log.frames]))

    def change(frame: Frame) -> Frame:
        names = frame.landmarks.copy()
        for k in np.flatnonzero(rng.random(names.size) < fraction):
            names[k] = rng.choice(np.setdiff1d(every, names))
        return replace(frame, landmarks=names)

    return _changed(log, change)


def repeat_errors(log: RobotLog, factor: float) -> RobotLog:
    """Adds an error as large as the noise to every observation, correlated (0.95) between observations of a landmark.

    Claims `factor` times the standard deviations of both together.
    """
    rng, last = np.random.default_rng(len(log.frames)), dict[int, np.ndarray]()

    def change(frame: Frame) -> Frame:
        z = frame.z.copy()
        for row, name in enumerate(frame.landmarks.tolist()):
            fresh = rng.normal(size=z.shape[1])
            last[name] = 0.95 * last[name] + np.sqrt(1.0 - 0.95**2) * fresh if name in last else fresh
            z[row] += np.linalg.cholesky(frame.cov_z[row]) @ last[name]
        return replace(frame, z=z, cov_z=2.0 * factor**2 * frame.cov_z)

    return _changed(log, change)


def _changed(log: RobotLog, change: Callable[[Frame], Frame]) -> RobotLog:
    return replace(log, frames=[change(frame) for frame in log.frames])


@contextmanager
def wrong_derivative() -> Iterator[None]:
    """The measured angle's derivative with respect to the landmark has the wrong sign."""
    right = RangeBearing.jacobians

    def wrong(self: RangeBearing, *args: np.ndarray, **named: np.ndarray) -> Jacobians:
        jacobians = right(self, *args, **named)
        landmark = jacobians.landmark.copy()
        landmark[..., 1:, :] *= -1.0
        return jacobians._replace(landmark=landmark)

    with mock.patch.object(RangeBearing, "jacobians", wrong):
        yield


Fault = Callable[[RobotLog], RobotLog]

LAP, SHORT = RobotWorld(steps=120, landmarks=80), RobotWorld(steps=60, landmarks=80, laps=1.0)
RATED = RobotWorld(steps=80, landmarks=40, laps=1.5)
LOOPS = RobotWorld(steps=300, landmarks=150, radius_m=15.0, extent_m=22.0)


@dataclass(frozen=True)
class Case:
    """A run with a known fault.

    Attributes:
        name: of the fault.
        run: performs the run.
        wrong: whether there is a fault.
    """

    name: str
    run: Callable[[], Run]
    wrong: bool = True


def robot(
    fault: Fault = lambda log: log,
    particles: int = 500,
    world: RobotWorld = LAP,
    seed: int = 0,
    derivative: bool = False,
    joint: bool = False,
) -> Callable[[], Run]:
    """A robot's run."""
    kept: Literal["joint", "particles"] = "joint" if joint else "particles"
    config = RangeBearingConfig(particles=particles, seed=seed, compiled=not derivative, map=kept)

    def run() -> Run:
        with wrong_derivative() if derivative else nullcontext():
            return filter_opened(open_robot_log(fault(simulated_log(world, seed)), config))

    return run


def camera_without_known_points() -> Run:
    """A run of a hand-held camera over a desk, without known points."""
    log = simulate_features(DeskWorld(frames=120), Measuring(), MONO, 0)
    return filter_features(replace(log, known=None), MonoConfig(particles=100, map="particles"))


CASES = (
    Case("sensor noise × 3", robot(lambda log: scale_sensor_noise(log, 3.0))),
    Case("sensor noise × 2", robot(lambda log: scale_sensor_noise(log, 2.0))),
    Case("sensor noise ÷ 3", robot(lambda log: scale_sensor_noise(log, 1.0 / 3.0))),
    Case("odometry noise × 3", robot(lambda log: scale_odometry_noise(log, 3.0))),
    Case("odometry noise ÷ 3", robot(lambda log: scale_odometry_noise(log, 1.0 / 3.0))),
    Case("odometer bias of 1 σ", robot(lambda log: bias_odometry(log, 1.0))),
    Case("20 % wrong names", robot(lambda log: swap_names(log, 0.2, np.random.default_rng(0)))),
    Case("wrong derivative", robot(derivative=True, particles=200)),
    Case("nothing", robot(particles=1000, world=SHORT), wrong=False),
    Case("nothing, another world", robot(particles=1000, world=SHORT, seed=1), wrong=False),
    Case("30 particles in loops of 94 m", robot(particles=30, world=LOOPS), wrong=False),
    Case("the same in another world", robot(particles=30, world=LOOPS, seed=1), wrong=False),
    Case("30 particles in loops, joint map", robot(particles=30, world=LOOPS, joint=True), wrong=False),
    Case("the same in another world, joint map", robot(particles=30, world=LOOPS, seed=1, joint=True), wrong=False),
    Case("camera without known points", camera_without_known_points, wrong=False),
)


def judged(run: Run, folder: Path) -> tuple[Verdict, Verdict, dict[str, float]]:
    """Verdicts on a run without and with ground truth, and its actual errors."""
    write_run(run, folder, {"recording": str(folder)})
    record = RunFolder.open(folder)
    own = [compare_with_batch(record)[0], compare_with_itself(record)]
    beside = compare_with_truth(record, truth_errors(record))
    verdicts = verdict_of(record, own), verdict_of(record, [beside, *own])
    if record.truth.alignment != "none":
        write_truth(folder, from_first_pose(record))
        beside = compare_with_truth(record, truth_errors(RunFolder.open(folder)))
    return *verdicts, {statistic.name: statistic.value for statistic in beside.statistics}


def from_first_pose(record: RunFolder) -> RunTruth:
    """Exact ground truth in the world of the run's first pose, and in the run's scale."""
    truth, ours = record.truth, record.path.world_from_body[record.truth.rows]
    begin = SE3.compose(ours[0], SE3.inverse(truth.poses[0]))
    poses = SE3.compose(begin, truth.poses)
    out, true = ours[:, 4:] - ours[0, 4:], poses[:, 4:] - ours[0, 4:]
    scale = float((out * true).sum() / np.square(true).sum())
    poses[:, 4:] = ours[0, 4:] + scale * true
    moved = {name: SE3.transform(begin, point) for name, point in truth.landmarks.items()}
    points = {name: ours[0, 4:] + scale * (point - ours[0, 4:]) for name, point in moved.items()}
    return RunTruth(truth.rows, poses, points)


def is_right(case: Case, verdict: Verdict, found: Mapping[str, float]) -> bool:
    """Whether a verdict on a run is right.

    Trust is right if errors of poses and landmarks are as claimed within `STATE_FACTOR`, even if faults cancel. A model's
    fault is sufficient reason for distrust, and errors outside that factor require it. If over- or underconfidence is
    named, it must be that of the errors.

    Args:
        case: the run's case.
        verdict: on the run.
        found: its actual errors.
    """
    ratios = [np.sqrt(found[name]) for name in (NEES, LANDMARKS) if name in found]
    most, inside = max(ratios), 1.0 / STATE_FACTOR <= min(ratios) <= max(ratios) <= STATE_FACTOR
    if verdict.trust == "trust":
        return bool(inside)
    aside = {"over-confident": most > 1.0, "cautious": most < 1.0, "": True}[verdict.leaning]
    return bool(aside and (verdict.trust == "do not trust") == (case.wrong or not inside))


#: Change of a log, and factor on the reported standard deviations of poses.
FAULTS: dict[str, tuple[Fault, float]] = {
    "nothing": (lambda log: log, 1.0),
    **{f"sensor noise × {k:g}": (partial(scale_sensor_noise, factor=k), 1.0) for k in (0.33, 0.5, 2.0, 3.0, 4.0)},
    **{f"odometry noise × {k:g}": (partial(scale_odometry_noise, factor=k), 1.0) for k in (0.33, 3.0)},
    "both × 3": (lambda log: scale_sensor_noise(scale_odometry_noise(log, 3.0), 3.0), 1.0),
    **{f"errors that repeat, × {k:g}": (partial(repeat_errors, factor=k), 1.0) for k in (1.0, 2.0, 3.0)},
    **{f"poses claim × {k:g}": (lambda log: log, k) for k in (0.33, 3.0)},
}


def coarse(truth: RunTruth, cov: np.ndarray, rng: np.random.Generator) -> tuple[RunTruth, Precision]:
    """Ground truth of SE(2) with correlated errors of three times the covariances' (T, 3, 3) size, and its precision."""
    std = 3.0 * np.sqrt(np.diagonal(cov, axis1=1, axis2=2).mean(axis=0))
    own = Precision(float(std[1:].max()), float(std[0]))
    drawn = lfilter([np.sqrt(0.19)], [1.0, -0.9], rng.normal(size=(len(truth.poses) + 100, 3)), axis=0)[100:]
    poses = SE2.retract(truth.poses, drawn * [own.std_rad, own.std_m, own.std_m])
    return RunTruth(truth.rows, poses, {}, truth.alignment), own


def rates(worlds: int) -> list[list[object]]:
    """For each fault the ratio of actual to claimed errors of poses and landmarks, and a letter for each verdict."""
    rows: list[list[object]] = []
    for name, (fault, factor) in FAULTS.items():
        told, squares = [], []
        for seed in range(worlds):
            with TemporaryDirectory() as folder:
                run = robot(fault, 30, RATED, seed, joint=True)()
                write_run(run, Path(folder), {"recording": folder})
                path = RunFolder.open(Path(folder)).path
                write_trajectory(Path(folder), path.stamps_ns, path.world_from_body, factor**2 * path.cov_poses)
                record = RunFolder.open(Path(folder))
                itself, exact = compare_with_itself(record), compare_with_truth(record, truth_errors(record))
                own = [compare_with_batch(record)[0], itself]
                rough, known = coarse(record.truth, path.cov_poses, np.random.default_rng(seed))
                write_truth(Path(folder), rough)
                seen = RunFolder.open(Path(folder))
                beside = compare_with_truth(seen, truth_errors(seen, known))
            ways = own, [exact, *own], [beside, itself]
            said = (verdict_of(record, way) for way in ways)
            told.append(
                ["?" if verdict.trust == "cannot tell" else (verdict.leaning or verdict.trust)[0] for verdict in said]
            )
            squares.append([s.value for s in exact.statistics if s.name in (NEES, LANDMARKS)])
        rows.append(
            [name, *np.sqrt(np.mean(squares, axis=0)).round(2).tolist(), *map("".join, zip(*told, strict=True))]
        )
        print(*rows[-1], flush=True)
    return rows


def main(out: Path = Path("demo/verdict"), quick: bool = False, worlds: int = 0) -> dict[str, bool]:
    """Prints the verdicts, and writes their table and a plot of the errors.

    Args:
        out: folder for the table and the picture.
        quick: only the shortest of the cases.
        worlds: instead of the cases, number of worlds for each fault.
    """
    rows, right = [], {}
    if worlds:
        table = rates(worlds)
        header = ["what is wrong", "poses", "landmarks", "without the truth", "with it", "with a coarse truth alone"]
        write_table(out / "rates.csv", header, table)
        return {}
    for case in CASES[9:10] if quick else CASES:
        with TemporaryDirectory() as folder:
            alone, beside, found = judged(case.run(), Path(folder))
        print(f"{case.name}: {alone.sentences[1]} With the truth: {beside.sentences[1]}")
        told = [f"{verdict.trust} {verdict.leaning}".strip() for verdict in (alone, beside)]
        inside = found.get("poses inside the 95 % region", float("nan"))
        ratios = [float(np.sqrt(found.get(name, float("nan")))) for name in (NEES, LANDMARKS)]
        right[case.name] = all(is_right(case, verdict, found) for verdict in (alone, beside))
        rows.append([case.name, 100.0 * inside, *ratios, *told, "yes" if right[case.name] else "no"])
    header = [
        "what is wrong", "in the 95 % region, %", "poses, × claimed", "landmarks, × claimed", "as a run judges itself",
        "with the truth", "right",
    ]  # fmt: skip
    write_table(out / "verdicts.csv", header, rows)
    figure, axes = new_axes("How many times larger than claimed the errors are", "", "times")
    places = np.arange(len(rows))
    for column, what, marker in ((2, "poses", "o"), (3, "landmarks", "s")):
        axes.plot([row[column] for row in rows], places, marker, label=what)
    axes.axvline(1.0, color="0.6", lw=1.0)
    axes.set_xscale("log")
    axes.set_yticks(places, [f"{row[0]}: {row[4]}" for row in rows])
    axes.legend()
    save_figures({"verdicts.png": figure}, out)
    return right


if __name__ == "__main__":
    tyro.cli(main)
