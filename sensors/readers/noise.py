"""Standard deviations that a caller puts in place of those of the log."""

import math
from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.sensors.readers.table import LARGEST, Table

_MAY_BE_ZERO = {"std_speed_mps", "std_turn_rate_radps", "scale_odometry"}


@dataclass(frozen=True)
class LogNoise:
    """Noise of a log; None takes what the log says, or the reader's documented default where it says nothing.

    Attributes:
        std_range_m: of a measured range [m].
        std_bearing_rad: of a measured bearing (yaw) [rad].
        std_pitch_rad: of a measured pitch [rad].
        std_speed_mps: of the forward speed, white noise: its density [m/s per root hertz].
        std_turn_rate_radps: of the turn rate, white noise: its density [rad/s per root hertz].
        std_position_m: of each coordinate of a measured position [m].
        scale_odometry: multiplies the odometry's standard deviations.
    """

    std_range_m: float | None = None
    std_bearing_rad: float | None = None
    std_pitch_rad: float | None = None
    std_speed_mps: float | None = None
    std_turn_rate_radps: float | None = None
    std_position_m: float | None = None
    scale_odometry: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: one is not finite, or negative, or zero where only a positive one makes sense.
        """
        for name, value in self.given().items():
            zero = name in _MAY_BE_ZERO
            if not (math.isfinite(value) and abs(value) <= LARGEST and (value > 0 or (zero and value == 0))):
                expected = f"{'zero or ' if zero else ''}positive and at most {LARGEST:.0e}"
                raise InputError(f"LogNoise: expected {name} to be {expected}, found {value}.")

    def require_only(self, applicable: Collection[str], path: Path, kind: str) -> None:
        """Refuse what would have no effect.

        Args:
            applicable: names of the fields that the log can use.
            path: where the log lies.
            kind: what the log is, for the message.

        Raises:
            InputError: another field is given.
        """
        for name in self.given():
            if name not in applicable:
                choice = ", ".join(sorted(applicable))
                raise InputError(f"{path}: {name} has no effect on {kind}; leave it out (it takes {choice}).")

    def odometry_variance_factor(self) -> float:
        """Factor of the odometry's covariance."""
        return 1.0 if self.scale_odometry is None else self.scale_odometry**2

    def given(self) -> dict[str, float]:
        """The fields that are not None."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


def standard_deviations(table: Table, column: str, given: float | None) -> Array:
    """(n,) a column of standard deviations, or the given one in its place.

    Raises:
        InputError: the column holds a negative one, or a zero and nothing is given in its place.
    """
    if given is None:
        table.require(table[column] > 0, column, "positive")
        return table[column]
    table.require(table[column] >= 0, column, "zero or positive")
    return np.full(len(table.rows), given)
