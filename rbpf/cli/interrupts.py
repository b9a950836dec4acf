"""Ctrl-C during a run: the frame that is being filtered is finished, a checkpoint is written, then the run stops."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from rbpf.cli.showing import OnProgress, say


class StoppedError(KeyboardInterrupt):
    """Someone stopped a command; the text says how to go on."""


@contextmanager
def patient(report: OnProgress) -> Iterator[OnProgress]:
    """What a run reports its progress to, in place of `report`: after Ctrl-C it stops the run at the next frame.

    A second Ctrl-C stops it at once, without a checkpoint of its own.
    """
    asked = threading.Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        if asked.is_set():
            raise StoppedError("stopped; the same command with --resume goes on from the last checkpoint")
        asked.set()
        say("stopping after this frame; Ctrl-C again stops at once …")

    def listening(done: int, total: int | None, words: str = "") -> None:
        report(done, total, words)
        if asked.is_set():
            raise StoppedError(
                f"stopped after {done} of {total or 'an unknown number'}; the same command with --resume goes on from there"
            )

    if threading.current_thread() is not threading.main_thread():
        yield listening
        return
    before = signal.signal(signal.SIGINT, ask)
    try:
        yield listening
    finally:
        signal.signal(signal.SIGINT, before)
