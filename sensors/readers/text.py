"""Strict reading of text files and tables of numbers: errors name the file and the line.

A file is UTF-8 text whose last line is complete. Numbers are decimal, finite and at most `LARGEST` in size, which keeps
every product that a reader forms far from overflow.
"""

import re
import zlib
from codecs import BOM_UTF8
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from stat import S_ISDIR, S_ISREG

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array

MOST_BYTES = 1 << 30  #: No table of a recording is larger.
LARGEST = 1e12
LATEST_S = 4e9
#: Limits of the median seconds between rows: real data are neither denser nor, unless a rate is stated, sparser.
SHORTEST_GAP_S, LONGEST_GAP_S = 1e-4, 5.0
#: Beyond this multiple of the stated interval the times are probably in milliseconds.
OFF_RATE = 1e3**0.5

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_PLAIN = dict.fromkeys(map(ord, "0123456789+-.eE \t,"))


def line_error(path: Path, line: int, problem: str) -> InputError:
    """Error that points at a line, counted from 1."""
    return InputError(f"{path}, line {line}: {problem}.")


def quoted(text: str) -> str:
    """Text from a file, short and printable."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def read_bytes(path: Path, hint: str = "", most: int | None = None) -> bytes:
    """Content of a file of at most so many bytes, or `MOST_BYTES`; `hint` describes the expected file, for messages.

    Raises InputError: the file is missing, too large or cannot be read.
    """
    most, expected = MOST_BYTES if most is None else most, hint and f"; expected {hint}"
    try:
        status = path.stat()
        if not S_ISREG(status.st_mode):  # a pipe would block, a device never end
            kind = "a folder" if S_ISDIR(status.st_mode) else "a device or a pipe"
            raise InputError(f"{path}: cannot be read: it is {kind}, no file{expected}.")
        if status.st_size > most:
            raise InputError(f"{path}: the file is larger than {most >> 20} MiB{expected}.")
        with path.open("rb") as file:
            return file.read(status.st_size)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file{expected}.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}).") from None


def read_text(path: Path, hint: str = "", most: int | None = None) -> str:
    """Text of a file, plain or gzip-compressed, without a byte-order mark.

    Raises InputError: as `read_bytes`, or the file is empty apart from a byte-order mark, or not UTF-8.
    """
    data = read_bytes(path, hint, most)
    if data.startswith(b"\x1f\x8b"):  # packed by gzip
        unpacking = zlib.decompressobj(wbits=31)
        try:
            data = unpacking.decompress(data, MOST_BYTES)
        except zlib.error as error:
            raise InputError(f"{path}: it is packed by gzip and damaged ({error}); copy it again.") from None
        if unpacking.unconsumed_tail:
            raise InputError(f"{path}: the file is larger than {MOST_BYTES >> 20} MiB once it is unpacked.")
        if not unpacking.eof:
            raise InputError(f"{path}: it is packed by gzip and cut off; copy it again.")
    if not data.removeprefix(BOM_UTF8).strip():
        raise InputError(f"{path}: the file is empty{hint and '; expected ' + hint}.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise line_error(path, line, "expected text in UTF-8, found other bytes") from None


def read_lines(path: Path, hint: str = "") -> list[str]:
    """Lines of a file without line ends; its last line must be complete."""
    lines = read_text(path, hint).split("\n")
    if lines[-1]:
        raise line_error(path, len(lines), "the file ends inside this line; copy it again, or end it if it is complete")
    return [line.removesuffix("\r") for line in lines[:-1]]


def numbered_lines(path: Path, hint: str = "") -> list[tuple[int, str]]:
    """Stripped lines of a file with their numbers from 1, without blank ones and comments (#)."""
    numbered = ((number, line.strip()) for number, line in enumerate(read_lines(path, hint), 1))
    return [(number, line) for number, line in numbered if line and not line.startswith("#")]


@dataclass(frozen=True)
class Table:
    """Rows of numbers (n, c) in named columns, with the text of each and its line in their file, from 1."""

    path: Path
    columns: tuple[str, ...]
    rows: list[str]
    lines: list[int]
    values: Array

    def __getitem__(self, column: str) -> Array:
        """(n,) numbers of a column."""
        return self.values[:, self.columns.index(column)]

    def block(self, first: str, last: str) -> Array:
        """(n, k) numbers of the columns from `first` to `last`."""
        return self.values[:, self.columns.index(first) : self.columns.index(last) + 1]

    def error(self, row: int, problem: str) -> InputError:
        """Error that points at a row, counted from 0."""
        return line_error(self.path, self.lines[row], problem)

    def require(self, valid: NDArray[np.bool_], column: str, expected: str) -> None:
        """Raises InputError for the first row at which `valid` (n,) is False."""
        if not valid.all():
            row = int(np.argmin(valid))
            raise self.error(row, f"expected {column} to be {expected}, found {self[column][row]:.12g}")

    def integers(self, column: str) -> NDArray[np.int64]:
        """(n,) a column that must hold whole numbers."""
        self.require(self[column] == np.floor(self[column]), column, "a whole number")
        return self[column].astype(np.int64)

    def names(self, column: str) -> NDArray[np.int64]:
        """(n,) a column that must hold distinct whole numbers."""
        names = self.integers(column)
        if (row := _second(names)) is not None:
            raise self.error(row, f"{column} {names[row]} occurs twice, expected it once")
        return names

    def require_distinct(self, frame: NDArray[np.int64], landmarks: NDArray[np.int64], when: str) -> None:
        """Refuses landmarks (n,) that occur twice in a frame (n,); `when` is the recording's word for a frame."""
        if (row := _second(np.stack([frame, landmarks], axis=1))) is not None:
            again = f"landmark {landmarks[row]} occurs twice in {when} {frame[row]}"
            raise self.error(row, f"{again}, expected it once")

    def stamps_ns(self) -> NDArray[np.int64]:
        """(n,) the first column, times in seconds, as nanoseconds; further digits are dropped.

        The decimal text is converted, not its rounded float.
        """
        return _stamps_ns(self.path, self.lines, [row.split(None, 1)[0] for row in self.rows], parse_time)


def _second(values: NDArray[np.int64]) -> int | None:
    """The first row of values (n,) or (n, k) that repeats an earlier one; None if all are distinct."""
    _, first = np.unique(values, axis=0, return_index=True)
    later = np.setdiff1d(np.arange(len(values)), first)
    return int(later[0]) if later.size else None


def read_columns(path: Path, columns: tuple[str, ...], hint: str = "") -> Table:
    """File of blank-separated columns; lines that start with # are comments."""
    return parse_table(path, columns, numbered_lines(path, hint))


def read_csv(path: Path, headers: Sequence[tuple[str, ...]], hint: str = "") -> Table:
    """File of comma-separated columns under one of these headers; the table's `columns` are the one found."""
    lines = read_lines(path, hint)
    found = tuple(name.strip() for name in lines[0].split(","))
    if found not in headers:
        allowed = " or ".join(repr(",".join(header)) for header in headers)
        raise line_error(path, 1, f"expected the header {allowed}, found {quoted(lines[0])}")
    return parse_table(path, found, enumerate(lines[1:], 2), ",")


def parse_table(
    path: Path, columns: tuple[str, ...], numbered: Iterable[tuple[int, str]], separator: str | None = None
) -> Table:
    """Numbers in numbered lines of a file; blank lines are ignored. The separator None means whitespace."""
    filled = [(number, line) for number, line in numbered if line.strip()]
    if not filled:
        raise InputError(f"{path}: expected rows of {', '.join(columns)}, found none.")
    lines, rows = [number for number, _ in filled], [line for _, line in filled]
    # NumPy's parser reads the whole file. Only if it fails, or accepts something suspicious, are the lines read one by one:
    # characters beyond those of plain numbers (nan, 0x1p3, quotes) have a meaning in NumPy.
    values = None
    if not "".join(rows).translate(_PLAIN):
        with suppress(ValueError):
            values = np.loadtxt(rows, comments=None, delimiter=separator, ndmin=2)
    if values is None or values.shape != (len(rows), len(columns)) or not (np.abs(values) <= LARGEST).all():
        values = np.empty((len(rows), len(columns)))
        for number, (line, row) in enumerate(filled):
            fields = [field.strip() for field in row.split(separator)]
            if len(fields) != len(columns):
                problem = f"expected {len(columns)} columns ({', '.join(columns)}), found {len(fields)}"
                raise line_error(path, line, problem)
            values[number] = [parse_number(path, line, *item) for item in zip(columns, fields, strict=True)]
    return Table(path, columns, rows, lines, values)


def parse_number(path: Path, line: int, column: str, field: str) -> float:
    """Number in a field of a line, counted from 1."""
    if not _NUMBER.fullmatch(field):
        raise line_error(path, line, f"expected {column} to be a finite number, found {quoted(field)}")
    value = float(field)
    if not abs(value) <= LARGEST:
        raise line_error(path, line, f"expected {column} to be at most {LARGEST:.0e} in size, found {quoted(field)}")
    return value


def parse_time(path: Path, line: int, text: str) -> int:
    """Time in seconds in a line, counted from 1, as nanoseconds; further digits are dropped."""
    if not (_NUMBER.fullmatch(text) and abs(float(text)) <= LATEST_S):
        problem = f"expected the time in seconds, within {LATEST_S:.0e} of zero, found {quoted(text)}"
        raise line_error(path, line, problem)
    return int(Decimal(text).scaleb(9))


def _parse_nanoseconds(path: Path, line: int, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) < 2**63):
        raise line_error(path, line, f"expected a time in whole nanoseconds, found {quoted(text)}")
    return int(text)


