"""What all commands show progress with."""

from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

CONSOLE = Console(stderr=True)


def told(bar: Progress, task: TaskID) -> Callable[[int, int], None]:
    """Something that is told how many are done, and of how many."""
    return lambda done, total: bar.update(task, completed=done, total=total)


def progress() -> Progress:
    """A bar with an estimate of the time that is left."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=CONSOLE)
