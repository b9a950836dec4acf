"""What all commands show progress and results with: sentences and bars on standard error, JSON on standard output."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

CONSOLE = Console(stderr=True)

_MOST_LINES = 4
"""Of a list in a table on the terminal."""


def told(bar: Progress, task: TaskID) -> Callable[[int, int], None]:
    """Something that is told how many are done, and of how many."""
    return lambda done, total: bar.update(task, completed=done, total=total)


def progress() -> Progress:
    """A bar with the time that has passed and an estimate of what is left."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=CONSOLE)


@contextmanager
def waiting(what: str) -> Iterator[None]:
    """A line with a turning mark, for work that cannot tell how far it is."""
    with CONSOLE.status(what):
        yield


def say(sentence: str) -> None:
    """A sentence, on standard error."""
    CONSOLE.print(sentence, highlight=False, soft_wrap=True)


def answer(entries: Mapping[str, Any], as_json: bool, *sentences: str) -> None:
    """A command's result: its entries as one JSON object on standard output, or sentences on standard error."""
    if as_json:
        sys.stdout.write(json.dumps(entries, default=str, allow_nan=False) + "\n")
        return
    for sentence in sentences:
        say(sentence)


def table(entries: Mapping[str, Any], width: int = 34) -> str:
    """Names and values, one a line; of a long list the beginning, one item a line."""
    lines = []
    for name, value in entries.items():
        shown = [str(item) for item in value] if isinstance(value, list) else [_shown(value)]
        hidden = len(shown) - _MOST_LINES
        if hidden > 0:
            shown[_MOST_LINES:] = [f"… and {hidden} more, in summary.json"]
        lines += [f"{name:>{width}}  {shown[0]}"] if shown else []
        lines += [f"{'':>{width}}  {line}" for line in shown[1:]]
    return "\n".join(lines)


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(item)}" for name, item in value.items())
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def megabytes(folder: Path) -> float:
    """Size of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6
