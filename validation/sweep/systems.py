"""What a sweep can run: by the system's name, how a sequence is opened and a single run becomes a row of figures.

A new system is one function from a sequence and settings to figures, entered into `SYSTEMS`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.truth import RunTruth
from rbpf.systems.settings import load_settings
from rbpf.validation.consistency.statistic import whitened_errors

if TYPE_CHECKING:
    from rbpf.runs.run import Run

Figures = dict[str, Any]


@dataclass(frozen=True)
class SweepSystem:
    """A system that a sweep can run.

    Attributes:
        fields: of a sequence, each a path; the first is the recording itself.
        check: raises `InputError` where settings are wrong.
        run: filters a sequence with settings key=value, and given ones by name, to figures.
    """

    fields: tuple[str, ...]
    check: Callable[[Sequence[str], Mapping[str, Any]], object]
    run: Callable[[Mapping[str, Path], Sequence[str], Mapping[str, Any]], Figures]


def system_named(name: str) -> SweepSystem:
    """A system of `SYSTEMS`.

    Raises:
        InputError: there is none of this name.
    """
    if name not in SYSTEMS:
        raise InputError(f"a sweep runs one of the systems {', '.join(SYSTEMS)}, not {name!r}")
    return SYSTEMS[name]


def _robot_settings(pairs: Sequence[str], given: Mapping[str, Any]) -> Any:
    from rbpf.systems.range_bearing.config import RangeBearingConfig

    return load_settings(RangeBearingConfig, "range-bearing", None, pairs, given)


def _run_robot(sequence: Mapping[str, Path], pairs: Sequence[str], given: Mapping[str, Any]) -> Figures:
    from rbpf.runs.recordings import RobotRecording, filter_recording

    config = _robot_settings(pairs, given)
    return _figures(filter_recording(RobotRecording(sequence["recording"]), config), config.association == "ml")


def _figures(run: "Run", anonymous: bool = False) -> Figures:
    """What a run's summary and scores say, without writing them; `anonymous` as `score_estimate`'s."""
    from rbpf.runs.folder import summarise
    from rbpf.runs.reading import PathAndMap
    from rbpf.runs.trajectory import in_space
    from rbpf.validation.metrics.scores import ODOMETRY_PREFIX, score_estimate, score_path

    figures, log, truth = summarise(run), run.log, run.truth
    if truth is not None:
        figures |= score_estimate(PathAndMap.of_run(run), truth, anonymous)
        if "odometry" in log:
            reference = in_space(log.stamps_ns[truth.rows], truth.poses)
            prefix = ODOMETRY_PREFIX.get(run.system.name, "odometry_")
            figures |= score_path(in_space(log.stamps_ns, log["odometry"]), reference, truth, prefix)
    return figures | _pose_nees(run.system.space, log.poses, log.covs, truth)


def _mono_settings(pairs: Sequence[str], given: Mapping[str, Any]) -> Any:
    from rbpf.systems.mono.config import MonoConfig

    return load_settings(MonoConfig, "mono", None, pairs, given)


def _run_mono(sequence: Mapping[str, Path], pairs: Sequence[str], given: Mapping[str, Any]) -> Figures:
    from rbpf.runs.recordings import MonoRecording, filter_recording

    recording = MonoRecording(sequence["recording"], sequence.get("known_points"), sequence.get("calibration"))
    return _figures(filter_recording(recording, _mono_settings(pairs, given)))


def _stereo_settings(pairs: Sequence[str], given: Mapping[str, Any]) -> Any:
    from rbpf.systems.stereo.config import StereoConfig

    return load_settings(StereoConfig, "stereo", None, pairs, given)


def _run_stereo(sequence: Mapping[str, Path], pairs: Sequence[str], given: Mapping[str, Any]) -> Figures:
    from rbpf.runs.recordings import StereoRecording, filter_recording

    recording = StereoRecording(sequence["recording"], sequence.get("calibration"))
    return _figures(filter_recording(recording, _stereo_settings(pairs, given)))


def _pose_nees(space: Any, mean: np.ndarray, cov: np.ndarray, truth: RunTruth | None) -> Figures:
    """Mean over the steps, of d degrees of freedom; nothing where the truth is not given in the filter's world."""
    if truth is None or truth.alignment != "none":
        return {}
    errors = whitened_errors(space, mean[truth.rows], cov[truth.rows], truth.poses)
    known = errors.ranks > 0
    return {"pose_nees_mean": float(errors.nees[known].mean())} if known.any() else {}


SYSTEMS = {
    "range-bearing": SweepSystem(("recording",), _robot_settings, _run_robot),
    "mono": SweepSystem(("recording", "known_points", "calibration"), _mono_settings, _run_mono),
    "stereo": SweepSystem(("recording", "calibration"), _stereo_settings, _run_stereo),
}
