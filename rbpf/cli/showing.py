"""Output of all commands: messages and progress bars on standard error, JSON on standard output."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rbpf.errors import printable

CONSOLE = Console(stderr=True)


class OnProgress(Protocol):
    """Called with the number done, the total or None if unknown, and a message."""

    def __call__(self, done: int, total: int | None, words: str = "") -> None: ...


@contextmanager
def progress() -> Iterator[Callable[[str], OnProgress]]:
    """Makes progress bars by name: each is a callback, shown from its first call."""
    done, left = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()), (TextColumn("left:"), TimeRemainingColumn())
    said = TextColumn("{task.fields[words]}", markup=False)
    bars = Progress(TextColumn("{task.description}"), *done, *left, said, console=CONSOLE)

    def bar(what: str) -> OnProgress:
        task = bars.add_task(what, total=None, start=False, visible=False, words="")

        def report(done: int, total: int | None, words: str = "") -> None:
            bars.start()
            bars.start_task(task)
            bars.update(task, completed=done, total=total or None, visible=True, words=words)

        return report

    try:
        yield bar
    finally:
        if bars.live.is_started:
            bars.stop()


def say(sentence: str) -> None:
    """Prints a message on standard error, without markup; wrapped between words only on a terminal."""
    CONSOLE.print(printable(sentence), highlight=False, markup=False, emoji=False, soft_wrap=not CONSOLE.is_terminal)


def answer(entries: Mapping[str, Any], as_json: bool, *sentences: str) -> None:
    """A command's result: its entries as one JSON object on standard output, or sentences on standard error."""
    if as_json:
        sys.stdout.write(json.dumps(entries, default=str, allow_nan=False) + "\n")
        return
    for sentence in sentences:
        say(sentence)


def table(entries: Mapping[str, Any], width: int) -> list[str]:
    """Names and values, one per line."""
    return [f"{name:>{width}}  {_shown(value)}" for name, value in entries.items()]


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(item)}" for name, item in value.items())
    return f"{value:.6g}" if isinstance(value, float) else str(value)
