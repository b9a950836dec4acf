"""Causes of a filter's excess error over the batch optimum of its measurements: one change at a time.

`--recording` is a robot's log, `--run` the folder of a finished monocular run; without either a log is simulated. The
filter runs again on the same measurements: with more particles, another linearisation, other weights; for a camera also
without outliers of the batch, with landmarks initialised at the batch's depths, with other stated noise, and with the
focal length and k1 of the batch. The batch is initialised by the filter and by its own start, and, for a robot, is also
solved with only the measurements up to each instant. A change that reduces the error to the batch's reveals the cause.

The table has one row per change: its position error, and the ratio to the batch's; the plot shows the errors. A run
without ground truth is compared with the batch optimum.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.core.models import Belief, NewLandmarks, Observations, Sensor
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.measurement_files import read_feature_log
from rbpf.runs.plots import COLOURS, new_axes, save_figures
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import LogSource, Opened, filter_opened, open_robot_log
from rbpf.runs.trajectory import Alignment, Trajectory, in_space
from rbpf.runs.truth import truth_at
from rbpf.sensors.camera.points import CameraRay
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.sensors.readers import open_log
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.systems.filtering import ProposalConfig
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.settings import load_settings
from rbpf.validation.gtsam import robot
from rbpf.validation.gtsam.batch_problem import AFAR, Optimum, solve_problem
from rbpf.validation.gtsam.observations import HUBER
from rbpf.validation.gtsam.self_calibration import adjust_near, refine_calibration
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

AS_IT_IS, BATCH, FROM_FILTER = "as it is", "batch", "batch started from the filter"
ONLINE = "batch of what was measured until then"
HEADER = ("changed", "error_m", "least_m", "most_m", "ratio")

MANY = 10
"""Factor on the number of particles."""

WRONG_PX = 3.0
"""Reprojection error in the batch beyond which a match is an outlier."""

DEPTH_FRACTION = 0.01
"""Relative standard deviation of given depths."""


@final
@dataclass(frozen=True)
class Cause:
    """Error with one change.

    Attributes:
        name: of the change.
        errors_m: root mean square position error of each seed.
        batch_m: of the batch optimum.
    """

    name: str
    errors_m: tuple[float, ...]
    batch_m: float

    def row(self) -> tuple[str, float, float, float, float]:
        """For a table with `HEADER`: the median over the seeds, the range, and the median's ratio to the batch."""
        middle = float(np.median(self.errors_m))
        ratio = middle / self.batch_m if self.batch_m else float("nan")
        return self.name, middle, min(self.errors_m), max(self.errors_m), ratio


def robot_causes(
    recording: Path,
    config: RangeBearingConfig,
    seeds: Sequence[int],
    on_change: Callable[[str], None] = lambda name: None,
) -> list[Cause]:
    """Causes for a robot's log with known association.

    Raises:
        InputError: the recording is wrong, or has no ground truth.
    """
    log = open_log(recording, config.noise)
    stamps_ns = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    truth = None if log.truth is None else truth_at(log.space, log.truth, stamps_ns, "first frame")
    if truth is None:
        raise InputError(f"{recording} has no ground truth to measure errors by")
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)

    def error(poses: np.ndarray) -> float:
        ours, true = (in_space(stamps[truth.rows], poses[truth.rows]), in_space(stamps[truth.rows], truth.poses))
        return ate(ours, true, "rigid").rmse

    runs = [filter_opened(open_robot_log(log, replace(config, seed=seed))) for seed in seeds]
    measured = runs[0].system.measurements(log.name, runs[0].log)
    batch = robot.solve(measured, marginals=False, incremental=len(stamps) > AFAR)
    start = InitialEstimate(runs[0].log.poses, dict(batch.landmarks))
    again = robot.solve(measured, marginals=False, initial=start)
    found = error(batch.world_from_body)
    out = [
        Cause(AS_IT_IS, tuple(error(run.log.poses) for run in runs), found),
        Cause(BATCH, (found,), found),
        Cause(FROM_FILTER, (error(again.world_from_body),), found),
        Cause(ONLINE, (error(robot.solve_online(measured)),), found),
    ]
    many = replace(config, particles=MANY * config.particles)
    changes = {f"{MANY}× particles": many} | {
        name: replace(config, proposal=proposal) for name, proposal in _proposals(config.proposal)
    }
    for name, changed in changes.items():
        on_change(name)
        means = [filter_opened(open_robot_log(log, replace(changed, seed=seed))).log.poses for seed in seeds]
        out.append(Cause(name, tuple(map(error, means)), found))
    return out


