"""Strict reading of tables of numbers.

Numbers are decimal, finite and at most `LARGEST` in size, which keeps every product that a reader forms far
from overflow. The whole file goes through NumPy's parser; only when that refuses, or lets something
suspicious through, the lines are read one by one.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.sensors.readers.text import line_error, quoted, read_lines

LARGEST = 1e12
LATEST_S = 4e9

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_TIME = re.compile(r"([+-]?\d{0,10})(?:\.(\d*))?", re.ASCII)
_PLAIN = dict.fromkeys(map(ord, "0123456789+-.eE \t,"))


@dataclass(frozen=True)
class Table:
    """Rows of numbers and where they stand in their file.

    Attributes:
        path: the file.
        columns: name of each column.
        rows: the text of each row.
        lines: line number of each row, from 1.
        values: (n, len(columns)) numbers.
    """

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
        """Refuse the first row where `valid` (n,) is False.

        Raises:
            InputError: names the row's line, the column, what was expected and what was found.
        """
        if not valid.all():
            row = int(np.argmin(valid))
            raise self.error(row, f"expected {column} to be {expected}, found {self[column][row]:.12g}")

    def integers(self, column: str) -> NDArray[np.int64]:
        """(n,) a column of whole numbers.

        Raises:
            InputError: a number has a fraction.
        """
        self.require(self[column] == np.floor(self[column]), column, "a whole number")
        return self[column].astype(np.int64)

    def names(self, column: str) -> NDArray[np.int64]:
        """(n,) a column of whole numbers that must differ from one another.

        Raises:
            InputError: a number has a fraction or comes twice.
        """
        names = self.integers(column)
        _, first = np.unique(names, return_index=True)
        if len(first) < len(names):
            row = int(np.setdiff1d(np.arange(len(names)), first)[0])
            raise self.error(row, f"{column} {names[row]} comes a second time, expected it once")
        return names

    def stamps_ns(self) -> NDArray[np.int64]:
        """(n,) the first column, times in seconds, as nanoseconds; digits beyond these are dropped.

        The decimal text is converted, not its rounded float.

        Raises:
            InputError: a time is no plain decimal, too large, or earlier than the one before it.
        """
        column = self.columns[0]
        self.require(np.abs(self[column]) <= LATEST_S, column, f"within {LATEST_S:.0e} s of zero")
        stamps = np.array([self._stamp_ns(i, row.split(None, 1)[0]) for i, row in enumerate(self.rows)])
        later = np.diff(stamps) >= 0
        if not later.all():
            row = int(np.argmin(later)) + 1
            before, now = (self.rows[i].split(None, 1)[0] for i in (row - 1, row))
            raise self.error(row, f"time runs backwards from {before} to {now}, expected rows in order")
        return stamps

    def _stamp_ns(self, row: int, text: str) -> int:
        match = _TIME.fullmatch(text)
        if match is None:
            raise self.error(row, f"expected a time such as 1248444175.103, found {quoted(text)}")
        seconds, fraction = match.groups(default="")
        return int(seconds + fraction[:9].ljust(9, "0"))


def read_columns(path: Path, columns: tuple[str, ...], hint: str = "") -> Table:
    """File of blank-separated columns; lines that start with # are comments.

    Raises:
        InputError: the file or a line is not as expected.
    """
    numbered = enumerate(read_lines(path, hint), 1)
    rows = [(i, line) for i, line in numbered if not line.lstrip().startswith("#")]
    return parse_table(path, columns, rows)


def read_csv(path: Path, headers: Sequence[tuple[str, ...]], hint: str = "") -> Table:
    """File of comma-separated columns under a header line.

    Args:
        path: the file.
        headers: the headers allowed; the table's columns tell which one was found.
        hint: what is expected to lie there, for the message.

    Raises:
        InputError: the file, its header or a line is not as expected.
    """
    lines = read_lines(path, hint)
    found = tuple(name.strip() for name in lines[0].split(","))
    if found not in headers:
        allowed = " or ".join(repr(",".join(header)) for header in headers)
        raise line_error(path, 1, f"expected the header {allowed}, found {quoted(lines[0])}")
    return parse_table(path, found, enumerate(lines[1:], 2), ",")


def parse_table(
    path: Path, columns: tuple[str, ...], numbered: Iterable[tuple[int, str]], separator: str | None = None
) -> Table:
    """Numbers in numbered lines; blank lines are passed over.

    Args:
        path: the file that the lines come from.
        columns: name of each column.
        numbered: line number and text of each line.
        separator: what separates columns, None for blanks.

    Raises:
        InputError: there is no row, or one has another number of columns or something that is no number.
    """
    filled = [(number, line) for number, line in numbered if line.strip()]
    if not filled:
        raise InputError(f"{path}: expected rows of {_listed(columns)}, found none.")
    lines, rows = ([number for number, _ in filled], [line for _, line in filled])
    values = _parse_fast(rows, separator)
    if values is None or values.shape != (len(rows), len(columns)) or not (np.abs(values) <= LARGEST).all():
        values = np.array([_parse_row(path, i, row, columns, separator) for i, row in filled])
    return Table(path, columns, rows, lines, values)


def _parse_fast(rows: list[str], separator: str | None) -> Array | None:
    # Other characters (nan, 0x1p3, quotes) mean something to NumPy that is no number here.
    if "".join(rows).translate(_PLAIN):
        return None
    try:
        return np.loadtxt(rows, comments=None, delimiter=separator, ndmin=2)
    except ValueError:
        return None


def _parse_row(
    path: Path, line: int, row: str, columns: tuple[str, ...], separator: str | None
) -> list[float]:
    fields = [field.strip() for field in row.split(separator)]
    if len(fields) != len(columns):
        problem = f"expected {len(columns)} columns ({_listed(columns)}), found {len(fields)}"
        raise line_error(path, line, problem)
    return [parse_number(path, line, *item) for item in zip(columns, fields, strict=True)]


def parse_number(path: Path, line: int, column: str, field: str) -> float:
    """Number in a field.

    Args:
        path: the file.
        line: line number, from 1.
        column: name of the number, for the message.
        field: the text.

    Raises:
        InputError: the text is no finite decimal number, or a larger one than `LARGEST`.
    """
    if not _NUMBER.fullmatch(field):
        raise line_error(path, line, f"expected {column} to be a finite number, found {quoted(field)}")
    value = float(field)
    if not abs(value) <= LARGEST:
        problem = f"expected {column} to be at most {LARGEST:.0e} in size, found {quoted(field)}"
        raise line_error(path, line, problem)
    return value


def _listed(columns: tuple[str, ...]) -> str:
    return ", ".join(columns)