def _stamps_ns(
    path: Path, lines: list[int], texts: list[str], parse: Callable[[Path, int, str], int]
) -> NDArray[np.int64]:
    """Times (n,) of lines; decreasing times are refused."""
    stamps = [parse(path, line, text) for line, text in zip(lines, texts, strict=True)]
    for row in range(1, len(stamps)):
        if stamps[row] < stamps[row - 1]:
            before = f"time runs backwards from {texts[row - 1]} to {texts[row]}"
            raise line_error(path, lines[row], f"{before}, expected lines in order of time")
    return np.array(stamps, dtype=np.int64)


@dataclass(frozen=True)
class StampedLines:
    """Lines of a file that begin with a time, in order of time; equal times are allowed.

    Each has its line number from 1, its time in `stamps_ns` (T,), and the remaining text, split by `separator`.
    """

    path: Path
    lines: list[int]
    stamps_ns: NDArray[np.int64]
    rests: list[str]
    separator: str | None

    def files(self, folder: Path) -> list[Path]:
        """The remaining texts as files in a folder."""
        for line, rest in zip(self.lines, self.rests, strict=True):
            if not rest:
                raise line_error(self.path, line, "expected a time and the file of an image, found only a time")
        return [folder / rest for rest in self.rests]

    def table(self, columns: tuple[str, ...]) -> Table:
        """The remaining texts as numbers; further columns are ignored."""
        cut = ((self.separator or " ").join(rest.split(self.separator)[: len(columns)]) for rest in self.rests)
        return parse_table(self.path, columns, zip(self.lines, cut, strict=True), self.separator)


