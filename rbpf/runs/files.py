"""Writes a run's files atomically; tables, maps and summaries."""

import csv
import errno
import fcntl
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import StringIO
from itertools import count
from pathlib import Path
from typing import Any

from rbpf.core.checkpoint import whole
from rbpf.errors import InputError

CHECKPOINT, SUMMARY, TRAJECTORY, MAP = "checkpoint.npz", "summary.json", "trajectory.npz", "map.npz"
POSTERIOR, GRID, ODOMETRY, BATCH = "posterior.npz", "grid.npz", "odometry.tum", "batch.tum"
PAGE, VIDEO = "report.html", "annotated.mp4"
COMPARISON = "validation_"  #: What the names of a comparison's files begin with.
LOCK = ".lock"  #: Lock file in a run's folder while a process writes there; holds its id.
VERSION = 1  #: Of trajectory.npz.
OnDone = Callable[[int, int], None]  #: Called with the number of parts done, and their total.


def prepare_folder(out: Path, what: str = "results") -> None:
    """Makes a folder; `what` names its purpose in messages.

    Raises InputError: there is a file of that name, or the folder cannot be made.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder for the {what}")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {out} for the {what}: {error.strerror}") from error


def holds_run(out: Path) -> bool:
    """Whether a run, finished or not, lies in a folder."""
    return any((out / name).exists() for name in (CHECKPOINT, TRAJECTORY, SUMMARY))


def numbered(out: Path, last: bool = False) -> Path:
    """The first of `run`, `run-2`, `run-3`, … without a run; with `last` the last one with a run, if any."""
    before = out
    for number in count(2):
        place = out if number == 2 else out.with_name(f"{out.name}-{number - 1}")
        if not holds_run(place):
            break
        before = place
    return before if last else place


@contextmanager
def own_folder(out: Path) -> Iterator[None]:
    """Creates and locks a run's folder, so that no other process writes there.

    A folder created here and left empty is removed again. It is a lock of the operating system, so that a killed process
    holds none; file systems without locks are not locked. Raises InputError: the folder cannot be made or written to, or
    another process writes there.
    """
    missing = [place for place in (out, *out.parents) if not place.exists()]
    prepare_folder(out)
    try:
        file = _locked(out / LOCK)
        try:
            yield
        finally:
            with suppress(OSError):
                (out / LOCK).unlink()
            os.close(file)
    finally:
        with suppress(OSError):
            for place in missing:
                place.rmdir()


def _locked(path: Path) -> int:
    """Descriptor of a file locked by this process."""
    while True:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise InputError(f"{path.parent} cannot be written to: {error.strerror}") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = os.read(file, 20).decode(errors="replace").strip()
            os.close(file)
            raise InputError(
                f"another run, process {who}, writes to {path.parent}: wait for it, or name another folder with --out"
            ) from None
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                os.close(file)
                raise InputError(f"{path.parent} cannot be locked: {error.strerror}") from error
        # The previous owner may have removed it meanwhile, so that another process can create a new file of this name.
        with suppress(OSError):
            if os.path.samestat(os.fstat(file), os.stat(path, follow_symlinks=False)):
                os.ftruncate(file, 0)
                os.write(file, f"{os.getpid()}\n".encode())
                return file
        os.close(file)


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A comma-separated table with a header line."""
    buffer = StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_text(path, buffer.getvalue())


def write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]], shown: bool = True) -> None:
    """A table of figures as CSV, numbers with six digits; `shown` also prints it in columns, with three. Makes the folder."""

    def text(cell: Any, digits: int) -> str:
        if isinstance(cell, float):
            return f"{cell:.0f}" if 1000 <= abs(cell) < 1e6 else f"{cell:.{digits}g}"
        return str(cell)

    prepare_folder(path.parent)
    write_csv(path, header, [[text(cell, 6) for cell in row] for row in rows])
    lines = [list(header), *([text(cell, 3) for cell in row] for row in rows)] if shown else []
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for first, *others in lines:
        print("  ".join([first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(others, widths[1:], strict=True))]))
