"""Text files whose lines begin with a time."""

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.table import LATEST_S, Table, parse_number, parse_table
from rbpf.sensors.readers.text import line_error, quoted, read_lines

_DIGITS = 10


@dataclass(frozen=True)
class StampedLines:
    """Lines of a file in order of time; equal times are allowed.

    Attributes:
        path: the file.
        lines: line number of each, from 1.
        stamps_ns: (T,) int64 times.
        rests: the text after each time.
    """

    path: Path
    lines: list[int]
    stamps_ns: np.ndarray
    rests: list[str]

    def files(self, folder: Path) -> list[Path]:
        """The texts as files in a folder.

        Raises:
            InputError: a line names no file.
        """
        for line, rest in zip(self.lines, self.rests, strict=True):
            if not rest:
                raise line_error(
                    self.path, line, "expected a time and the file of an image, found only a time"
                )
        return [folder / rest for rest in self.rests]

    def table(self, columns: tuple[str, ...], separator: str | None = None) -> Table:
        """The texts as numbers; columns beyond these are passed over.

        Raises:
            InputError: a line has too few columns, or something that is no number.
        """
        join = separator or " "
        numbered = [
            (line, join.join(rest.split(separator)[: len(columns)]))
            for line, rest in zip(self.lines, self.rests, strict=True)
        ]
        return parse_table(self.path, columns, numbered, separator)


def read_stamped(
    path: Path, hint: str, separator: str | None = None, nanoseconds: bool = False
) -> StampedLines:
    """Lines of a time and something else; lines that start with # are comments.

    Args:
        path: the file.
        hint: what is expected to lie there, for the message.
        separator: what ends the time, None for blanks.
        nanoseconds: whether times are whole nanoseconds, else they are seconds.

    Raises:
        InputError: the file is missing, holds no line, or a time is none or runs backwards.
    """
    numbered = [(i, line.strip()) for i, line in enumerate(read_lines(path, hint), 1)]
    kept = [(i, line.split(separator, 1)) for i, line in numbered if line and not line.startswith("#")]
    if not kept:
        raise InputError(f"{path}: expected lines that begin with a time, found none.")
    to_ns = _nanoseconds if nanoseconds else stamp_ns
    lines = [i for i, _ in kept]
    texts = [parts[0].strip() for _, parts in kept]
    stamps = [to_ns(path, line, text) for line, text in zip(lines, texts, strict=True)]
    require_order(path, lines, texts, stamps)
    rests = [parts[1].strip() if len(parts) > 1 else "" for _, parts in kept]
    return StampedLines(path, lines, np.array(stamps, dtype=np.int64), rests)


def stamp_ns(path: Path, line: int, text: str) -> int:
    """Nanoseconds of a decimal text in seconds; digits beyond these are dropped.

    Raises:
        InputError: the text is no time.
    """
    whole = text.partition(".")[0]
    long = whole.isdigit() and len(whole) > _DIGITS
    if long or abs(parse_number(path, line, "the time", text)) > LATEST_S:
        problem = f"expected the time in seconds, within {LATEST_S:.0e} of zero, found {quoted(text)}"
        raise line_error(path, line, problem)
    return int(Decimal(text).scaleb(9))


def require_order(path: Path, lines: list[int], texts: list[str], stamps: list[int]) -> None:
    """Refuse a time before the one it follows.

    Raises:
        InputError: names the line.
    """
    for row in range(1, len(stamps)):
        if stamps[row] < stamps[row - 1]:
            problem = (
                f"time runs backwards from {texts[row - 1]} to {texts[row]}, expected lines in order of time"
            )
            raise line_error(path, lines[row], problem)


def _nanoseconds(path: Path, line: int, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) < 2**63):
        raise line_error(path, line, f"expected a time in whole nanoseconds, found {quoted(text)}")
    return int(text)