def read_stamped(path: Path, hint: str, nanoseconds: bool = False) -> StampedLines:
    """Lines that start with a time; lines that start with # are comments.

    Args:
        path: the file.
        hint: describes the expected file, for messages.
        nanoseconds: whether times are whole nanoseconds and columns separated by commas; else they are seconds, of which
            digits beyond nanoseconds are dropped, and columns are separated by whitespace.
    """
    separator, parse = (",", _parse_nanoseconds) if nanoseconds else (None, parse_time)
    kept = [(line, text.split(separator, 1)) for line, text in numbered_lines(path, hint)]
    if not kept:
        raise InputError(f"{path}: expected lines that begin with a time, found none.")
    lines, texts = [line for line, _ in kept], [parts[0].strip() for _, parts in kept]
    rests = ["".join(parts[1:]).strip() for _, parts in kept]
    stamps_ns = _stamps_ns(path, lines, texts, parse)
    if nanoseconds and 0.0 < (gap_s := _median_gap_s(stamps_ns)) < SHORTEST_GAP_S:
        raise InputError(f"{path}: times are {1e9 * gap_s:.0f} apart, too little: write them in nanoseconds.")
    return StampedLines(path, lines, stamps_ns, rests, separator)


def require_seconds(path: Path, stamps_ns: NDArray[np.int64], rows: str, rate_hz: float | None = None) -> None:
    """Refuses times (n,) of a file's `rows` that are probably in milliseconds, or smaller units.

    Only the interval distinguishes them from a time lapse, which therefore has to state its rate.
    """
    gap_s = _median_gap_s(stamps_ns)
    if gap_s > LONGEST_GAP_S and not (rate_hz and gap_s * rate_hz < OFF_RATE):
        stated = f", {1.0 / rate_hz:.3g} by the rate_hz stated" if rate_hz else ""
        lapse = "; if they are right, state rate_hz in camera.yaml" if rows == "images" else ""
        raise InputError(f"{path}: the {rows} are {gap_s:,.0f} s apart{stated}: write times in seconds{lapse}.")


def _median_gap_s(stamps_ns: NDArray[np.int64]) -> float:
    return 1e-9 * float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