def camera_causes(
    folder: Path,
    seeds: Sequence[int],
    alignment: Alignment = "rigid",
    on_change: Callable[[str], None] = lambda name: None,
) -> list[Cause]:
    """Causes for a finished monocular run, from the files in its folder; the first row is the run itself.

    Raises:
        InputError: the folder is not a run, or its measurements cannot be adjusted.
    """
    record, log = RunFolder.open(folder), read_feature_log(folder)
    path = record.path
    config = load_settings(MonoConfig, "mono", folder / "config.yaml", (), {})
    whole = np.arange(len(path.world_from_body))
    adjusted = partial(solve_problem, log, path.world_from_body, HUBER, marginals=False)
    batch = adjusted()
    try:
        truth = record.truth
        rows, poses = truth.rows, truth.poses
    except InputError:
        rows, poses = batch.steps, batch.estimate.world_from_body

    def error(frames: np.ndarray, world_from_camera: np.ndarray) -> float:
        _, ours, theirs = np.intersect1d(frames, rows, return_indices=True)
        mine, true = (Trajectory(np.arange(ours.size), p) for p in (world_from_camera[ours], poses[theirs]))
        return ate(mine, true, alignment).rmse

    found = error(batch.steps, batch.estimate.world_from_body)
    clean = agreeing_matches(log, batch)
    calibrated = refine_calibration(log, batch)
    out = [Cause(AS_IT_IS, (error(whole, path.world_from_body),), found)]
    for name, one in {
        BATCH: batch,
        FROM_FILTER: adjusted(twice=False),
        "batch, perfect associations": adjust_near(clean, batch),
        "batch, other calibration": calibrated.batch,
    }.items():
        out.append(Cause(name, (error(one.steps, one.estimate.world_from_body),), found))
    given = partial(GivenDepths, depths=batch_depths(batch))
    changes: dict[str, tuple[FeatureLog, MonoConfig, Any]] = {
        "same measurements": (log, config, None),
        "perfect associations": (clean, config, None),
        "perfect depths": (log, config, given),
        "perfect associations and depths": (clean, config, given),
        "half the noise": (scaled_noise(log, 0.5), config, None),
        "a quarter of the noise": (scaled_noise(log, 0.25), config, None),
        "other calibration": (replace(log, camera=calibrated.camera), config, None),
    }
    for name, proposal in _proposals(config.proposal):
        changes[name] = log, replace(config, proposal=proposal), None
    changes[f"{MANY}× particles"] = log, replace(config, particles=MANY * config.particles), None
    for name, (measured, settings, wrapped) in changes.items():
        on_change(name)
        of_seed = [replace(settings, seed=seed) for seed in seeds]
        slams = [MonoSlam(measured.camera, one, measured.known, wrapped=wrapped) for one in of_seed]
        opened = [Opened(slam, LogSource(measured), measured.stamps_ns, measured.truth) for slam in slams]
        runs = [filter_opened(one) for one in opened]
        out.append(Cause(name, tuple(error(whole, run.log.poses) for run in runs), found))
    return out


def _proposals(now: ProposalConfig) -> Iterator[tuple[str, ProposalConfig]]:
    """The other number of linearisations, and the other weights."""
    if now.iterations == 1:
        yield "iterated proposal", replace(now, iterations=3)
    else:
        yield "one linearisation", replace(now, iterations=1)
    if now.weights == "exact":
        yield "linearised weights, no exact ratio", replace(now, weights="linearised", iterations=1)
    else:
        yield "exact ratio", replace(now, weights="exact")


def scaled_noise(log: FeatureLog, factor: float) -> FeatureLog:
    """The same pixels, with stated standard deviations multiplied by a factor."""
    frames = [FeatureFrame(f.stamp_ns, f.landmarks, f.z, factor**2 * f.cov_z) for f in log.frames]
    return replace(log, frames=frames)


