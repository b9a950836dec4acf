"""Does the verdict notice what is wrong? Deliberate faults in range-bearing SLAM, judged with and without the truth.

A robot drives round among landmarks, several times with other noise. The filter is told the right things, or one thing
wrongly: the noise of its sensor or of its odometry three times too large or too small, an odometer with a bias of one
of its standard deviations, a fifth of the observations under wrong names, or derivatives of the measured angle by the
landmark with the wrong sign. The table counts the verdicts: what can be said from the innovations alone, and what with
the truth beside. Innovations find every one of these faults, but they never earn "trust": particles that agree on a
wrong path explain what they see. With the truth beside, a run of a few hundred steps may be too short to tell.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.core.models import Jacobians
from rbpf.lie import SE2
from rbpf.runs.recordings import filter_robot_log
from rbpf.runs.truth import truth_at
from rbpf.sensors.range_bearing import RangeBearing
from rbpf.sensors.readers import Frame, RobotLog
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.against_groundtruth import pose_statistics
from rbpf.validation.consistency.comparison import innovation_statistics
from rbpf.validation.consistency.statistic import Statistic, whitened_errors
from rbpf.validation.consistency.verdict import Trust, Verdict, judge
from rbpf.validation.simulation.robot import RobotWorld, simulated_log
from rbpf.validation.tables import write_table


def scale_sensor_noise(log: RobotLog, factor: float) -> RobotLog:
    """Claims standard deviations of all observations that are `factor` times the right ones."""
    return _changed(log, lambda frame: replace(frame, cov_z=factor**2 * frame.cov_z))


def scale_odometry_noise(log: RobotLog, factor: float) -> RobotLog:
    """Claims standard deviations of all motions that are `factor` times the right ones."""

    def change(frame: Frame) -> Frame:
        return frame if frame.cov_delta is None else replace(frame, cov_delta=factor**2 * frame.cov_delta)

    return _changed(log, change)


def bias_odometry(log: RobotLog, sigmas: float) -> RobotLog:
    """Adds a constant forward motion of so many of its standard deviations to each step's odometry."""
    forward = 1 if log.space.dim == SE2.dim else 3

    def change(frame: Frame) -> Frame:
        if frame.delta is None or frame.cov_delta is None:
            return frame
        shift = np.zeros(log.space.dim)
        shift[forward] = sigmas * np.sqrt(frame.cov_delta[forward, forward])
        return replace(frame, delta=log.space.retract(frame.delta, shift))

    return _changed(log, change)


def swap_names(log: RobotLog, fraction: float, rng: np.random.Generator) -> RobotLog:
    """Gives a fraction of the observations the name of another landmark, one that is not seen in the same step."""
    every = np.unique(np.concatenate([frame.landmarks for frame in log.frames]))

    def change(frame: Frame) -> Frame:
        names = frame.landmarks.copy()
        for k in np.flatnonzero(rng.random(names.size) < fraction):
            names[k] = rng.choice(np.setdiff1d(every, names))
        return replace(frame, landmarks=names)

    return _changed(log, change)


def _changed(log: RobotLog, change: Callable[[Frame], Frame]) -> RobotLog:
    return replace(log, frames=[change(frame) for frame in log.frames])


RIGHT, JACOBIAN = "nothing", "wrong derivative"
Fault = Callable[[RobotLog, np.random.Generator], RobotLog]
FAULTS: dict[str, Fault] = {
    RIGHT: lambda log, rng: log,
    "sensor noise × 3": lambda log, rng: scale_sensor_noise(log, 3.0),
    "sensor noise ÷ 3": lambda log, rng: scale_sensor_noise(log, 1.0 / 3.0),
    "odometry noise × 3": lambda log, rng: scale_odometry_noise(log, 3.0),
    "odometry noise ÷ 3": lambda log, rng: scale_odometry_noise(log, 1.0 / 3.0),
    "odometer bias of 1 σ": lambda log, rng: bias_odometry(log, 1.0),
    "20 % wrong names": lambda log, rng: swap_names(log, 0.2, rng),
    JACOBIAN: lambda log, rng: log,
}
COLOURS: dict[Trust, str] = {"trust": "tab:green", "cannot tell": "tab:orange", "do not trust": "tab:red"}


