"""Files that a run leaves: whole or not there at all; tables, maps and summaries."""

import csv
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import StringIO
from pathlib import Path
from typing import Any

from rbpf.errors import InputError

CHECKPOINT, SUMMARY, TRAJECTORY, MAP = "checkpoint.npz", "summary.json", "trajectory.npz", "map.npz"
POSTERIOR = "posterior.npz"
VERSION = 1
"""Of trajectory.npz."""


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary place beside a file, which gets the file's name when everything is written.

    Nothing stays of what fails half way, and a file that was there before stays as it was.

    Raises:
        InputError: the place cannot be written to, or the disk is full.
    """
    temporary = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        reason = (error.strerror or str(error)).strip().splitlines()[0]
        raise InputError(f"{path} cannot be written: {reason}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def prepare_folder(out: Path) -> None:
    """Makes a run's folder.

    Raises:
        InputError: there is a file of that name, or the folder cannot be made.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder for the results")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {out} for the results: {error.strerror}") from error


def write_text(path: Path, text: str) -> None:
    """Writes a whole file or none; raises InputError where the place cannot be written to, or the disk is full."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A comma-separated table with a header line."""
    buffer = StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_text(path, buffer.getvalue())
