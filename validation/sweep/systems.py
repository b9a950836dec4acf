"""What a sweep can run: by the system's name, how a sequence is opened and a single run becomes a row of figures.

A new system is one function from a sequence and settings to figures, entered into `SYSTEMS`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.folder import summarise
from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import (
    LaserRecording,
    MonoRecording,
    Recording,
    RobotRecording,
    StereoRecording,
    filter_recording,
)
from rbpf.runs.run import Run
from rbpf.runs.trajectory import in_space
from rbpf.systems.laser.config import LaserConfig
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.settings import load_settings
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.metrics.scores import ODOMETRY_PREFIX, score_estimate, score_path

Figures = dict[str, Any]


@dataclass(frozen=True)
class SweepSystem:
    """A system that a sweep can run."""

    fields: tuple[str, ...]  #: of a sequence, each a path; the first is the recording itself.
    check: Callable[[Sequence[str], Mapping[str, Any]], object]  #: raises `InputError` where settings are wrong.
    #: filters a sequence with settings key=value, and given ones by name, to figures.
    run: Callable[[Mapping[str, Path], Sequence[str], Mapping[str, Any]], Figures]


def system_named(name: str) -> SweepSystem:
    """A system of `SYSTEMS`.

    Raises:
        InputError: there is none of this name.
    """
    if name not in SYSTEMS:
        raise InputError(f"a sweep runs one of the systems {', '.join(SYSTEMS)}, not {name!r}")
    return SYSTEMS[name]


def _figures(run: Run, anonymous: bool = False) -> Figures:
    """What a run's summary and scores say, without writing them; `anonymous` as `score_estimate`'s."""
    figures, log, truth = summarise(run), run.log, run.truth
    if truth is not None:
        figures |= score_estimate(PathAndMap.of_run(run), truth, anonymous)
        if "odometry" in log:
            reference = in_space(log.stamps_ns[truth.rows], truth.poses)
            prefix = ODOMETRY_PREFIX.get(run.system.name, "odometry_")
            figures |= score_path(in_space(log.stamps_ns, log["odometry"]), reference, truth, prefix)
    if truth is not None and truth.alignment == "none":
        # Mean over the steps, of d degrees of freedom; nothing where the truth is not given in the filter's world.
        errors = whitened_errors(run.system.space, log.poses[truth.rows], log.covs[truth.rows], truth.poses)
        if (known := errors.ranks > 0).any():
            figures["pose_nees_mean"] = float(errors.nees[known].mean())
    return figures


def _system(name: str, config: type, recording: Callable[..., Recording], *fields: str) -> SweepSystem:
    """A system of `rbpf run`, of which a recording is made from the paths of some fields."""

    def settings(pairs: Sequence[str], given: Mapping[str, Any]) -> Any:
        return load_settings(config, name, None, pairs, given)

    def run(sequence: Mapping[str, Path], pairs: Sequence[str], given: Mapping[str, Any]) -> Figures:
        chosen = settings(pairs, given)
        filtered = filter_recording(recording(*(sequence.get(field) for field in fields)), chosen)
        return _figures(filtered, getattr(chosen, "association", "") == "ml")

    return SweepSystem(fields, settings, run)


SYSTEMS = {
    "range-bearing": _system("range-bearing", RangeBearingConfig, RobotRecording, "recording"),
    "laser": _system("laser", LaserConfig, LaserRecording, "recording"),
    "mono": _system("mono", MonoConfig, MonoRecording, "recording", "known_points", "calibration"),
    "stereo": _system("stereo", StereoConfig, StereoRecording, "recording", "calibration"),
}