def reprojection_errors(batch: Optimum) -> list[np.ndarray]:
    """Reprojection error of each match by frame (K,), px; NaN without a landmark."""
    assert isinstance(batch.problem, FeatureLog)
    camera, points, out = batch.problem.camera, batch.estimate.landmarks.named(), []
    nowhere = np.full(3, np.nan)
    for frame, pose in zip(batch.problem.frames, batch.estimate.world_from_body, strict=True):
        world = np.array([points.get(name, nowhere) for name in frame.landmarks.tolist()]).reshape(-1, 3)
        seen = camera.project(SE3.inverse_transform(pose, world))
        out.append(np.linalg.norm(seen - frame.z, axis=1))
    return out


def agreeing_matches(log: FeatureLog, batch: Optimum) -> FeatureLog:
    """The log without outliers of the batch."""
    frames = list(log.frames)
    for t, error in zip(batch.steps.tolist(), reprojection_errors(batch), strict=True):
        frame, kept = frames[t], ~(error > WRONG_PX)
        frames[t] = FeatureFrame(frame.stamp_ns, frame.landmarks[kept], frame.z[kept], frame.cov_z[kept])
    return replace(log, frames=frames)


def batch_depths(batch: Optimum) -> dict[int, float]:
    """Depth of each landmark in its first camera, by name, m; without those undetermined in the batch."""
    assert isinstance(batch.problem, FeatureLog)
    points, depths = batch.estimate.landmarks.named(), dict[int, float]()
    for frame, pose in zip(batch.problem.frames, batch.estimate.world_from_body, strict=True):
        for name in frame.landmarks.tolist():
            if name not in depths and name in points:
                depths[name] = float(SE3.inverse_transform(pose, points[name])[2])
    return {name: depth for name, depth in depths.items() if depth > 0.0}


@final
class GivenDepths(Sensor):
    """A sensor whose landmarks are initialised at given depths.

    Args:
        features: the sensor.
        depths: by name, m; others are initialised as usual.
    """

    def __init__(self, features: FeatureSensor, depths: Mapping[int, float]) -> None:
        self.features, self.depths = features, depths

    def observe(self, frame: FeatureFrame, belief: Belief) -> Sequence[Observations]:
        """As the sensor."""
        return self.features.observe(frame, belief)

    def new_landmarks(
        self, frame: FeatureFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """As the sensor, but each landmark at its given depth."""
        out = []
        for group in self.features.new_landmarks(frame, belief, observed):
            for k, name in enumerate(group.ids.tolist()):
                model = group.model
                if name in self.depths:
                    rho = 1.0 / self.depths[name]
                    model = CameraRay(self.features.camera, (rho, DEPTH_FRACTION * rho))
                one = slice(k, k + 1)
                out.append(NewLandmarks(group.z[one], group.cov[one], model, group.landmark, ids=group.ids[one]))
        return out


def main(
    recording: Path | None = None,
    run: Path | None = None,
    alignment: Alignment = "rigid",
    seeds: int = 3,
    out: Path = Path("out/error_causes"),
    quick: bool = False,
) -> dict[str, float]:
    """Prints the table, and writes it.

    Args:
        recording: a robot's log with ground truth.
        run: folder of a monocular run.
        alignment: of a monocular run's path with the truth.
        seeds: of the filter, for each change.
        out: folder for the table.
        quick: a few steps and particles.
    """
    out.mkdir(parents=True, exist_ok=True)
    if run is not None:
        causes = camera_causes(run, range(seeds), alignment, print)
    else:
        if recording is None:
            recording = out / "log"
            if not recording.exists():
                simulate_robot(RobotWorld(steps=30 if quick else 200, landmarks=25), recording, seed=0)
        config = RangeBearingConfig(particles=20 if quick else 100, map="particles")
        causes = robot_causes(recording, config, range(seeds), print)
    write_table(out / "causes.csv", list(HEADER), [cause.row() for cause in causes])
    save_figures({"causes.png": picture(causes)}, out)
    return {cause.name: cause.row()[1] for cause in causes}


def picture(causes: list[Cause]) -> Figure:
    """Plots the remaining error with each change."""
    figure, axes = new_axes("one thing changed at a time", "", "position error [m]")
    errors = [cause.row()[1] for cause in causes]
    axes.barh([cause.name for cause in causes], errors, color=COLOURS["filter"])
    axes.invert_yaxis()
    return figure


if __name__ == "__main__":
    tyro.cli(main)
