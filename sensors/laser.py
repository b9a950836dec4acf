"""A planar laser scanner, its recordings, and the conversion of a scan to the beams of a grid map."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from rbpf.arrays import Float, Int
from rbpf.core.models import Belief, Observations, Part, Sensor
from rbpf.errors import InputError
from rbpf.lie import SE2


@dataclass(frozen=True)
class Scanner:
    """Directions and range limits of the beams. Raises InputError: an array or a range does not fit."""

    #: (B,) of the beams, counterclockwise in the scanner's frame, whose x axis points forward [rad].
    angles: Float[np.ndarray, " B"]
    min_range_m: float = 0.0  #: nearer readings are the robot itself.
    max_range_m: float = 30.0  #: beyond it there is no return.
    #: (E,) element of SE2, the scanner's mounting pose.
    robot_from_sensor: Float[np.ndarray, " E"] = field(default_factory=SE2.identity)

    def __post_init__(self) -> None:
        if self.angles.ndim != 1 or not self.angles.size or not np.isfinite(self.angles).all():
            raise InputError(f"a scanner needs the angles of its beams, finite numbers (B,), got {self.angles.shape}")
        if not 0.0 <= self.min_range_m < self.max_range_m < np.inf:
            raise InputError(f"ranges must be 0 <= min < max < inf, got {self.min_range_m} m to {self.max_range_m} m")
        if self.robot_from_sensor.shape != (SE2.size,) or not np.isfinite(self.robot_from_sensor).all():
            raise InputError(f"robot_from_sensor must be ({SE2.size},) finite numbers: {self.robot_from_sensor}")

    def beams(self, ranges: Float[np.ndarray, " B"], correlation_m: float) -> Float[np.ndarray, "K 5"]:
        """The beams with a return, in the robot's frame: start and end point [m], and weight.

        Neighbouring end points on one wall share the wall's error in the map: a stretch of `correlation_m` counts as one
        measurement. So the weight is the distance to the nearer neighbour over that length, 1 at most.

        Raises InputError: the numbers of readings and beams differ.
        """
        ranges = np.asarray(ranges, dtype=float)
        if ranges.shape != self.angles.shape:
            raise InputError(f"a scan of this scanner has {self.angles.size} readings, got {ranges.shape}")
        came_back = np.isfinite(ranges) & (ranges > self.min_range_m) & (ranges < self.max_range_m)
        angle, reach = self.angles[came_back], ranges[came_back]
        ends = SE2.transform(self.robot_from_sensor, reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        gaps = np.full(len(ends) + 1, np.inf)
        gaps[1:-1] = np.linalg.norm(np.diff(ends, axis=0), axis=1)
        weight = np.minimum(np.minimum(gaps[:-1], gaps[1:]) / correlation_m, 1.0)
        starts = np.broadcast_to(self.robot_from_sensor[1:], ends.shape)
        return np.ascontiguousarray(np.column_stack([starts, ends, weight]))


class Scan(NamedTuple):
    """A scan of a recording: time, ranges (B,), and world_from_robot (E,) by odometry, or None."""

    stamp_ns: int
    ranges: np.ndarray
    odometry: np.ndarray | None = None


@final
class BeamSensor(Sensor[np.ndarray]):
    """Passes a scan's beams (K, 5), see `Scanner.beams`, to the `Part` of the filter that reads them."""

    def __init__(self, reader: Part) -> None:
        self.reader = reader

    def observe(self, frame: np.ndarray, belief: Belief) -> Sequence[Observations]:
        # A weighted product of densities is not normalised.
        return [Observations.raw(frame, self.reader, normalised=False)]


@dataclass(frozen=True)
class LaserLog:
    """A recording of a scanner on a robot."""

    name: str
    scanner: Scanner
    stamps_ns: Int[np.ndarray, " T"]  #: (T,) times of the scans, ascending.
    #: (T, B) [m]; inf for no return within `max_range_m`, NaN for an invalid reading.
    ranges: Float[np.ndarray, "T B"]
    #: (T, E) world_from_robot by odometry, elements of SE2, or None.
    odometry: Float[np.ndarray, "T E"] | None = None

    @property
    def frames(self) -> list[Scan]:
        """The scans, one by one."""
        odometry = [None] * len(self.stamps_ns) if self.odometry is None else list(self.odometry)
        return [Scan(*scan) for scan in zip(self.stamps_ns.tolist(), self.ranges, odometry, strict=True)]
