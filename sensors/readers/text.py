"""Strict reading of text files: whatever is not as expected is named with its file and line.

A file is UTF-8 text whose last line is complete.
"""

from pathlib import Path

from rbpf.errors import InputError

MOST_BYTES = 1 << 30
"""No table of a recording is larger."""


def line_error(path: Path, line: int, problem: str) -> InputError:
    """Error that points at a line, counted from 1."""
    return InputError(f"{path}, line {line}: {problem}.")


def quoted(text: str) -> str:
    """Text from a file, short and printable."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def read_bytes(path: Path, hint: str = "") -> bytes:
    """Content of a file.

    Args:
        path: the file.
        hint: what is expected to lie there, for the message.

    Raises:
        InputError: the file is missing or cannot be read.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(
                f"{path}: the file is larger than {MOST_BYTES >> 20} MiB{hint and '; expected ' + hint}."
            )
        return path.read_bytes()
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file{hint and '; expected ' + hint}.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}).") from None


def read_text(path: Path, hint: str = "") -> str:
    """Text of a file without a byte-order mark.

    Args:
        path: the file.
        hint: what is expected to lie there, for the message.

    Raises:
        InputError: the file is missing, empty or not UTF-8.
    """
    data = read_bytes(path, hint)
    if not data.strip():
        raise InputError(f"{path}: the file is empty{hint and '; expected ' + hint}.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise line_error(path, line, "expected text in UTF-8, found other bytes") from None


def read_lines(path: Path, hint: str = "") -> list[str]:
    """Lines of a file whose last line is complete, without their ends.

    Raises:
        InputError: as `read_text`, or the last line has no end.
    """
    lines = read_text(path, hint).split("\n")
    if lines[-1]:
        problem = "the file ends inside this line; copy it again, or end the line if it is complete"
        raise line_error(path, len(lines), problem)
    return [line.removesuffix("\r") for line in lines[:-1]]
