"""`known_points.csv`: landmarks of known position and their pixels in the first image.

    id,u_px,v_px,x_m,y_m,z_m,sigma_m
    1,517.426,320.498,-0.25433,0.12486,1.60044,0.0365

sigma_m is the standard deviation of the position as a whole, the root of its covariance's trace: the root mean square
distance from the true point. A further column across_m is the standard deviation along each axis perpendicular to the line
of sight of the first image: sigma_m / √3 for surveyed points, whose errors are isotropic. Columns may be in any order;
others are ignored.
Pixel centres are at whole numbers.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbpf.core.checkpoint import integers, numbers, require
from rbpf.errors import InputError
from rbpf.sensors.readers.text import line_error, numbered_lines, parse_table, quoted

COLUMNS, ACROSS = ("id", "u_px", "v_px", "x_m", "y_m", "z_m", "sigma_m"), "across_m"
ROUNDED = 0.01  #: Tolerance of a variance for rounding of the table's numbers, relative.


@dataclass(frozen=True)
class KnownPixels:
    """Landmarks of known position and their pixels in the first image.

    Raises InputError: a shape is wrong, a number is not finite, or a standard deviation is negative.
    """

    names: np.ndarray  #: (M,) int64, each once.
    px: np.ndarray  #: (M, 2) pixels in the first image as it is stored (distorted).
    positions: np.ndarray  #: (M, 3) in the world, m.
    std_m: np.ndarray  #: (M,) standard deviation of each position as a whole, the root of its covariance's trace, m.
    #: the positions are in a frame of the points' own, such as a chessboard's, unrelated to the recording's ground truth.
    own_frame: bool = False
    #: (M,) standard deviation along each axis across the line of sight, m; None: only the first image constrains them.
    across_m: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Validates the fields, as the points may be made by hand."""
        schema = {"names": integers("M"), "px": numbers("M", 2), "positions": numbers("M", 3)}
        stds = ("std_m",) if self.across_m is None else ("std_m", "across_m")
        require("the known points", vars(self), schema | dict.fromkeys(stds, numbers("M", least=0.0)))
        if self.across_m is not None and (2.0 * self.across_m**2 > self.std_m**2 * (1.0 + ROUNDED)).any():
            raise InputError(
                "the known points: across_m, along two axes, is more than the standard deviation as a whole"
            )


def read_known_points(path: str | Path) -> KnownPixels:
    """Read a table of known points.

    Raises InputError: the file or a column is missing, or a line is not as described above.
    """
    path = Path(path)
    rows = numbered_lines(path, f"a table with the columns {', '.join(COLUMNS)}")
    line, header = rows[0] if rows else (1, "")
    names = [name.strip() for name in header.split(",")]
    columns = (*COLUMNS, ACROSS) if ACROSS in names else COLUMNS
    if any(names.count(column) != 1 for column in columns):
        expected = f"expected a header with the columns {','.join(columns)}, each once"
        raise line_error(path, line, f"{expected}, found {quoted(header)}")
    picked = []
    for i, row in rows[1:]:
        fields = row.split(",")
        if len(fields) != len(names):
            raise line_error(path, i, f"expected {len(names)} columns as in the header, found {len(fields)}")
        picked.append((i, ",".join(fields[names.index(column)] for column in columns)))
    table = parse_table(path, columns, picked, ",")
    table.require(table["sigma_m"] >= 0.0, "sigma_m", "zero or positive")
    across = table[ACROSS] if ACROSS in columns else None
    if across is not None:
        fits = (across >= 0.0) & (2.0 * across**2 <= table["sigma_m"] ** 2 * (1.0 + ROUNDED))
        table.require(fits, ACROSS, "from 0 to sigma_m / √2")
    places = table.names("id"), table.block("u_px", "v_px"), table.block("x_m", "z_m"), table["sigma_m"]
    return KnownPixels(*places, across_m=across)
