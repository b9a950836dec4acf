"""The interface of recording formats, and their recognition: for robot logs, laser scanners and images."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from rbpf.errors import InputError
from rbpf.sensors.readers.text import quoted, read_bytes

Options = TypeVar("Options", contravariant=True)  #: A caller's options for a recording.
Recording = TypeVar("Recording", covariant=True)  #: The result of reading it.


class Format(ABC, Generic[Options, Recording]):
    """A format of recordings."""

    kind: str  #: Its name and files, for messages.

    @abstractmethod
    def recognises(self, path: Path) -> bool:
        """Whether a file or folder appears to be of this format."""

    @abstractmethod
    def read(self, path: Path, options: Options) -> Recording:
        """Read the recording in a file or folder.

        Raises InputError: a file is missing or malformed; the message names file and line.
        """


AnyFormat = TypeVar("AnyFormat", bound=Format[Any, Any])


def recognised(path: str | Path, formats: Sequence[AnyFormat], what: str, kind: str = "kind") -> tuple[Path, AnyFormat]:
    """The path, and the first of these formats that recognises it; `kind` is the attribute that describes a format.

    Raises InputError: the path does not exist (`what` was expected), or is of no known format.
    """
    path = Path(path)
    try:
        path.stat()
    except (OSError, ValueError) as error:
        reason = "no such file or folder" if isinstance(error, FileNotFoundError) else str(error)
        raise InputError(f"{path}: {reason}; expected {what}.") from None
    for one in formats:
        if one.recognises(path):
            return path, one
    # No format recognises it.
    kinds = "; or ".join(getattr(one, kind) for one in formats)
    if path.is_dir():
        names = sorted(entry.name for entry in path.iterdir())
        some = f"with {', '.join(names[:5])}{' and more' if len(names) > 5 else ''}"
        found = f"a folder {some}" if names else "an empty folder"
    else:
        first = read_bytes(path, kinds)[:80].decode(errors="replace").split("\n")[0]
        found = f"a file that begins with {quoted(first)}" if first else "an empty file"
    raise InputError(f"{path}: found {found}, expected {kinds}.")
