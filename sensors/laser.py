"""A laser scanner in the plane, and a recording of one."""

from dataclasses import dataclass, field

import numpy as np

from rbpf.arrays import Float, Int
from rbpf.errors import InputError
from rbpf.lie import SE2


@dataclass(frozen=True)
class Scanner:
    """Where each beam points and how far it reaches. Raises InputError: an array or a range does not fit."""

    #: (B,) of the beams, counterclockwise in the scanner's frame, whose x axis points forward [rad].
    angles: Float[np.ndarray, " B"]
    min_range_m: float = 0.0  #: what is nearer is the robot itself.
    max_range_m: float = 30.0  #: what is farther gives no return.
    #: (E,) element of SE2: where the scanner sits on the robot.
    robot_from_sensor: Float[np.ndarray, " E"] = field(default_factory=SE2.identity)

    def __post_init__(self) -> None:
        if self.angles.ndim != 1 or not self.angles.size or not np.isfinite(self.angles).all():
            raise InputError(f"a scanner needs the angles of its beams, finite numbers (B,), got {self.angles.shape}")
        if not 0.0 <= self.min_range_m < self.max_range_m < np.inf:
            raise InputError(
                f"a scanner's ranges must be 0 <= min < max < inf, got {self.min_range_m} m to {self.max_range_m} m"
            )
        if self.robot_from_sensor.shape != (SE2.size,) or not np.isfinite(self.robot_from_sensor).all():
            raise InputError(f"robot_from_sensor must be ({SE2.size},) finite numbers: {self.robot_from_sensor}")


@dataclass(frozen=True)
class LaserLog:
    """A recording of a scanner on a robot."""

    name: str
    scanner: Scanner
    stamps_ns: Int[np.ndarray, " T"]  #: (T,) times of the scans, ascending.
    #: (T, B) [m]; inf where nothing came back within `max_range_m`, NaN where the reading is not valid.
    ranges: Float[np.ndarray, "T B"]
    #: (T, E) world_from_robot by odometry, elements of SE2; None where the log has none.
    odometry: Float[np.ndarray, "T E"] | None = None
