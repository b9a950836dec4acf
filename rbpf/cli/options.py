"""Options shared by several commands; the comment of a field is its help text."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import tyro

from rbpf.errors import InputError
from rbpf.ranges import MOST, Range

if TYPE_CHECKING:
    from rbpf.sensors.calibration import Board

Flag = tyro.conf.FlagCreatePairsOff[bool]

# Optional values, whose default is described in the help text. For `int | None` the parser would use typeguard,
# whose import takes longer than NumPy's.
Whole = Annotated[Optional[int], tyro.conf.arg(metavar="INT", help_behavior_hint="")]
Real = Annotated[Optional[float], tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]
WholeCount = Annotated[Whole, Range(ge=1, le=MOST)]
RealPositive = Annotated[Real, Range(gt=0.0)]
Text = Annotated[Optional[str], tyro.conf.arg(metavar="STR", help_behavior_hint="")]
Where = Annotated[Optional[Path], tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
MOST_PX = 1 << 15  #: Largest side of an image.


@dataclass(frozen=True, kw_only=True)
class Printed:
    """Option of every command with a result."""

    json: Flag = False  #: print the result as one JSON object on standard output, for programs.


def given_board(size: str | None, square_m: float | None) -> "Board | None":
    """The chessboard of `--board` and `--square`."""
    if size is None and square_m is None:
        return None
    if size is None or square_m is None:
        raise InputError("a chessboard needs its inner corners and the side of its squares: --board 9x6 --square 0.024")
    from rbpf.sensors.calibration import Board

    return Board.parse(size, square_m)
