"""Recognises the kind of a robot log and reads it."""

from pathlib import Path

from rbpf.errors import InputError
from rbpf.sensors.readers import mrclam, mrpt, victoria_park
from rbpf.sensors.readers.log import RobotLog
from rbpf.sensors.readers.noise import LogNoise
from rbpf.sensors.readers.text import quoted, read_bytes

_READERS = (mrpt, mrclam, victoria_park)


def open_log(path: str | Path, noise: LogNoise | None = None) -> RobotLog:
    """Read a robot log of any known kind: MRPT, MRCLAM or a graph such as Victoria Park.

    The modules of the readers describe the formats.

    Args:
        path: the log's folder or file.
        noise: standard deviations to use in place of the log's.

    Returns:
        The log.

    Raises:
        InputError: nothing is there, it is of no known kind, or a file of it is malformed.
    """
    path = Path(path)
    try:
        path.stat()
    except (OSError, ValueError) as error:
        reason = "no such file or folder" if isinstance(error, FileNotFoundError) else str(error)
        raise InputError(f"{path}: {reason}; expected a robot log.") from None
    for reader in _READERS:
        if reader.recognises(path):
            return reader.read(path, noise or LogNoise())
    kinds = "; or ".join(reader.KIND for reader in _READERS)
    raise InputError(f"{path}: found {_content(path)}, expected {kinds}.")


def _content(path: Path) -> str:
    if not path.is_dir():
        first = read_bytes(path)[:80].decode(errors="replace").split("\n")[0]
        return f"a file that begins with {quoted(first)}" if first else "an empty file"
    names = sorted(entry.name for entry in path.iterdir())
    if not names:
        return "an empty folder"
    return f"a folder with {', '.join(names[:5])}{' and more' if len(names) > 5 else ''}"
