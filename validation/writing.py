"""Files that are whole or not there: written under a temporary name, then renamed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rbpf.errors import InputError


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