@contextmanager
def wrong_derivative() -> Iterator[None]:
    """The measured angle's derivative by the landmark has the wrong sign."""
    right = RangeBearing.jacobians

    def wrong(self: RangeBearing, *args: np.ndarray, **named: np.ndarray) -> Jacobians:
        jacobians = right(self, *args, **named)
        landmark = jacobians.landmark.copy()
        landmark[..., 1:, :] *= -1.0
        return jacobians._replace(landmark=landmark)

    with mock.patch.object(RangeBearing, "jacobians", wrong):
        yield


def judged(log: RobotLog, given: RobotLog, config: RangeBearingConfig) -> tuple[Verdict, Verdict]:
    """Verdicts on a run over `given`, without the truth and with that of `log`."""
    done = filter_robot_log(given, config).log
    own = innovation_statistics(done["nis"], done["nis_dof"], done["correction"], done["cov_correction"])
    truth = truth_at(log.space, log.truth, done.stamps_ns, "first frame")
    errors = whitened_errors(log.space, done.poses, done.covs, truth.poses)
    beside: list[Statistic] = pose_statistics(errors)
    names = [statistic.name for statistic in beside]
    return judge("", own), judge("", [*beside, *own], names)


def main(
    runs: int = 8,
    steps: int = 200,
    particles: int = 500,
    out: Path = Path("demo/verdict"),
    quick: bool = False,
) -> dict[str, float]:
    """Counts the verdicts for every fault.

    Args:
        runs: recordings for each fault.
        steps: of each recording.
        particles: of the filter.
        out: folder for picture and table.
        quick: two recordings and few particles.
    """
    runs, particles = (2, 200) if quick else (runs, particles)
    counts: dict[tuple[str, str], Counter[str]] = {}
    for name, fault in FAULTS.items():
        config = RangeBearingConfig(particles=particles, compiled=name != JACOBIAN)
        for seed in range(runs):
            log = simulated_log(RobotWorld(steps=steps), seed)
            with wrong_derivative() if name == JACOBIAN else nullcontext():
                given = fault(log, np.random.default_rng(seed))
                verdicts = judged(log, given, replace(config, seed=seed))
            for how, verdict in zip(("innovations", "truth"), verdicts, strict=True):
                counts.setdefault((name, how), Counter())[verdict.trust] += 1
                if seed == 0:
                    print(f"{name}, by the {how}: {verdict.sentences[1]}")
    header = ["what is wrong", "judged by", *COLOURS]
    rows = [[name, how, *(count[trust] for trust in COLOURS)] for (name, how), count in counts.items()]
    write_table(out / "verdicts.csv", header, rows)
    draw(counts, runs, out / "verdicts.png")
    return {
        f"{name}, {how}, {trust}": count[trust] / runs
        for (name, how), count in counts.items()
        for trust in COLOURS
    }


def draw(counts: dict[tuple[str, str], Counter[str]], runs: int, path: Path) -> None:
    """Stacked shares of the verdicts."""
    figure = Figure(figsize=(12.0, 4.5), layout="constrained")
    for axes, how in zip(figure.subplots(1, 2, sharey=True), ("innovations", "truth"), strict=True):
        names = [name for name, by in counts if by == how][::-1]
        left = np.zeros(len(names))
        for trust, colour in COLOURS.items():
            fraction = np.array([counts[name, how][trust] / runs for name in names])
            axes.barh(names, fraction, left=left, color=colour, label=trust)
            left += fraction
        axes.set(title=f"judged by the {how}", xlabel=f"fraction of {runs} runs", xlim=(0.0, 1.0))
        axes.legend(fontsize="small", loc="lower right")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
