"""A table of figures, printed and kept as CSV."""

from collections.abc import Sequence
from pathlib import Path

from rbpf.runs import files

Cell = str | int | float


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> None:
    """Writes rows as CSV, numbers with six digits; makes the folder."""
    files.prepare_folder(path.parent)
    files.write_csv(path, header, [[_text(cell, 6) for cell in row] for row in rows])


def write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> None:
    """Writes rows as CSV, and prints them in columns, numbers with three digits."""
    write_csv(path, header, rows)
    lines = [list(header), *([_text(cell, 3) for cell in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        first = line[0].ljust(widths[0])
        print("  ".join([first, *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))]))


def _text(cell: Cell, digits: int) -> str:
    if isinstance(cell, float):
        return f"{cell:.0f}" if 1000 <= abs(cell) < 1e6 else f"{cell:.{digits}g}"
    return str(cell)
