"""A text file of named values, `# name: value`, above comma-separated rows whose number the header tells."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self, final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.sensors.readers.table import parse_number
from rbpf.sensors.readers.text import line_error, quoted, read_lines

_WHOLE = re.compile(r"[+-]?\d{1,19}", re.ASCII)
_INT64 = np.iinfo(np.int64)


@final
@dataclass(frozen=True)
class HeadedTable:
    """Lines of such a file, checked as they are asked for; every method raises InputError at a malformed one.

    Attributes:
        path: the file.
        header: line number and text of each named value.
        columns: the line with the columns' names.
        columns_line: its number, from 1.
        rows: the lines below it.
    """

    path: Path
    header: dict[str, tuple[int, str]]
    columns: str
    columns_line: int
    rows: list[str]

    @classmethod
    def read(cls, path: Path, title: str, hint: str) -> Self:
        """Read a file whose first line is `# title`; `hint` says what is expected to lie there."""
        lines = read_lines(path, hint)
        if lines[0] != f"# {title}":
            raise line_error(path, 1, f"expected '# {title}', found {quoted(lines[0])}")
        header: dict[str, tuple[int, str]] = {}
        for number, line in enumerate(lines[1:], 2):
            if not line.startswith("#"):
                return cls(path, header, line, number, lines[number:])
            key, _, value = line.removeprefix("#").partition(":")
            header[key.strip()] = (number, value.strip())
        raise line_error(path, len(lines), "expected the columns' names below, found the file's end")

    def text(self, key: str) -> str:
        """Named value."""
        return self._entry(key)[1]

    def choice(self, key: str, allowed: Sequence[str]) -> str:
        """Named value that is one of several."""
        if self.text(key) not in allowed:
            problem = f"expected {key} to be {' or '.join(allowed)}, found {quoted(self.text(key))}"
            raise self.header_error(key, problem)
        return self.text(key)

    def whole(self, key: str) -> int:
        """Named whole number."""
        line, text = self._entry(key)
        return self._whole(line, key, text)

    def numbers(self, key: str, count: int) -> Array:
        """Named numbers, (count,)."""
        line, text = self._entry(key)
        fields = text.split()
        if len(fields) != count:
            raise self.header_error(key, f"expected {count} numbers for {key}, found {len(fields)}")
        return np.array([parse_number(self.path, line, key, field) for field in fields])

    def body(self, names: Sequence[str], whole: int) -> tuple[NDArray[np.int64], Array]:
        """The first `whole` columns (n, whole), which are whole numbers, and the others (n, k)."""
        if self.columns != ",".join(names):
            problem = f"expected the columns {','.join(names)}, found {quoted(self.columns)}"
            raise line_error(self.path, self.columns_line, problem)
        count = self.whole("rows")
        if count != len(self.rows):
            problem = f"expected {count} rows as the header says, found {len(self.rows)}; copy the file again"
            raise self.row_error(len(self.rows) - 1, problem)
        integers = np.empty((count, whole), dtype=np.int64)
        numbers = np.empty((count, len(names) - whole))
        for row in range(count):
            fields = list(zip(names, self._split(row, names), strict=True))
            integers[row] = [self._whole(self._line(row), *field) for field in fields[:whole]]
            numbers[row] = [parse_number(self.path, self._line(row), *field) for field in fields[whole:]]
        return integers, numbers

    def require(self, valid: NDArray[np.bool_], expected: str) -> None:
        """Refuse the first row where `valid` (n,) is False."""
        if not valid.all():
            raise self.row_error(int(np.argmin(valid)), f"expected {expected}")

    def header_error(self, key: str, problem: str) -> InputError:
        """Error that points at a named value."""
        return line_error(self.path, self._entry(key)[0], problem)

    def row_error(self, row: int, problem: str) -> InputError:
        """Error that points at a row, counted from 0."""
        return line_error(self.path, self._line(row), problem)

    def _entry(self, key: str) -> tuple[int, str]:
        if key not in self.header:
            problem = f"expected a line '# {key}: ...' above this one, found none"
            raise line_error(self.path, self.columns_line, problem)
        return self.header[key]

    def _line(self, row: int) -> int:
        return self.columns_line + 1 + row

    def _split(self, row: int, names: Sequence[str]) -> list[str]:
        fields = self.rows[row].split(",")
        if len(fields) != len(names):
            problem = f"expected {len(names)} columns ({', '.join(names)}), found {len(fields)}"
            raise self.row_error(row, problem)
        return fields

    def _whole(self, line: int, name: str, text: str) -> int:
        if not _WHOLE.fullmatch(text) or not _INT64.min <= int(text) <= _INT64.max:
            raise line_error(self.path, line, f"expected {name} to be a whole number, found {quoted(text)}")
        return int(text)
