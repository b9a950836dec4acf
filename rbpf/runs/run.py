"""A run: a system, a recording, and the results of all frames; and the loop that makes it.

    run = Run(source, MonoSlam(camera, config))
    drive(run)                                   # or run.take(frame), one at a time
    run.log["ess"], run.log.poses, run.messages

Listeners follow a run in progress (a progress bar, a live view, a plot): each is called with the run and the result of
`track` after every frame.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from rbpf.core.checkpoint import fitting, load_arrays, read_one, text
from rbpf.errors import InputError, printable
from rbpf.runs.provenance import decisive_settings, require_same
from rbpf.runs.truth import RunTruth
from rbpf.systems.system import FrameLog, System, Tracked


class Source(Protocol):
    """A source of frames: a recording, a camera, anything."""

    @property
    def name(self) -> str:
        """Of the recording."""

    def frames(self, start: int = 0) -> Iterator[Any]:
        """Frames from number `start` on, each with a `stamp_ns`, as the system's `take` expects them."""


SystemT = TypeVar("SystemT", bound=System)
_BEGUN = "log/begun"  #: Entry of a checkpoint: the run's inputs at its start.


@dataclass(eq=False)
class Run(Generic[SystemT]):
    """A system's results for a recording."""

    source: Source  #: source of the frames.
    system: SystemT  #: the current system.
    truth: RunTruth | None = None  #: ground truth of the recording; or None.
    expected: int | None = None  #: number of frames of the recording, or None if unknown.
    #: inputs, as text by name, see `rbpf.runs.provenance.decisive_inputs`; empty if not given.
    inputs: Mapping[str, str] = field(default_factory=dict)
    log: FrameLog = field(init=False)  #: one row per frame.
    frame: Any = None  #: the last frame processed; None before the first.
    #: messages on single frames: "frame 12: …".
    messages: list[str] = field(default_factory=list)
    failure: str | None = None  #: why the run ended before the recording, or None.

    def __post_init__(self) -> None:
        self.log = FrameLog(self.system)
        if self.expected is not None:
            self.system.keep_paths(self.expected)

    @property
    def name(self) -> str:
        return printable(self.source.name)

    def take(self, frame: Any, waiting: float = 0.0) -> Tracked:
        """Processes a frame and stores the result; `waiting` is the time [s] until it arrived.

        Errors as `System.take`.
        """
        # The filter's warnings become messages of the run, with the frame instead of the step.
        health = self.system.filter.health
        health.silent, known = True, len(health.findings)
        started = time.perf_counter()
        tracked = self.system.take(frame)
        seconds = time.perf_counter() - started
        self.frame = frame
        place = f"{self.system.frame_word} {len(self.log)}"
        doubts = [words.partition(": ")[2] for words in list(self.system.filter.health.findings.values())[known:]]
        self.messages += [f"{place}: {printable(words)}" for words in (*tracked.messages, *doubts)]
        self.log.append(tracked, seconds, waiting)
        return tracked

    def save(self, path: Path) -> None:
        """A checkpoint of the system and of everything gathered so far. Raises InputError: the file cannot be written."""
        begun = json.dumps({"settings": decisive_settings(asdict(self.system.config)), "inputs": dict(self.inputs)})
        own = {"log/messages": np.array(self.messages, dtype=np.str_), _BEGUN: np.array(begun)}
        self.system.save(path, self.log.arrays() | own)

    def load(self, path: Path) -> None:
        """Continues from a checkpoint. Raises InputError: it is missing, damaged, or of another system, setting or input."""
        # Checked first, so that the message names the setting and not an array that does not fit.
        found = load_arrays(path, only=f"extra/{_BEGUN}")
        if found:
            with fitting(path):
                begun = json.loads(str(read_one(found, f"extra/{_BEGUN}", text())))
                settings, inputs = dict(begun["settings"]), dict(begun["inputs"])
            require_same(path, settings, decisive_settings(asdict(self.system.config)))
            if inputs and self.inputs:
                require_same(path, inputs, self.inputs)
        arrays = self.system.load(path)
        if not found:
            raise InputError(f"{path} does not say what run it belongs to: start without --resume")
        with fitting(path):
            self.log.restore(arrays)
            self.messages = read_one(arrays, "log/messages", text("messages")).tolist()


Listener = Callable[[Run, Tracked], None]


def drive(
    run: Run,
    listeners: Iterable[Listener] = (),
    checkpoint: Path | None = None,
    every: int = 500,
    resume: bool = False,
    stamps_ns: Sequence[int] | np.ndarray | None = None,
) -> Run:
    """Processes all remaining frames of the run's source, and calls the listeners after each.

    A frame that cannot be filtered ends the run, which keeps earlier results and has a `failure`. A full disk does not end a
    run; the last checkpoint that could be written remains. A KeyboardInterrupt from a listener writes a checkpoint, too.

    A `checkpoint` is written every `every` frames; with `resume` the run continues from it, if it exists. `stamps_ns` (T,)
    are the times of all frames, if known: a checkpoint must have the same.
    """
    if resume and checkpoint is not None and checkpoint.exists():
        run.load(checkpoint)
        done = run.log.stamps_ns
        if stamps_ns is not None and not np.array_equal(done, np.asarray(stamps_ns)[: done.size]):
            raise InputError(f"{checkpoint} belongs to a run over another recording: start without --resume")
    if stamps_ns is not None and len(run.log) >= len(stamps_ns):
        return run  # a finished run that is resumed
    waited = time.perf_counter()
    for frame in run.source.frames(len(run.log)):
        try:
            tracked = run.take(frame, time.perf_counter() - waited)
        except InputError as error:
            if not len(run.log):
                raise
            run.failure = f"{run.system.frame_word} {len(run.log)} of {run.name}: {error}"
            if checkpoint is not None and not resume and len(run.log) < every:  # it can only be an earlier run's
                checkpoint.unlink(missing_ok=True)
            break
        if checkpoint is not None and len(run.log) % every == 0:
            _keep(run, checkpoint)
        try:
            for listener in listeners:
                listener(run, tracked)
        except KeyboardInterrupt:
            if checkpoint is not None:
                _keep(run, checkpoint)
            raise
        waited = time.perf_counter()
    if checkpoint is not None and run.failure is None:
        _keep(run, checkpoint)
    return run


def _keep(run: Run, checkpoint: Path) -> None:
    """Writes a checkpoint; with a full disk the run continues, and the last one remains."""
    try:
        run.save(checkpoint)
    except InputError as error:
        run.messages.append(f"{run.system.frame_word} {len(run.log) - 1}: no checkpoint is kept: {error}")
