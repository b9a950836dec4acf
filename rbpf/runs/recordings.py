"""What is filtered: a recording of a kind that a system takes, opened to the system and the source of its frames."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from rbpf.runs.files import CHECKPOINT, prepare_folder
from rbpf.runs.run import Listener, Run, Source, drive
from rbpf.runs.truth import GroundTruth, truth_at
from rbpf.sensors.readers import RobotLog, open_log
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.systems.system import System


class Opened(NamedTuple):
    """A recording that is ready to be filtered.

    Attributes:
        system: new.
        source: of its frames.
        stamps_ns: (T,) their times; None where they are not known beforehand.
        truth: None where there is none.
    """

    system: System
    source: Source
    stamps_ns: np.ndarray | None
    truth: GroundTruth | None


@dataclass(frozen=True)
class LogSource:
    """The frames of a log that is in memory: a robot's, or a camera's named features."""

    log: Any

    @property
    def name(self) -> str:
        """Of the recording."""
        return str(self.log.name)

    def frames(self, start: int = 0) -> Iterator[Any]:
        """Frames from number `start` on."""
        return iter(self.log.frames[start:])


@dataclass(frozen=True)
class RobotRecording:
    """A robot's log.

    Attributes:
        log: folder or file of a known kind.
    """

    log: Path

    def open(self, config: RangeBearingConfig) -> Opened:
        """The system and the log's frames.

        Raises:
            InputError: the log or a setting is wrong.
        """
        return open_robot_log(open_log(self.log, config.noise), config)

    def sources(self) -> dict[str, str | float | bool]:
        """For config.yaml."""
        return {"recording": str(self.log)}


def open_robot_log(log: RobotLog, config: RangeBearingConfig) -> Opened:
    """A robot's log in memory."""
    system = RangeBearingSlam.of_log(log, config, keep_associations=config.association == "ml")
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    return Opened(system, LogSource(log), stamps, log.truth)


class Recording(Protocol):
    """What the command line filters: it can be opened as often as one likes, and says what it is made of."""

    def open(self, config: Any) -> Opened:
        """A new system with these settings, and the source of its frames."""

    def sources(self) -> dict[str, str | float | bool]:
        """For config.yaml: `recording`, and what else was read."""


def filter_recording(
    recording: Recording,
    config: Any,
    out: Path | None = None,
    resume: bool = False,
    listeners: Iterable[Listener] = (),
) -> Run:
    """Filters a recording to its end.

    Args:
        recording: what to filter.
        config: all settings of its system.
        out: folder for checkpoints, created where it does not exist; None keeps none.
        resume: go on from the checkpoint in `out`, if there is one.
        listeners: called after each frame.

    Raises:
        InputError: the recording or a setting is wrong, or the checkpoint is of another run.
    """
    opened = recording.open(config)
    if out is not None:
        prepare_folder(out)
    checkpoint = None if out is None else out / CHECKPOINT
    return filter_opened(opened, listeners, checkpoint, config.checkpoint_every, resume)


def filter_opened(
    opened: Opened,
    listeners: Iterable[Listener] = (),
    checkpoint: Path | None = None,
    every: int = 500,
    resume: bool = False,
) -> Run:
    """Takes all frames of an opened recording; see `drive`. The run then knows the truth at its frames."""
    system, source, stamps_ns, truth = opened
    expected = None if stamps_ns is None else len(stamps_ns)
    run = drive(Run(source, system, expected=expected), listeners, checkpoint, every, resume, stamps_ns)
    if truth is not None:
        run.truth = truth_at(system.space, truth, run.log.stamps_ns, system.gauge)
    return run


def filter_robot_log(log: RobotLog, config: RangeBearingConfig) -> Run:
    """A robot's log in memory, filtered to its end."""
    return filter_opened(open_robot_log(log, config))
