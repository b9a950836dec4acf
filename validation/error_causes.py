"""Why a filter is further from the truth than the batch optimum of its measurements: one thing changed at a time.

The filter is run again on the same measurements with more particles, another linearisation, other weights, and, for a
camera, perfect associations and depths; the batch is started from the filter and from its own start, and, for a robot,
told what had been measured until then and no more. What brings the error down to the batch's is what kept it up.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.alignment import Alignment
from rbpf.runs.measurement_files import read_feature_log
from rbpf.runs.reading import RunFolder
from rbpf.runs.trajectory import Trajectory, in_space
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.sensors.readers import open_log
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.systems.filtering import ProposalConfig
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.run import run as filter_log
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.run import run as filter_robot
from rbpf.systems.settings import load_settings
from rbpf.validation.gtsam import robot
from rbpf.validation.gtsam.batch_problem import AFAR
from rbpf.validation.gtsam.mono_batch import adjust_log
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.mono_budget import MANY
from rbpf.validation.mono_parts import GivenDepths, agreeing_matches, batch_depths
from rbpf.validation.run_folder import used_measurements
from rbpf.validation.run_truth import robot_truth

AS_IT_IS, BATCH, FROM_FILTER = "as it is", "batch", "batch started from the filter"
ONLINE = "batch of what was measured until then"
HEADER = ("changed", "error_m", "least_m", "most_m", "ratio")

Told = Callable[[str], None]


@final
@dataclass(frozen=True)
class Cause:
    """Error with one thing changed.

    Attributes:
        name: of what was changed.
        errors_m: root mean square position error of each seed.
        batch_m: of the batch optimum.
    """

    name: str
    errors_m: tuple[float, ...]
    batch_m: float

    def row(self) -> tuple[str, float, float, float, float]:
        """For a table with `HEADER`: the median over the seeds, the range, and the median's ratio to the batch."""
        middle = float(np.median(self.errors_m))
        return self.name, middle, min(self.errors_m), max(self.errors_m), middle / self.batch_m


def robot_causes(
    recording: Path, config: RangeBearingConfig, seeds: Sequence[int], told: Told | None = None
) -> list[Cause]:
    """Of a robot's log, whose associations are known.

    Raises:
        InputError: the recording is wrong, or has no ground truth.
    """
    log = open_log(recording, config.noise)
    truth = robot_truth(log)
    if truth is None:
        raise InputError(f"{recording} has no ground truth to tell errors by")
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)

    def error(poses: np.ndarray) -> float:
        return _error(log.space, stamps, poses, truth.rows, truth.poses, "rigid")

    runs = [filter_robot(log, replace(config, seed=seed)) for seed in seeds]
    measured = used_measurements(runs[0])
    batch = robot.solve(measured, marginals=False, incremental=len(stamps) > AFAR)
    start = InitialEstimate(runs[0].progress.mean, dict(batch.landmarks))
    again = robot.solve(measured, marginals=False, initial=start)
    found = error(batch.world_from_robot)
    out = [
        Cause(AS_IT_IS, tuple(error(run.progress.mean) for run in runs), found),
        Cause(BATCH, (found,), found),
    ]
    out.append(Cause(FROM_FILTER, (error(again.world_from_robot),), found))
    out.append(Cause(ONLINE, (error(robot.solve_online(measured)),), found))
    for name, changed in _robot_changes(config):
        if told is not None:
            told(name)
        means = [filter_robot(log, replace(changed, seed=seed)).progress.mean for seed in seeds]
        out.append(Cause(name, tuple(map(error, means)), found))
    return out


def camera_causes(
    folder: Path, seeds: Sequence[int], alignment: Alignment = "rigid", told: Told | None = None
) -> list[Cause]:
    """Of a finished monocular run, from the files in its folder; the first row is the run itself.

    Raises:
        InputError: the folder is none, or has no ground truth.
    """
    record, log = RunFolder.open(folder), read_feature_log(folder)
    path, truth = record.path, record.truth
    config = load_settings(MonoConfig, "mono", folder / "config.yaml", (), {})

    def error(rows: np.ndarray, poses: np.ndarray) -> float:
        _, ours, theirs = np.intersect1d(rows, truth.rows, return_indices=True)
        mine, true = (Trajectory(np.arange(ours.size), p) for p in (poses[ours], truth.poses[theirs]))
        return ate(mine, true, alignment).rmse

    whole = np.arange(len(path.mean))
    batch = adjust_log(log, path.mean)
    alone = adjust_log(log, path.mean, twice=False)
    found = error(batch.frames, batch.world_from_camera)
    out = [Cause(AS_IT_IS, (error(whole, path.mean),), found), Cause(BATCH, (found,), found)]
    out.append(Cause(FROM_FILTER, (error(alone.frames, alone.world_from_camera),), found))
    for name, work in _camera_changes(log, config, agreeing_matches(log, batch), batch_depths(batch)):
        if told is not None:
            told(name)
        errors = tuple(error(whole, work(seed).world_from_camera) for seed in seeds)
        out.append(Cause(name, errors, found))
    return out


def _robot_changes(config: RangeBearingConfig) -> Iterator[tuple[str, RangeBearingConfig]]:
    yield f"{MANY}× particles", replace(config, particles=MANY * config.particles)
    yield from ((name, replace(config, proposal=proposal)) for name, proposal in _proposals(config.proposal))


def _proposals(now: ProposalConfig) -> Iterator[tuple[str, ProposalConfig]]:
    if now.iterations == 1:
        yield "iterated proposal", replace(now, iterations=3)
    else:
        yield "one linearisation", replace(now, iterations=1)
    if now.weights == "exact":
        yield "linearised weights, no exact ratio", replace(now, weights="linearised", iterations=1)
    else:
        yield "exact ratio", replace(now, weights="exact")


def _camera_changes(
    log: FeatureLog, config: MonoConfig, clean: FeatureLog, depths: dict[int, float]
) -> Iterator[tuple[str, Callable[[int], Any]]]:
    given = partial(_with_depths, depths=depths)

    def filtered(measured: FeatureLog, settings: MonoConfig, wrapped: Any = None) -> Callable[[int], Any]:
        more = {} if wrapped is None else {"wrapped": wrapped}
        return lambda seed: filter_log(measured, replace(settings, seed=seed), **more)

    yield "same measurements", filtered(log, config)
    yield "perfect associations", filtered(clean, config)
    yield "perfect depths", filtered(log, config, given)
    yield "perfect associations and depths", filtered(clean, config, given)
    yield "half the noise", filtered(scaled_noise(log, 0.5), config)
    yield "a quarter of the noise", filtered(scaled_noise(log, 0.25), config)
    for name, proposal in _proposals(config.proposal):
        yield name, filtered(log, replace(config, proposal=proposal))
    yield f"{MANY}× particles", filtered(log, replace(config, particles=MANY * config.particles))


def scaled_noise(log: FeatureLog, factor: float) -> FeatureLog:
    """The same pixels, said to have standard deviations so many times as large."""
    frames = [FeatureFrame(f.stamp_ns, f.landmarks, f.z, factor**2 * f.cov_z) for f in log.frames]
    return replace(log, frames=frames)


def _with_depths(features: Any, depths: dict[int, float]) -> GivenDepths:
    return GivenDepths(features, depths)


def _error(
    space: Any, stamps: np.ndarray, poses: np.ndarray, rows: np.ndarray, truth: np.ndarray, how: Alignment
) -> float:
    return ate(in_space(stamps[rows], poses[rows]), in_space(stamps[rows], truth), how).rmse
