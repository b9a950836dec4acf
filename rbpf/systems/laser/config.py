"""Every setting of a run with a laser scanner, with its default, its unit and what it does."""

from dataclasses import dataclass, field

import numpy as np

from rbpf.maps.grid import GridConfig
from rbpf.ranges import Count, NotNegative, Positive, Ranged
from rbpf.systems.filtering import RunConfig


@dataclass(frozen=True)
class MotionConfig(Ranged):
    """Motion noise between two scans before scan matching; standard deviations, defaults of GMapping."""

    shift_per_m: NotNegative = 0.1  #: of the translation, m per metre driven.
    shift_per_rad: NotNegative = 0.2  #: of the translation, m per radian turned.
    turn_per_m: NotNegative = 0.1  #: of the rotation, rad per metre driven.
    turn_per_rad: NotNegative = 0.2  #: of the rotation, rad per radian turned.
    shift_m: Positive = 0.01  #: of the translation, also at rest.
    turn_rad: Positive = 0.01  #: of the rotation, also at rest.
    speed_m_s: Positive = 0.5  #: of the change of speed, m/s, without odometry (constant velocity).
    speed_rad_s: Positive = 0.5  #: of the change of the turn rate, rad/s, likewise.
    #: faster odometry, m/s or rad/s, is a jump and ignored.
    fastest: Positive = 10.0

    def cov(self, way_m: float, turned_rad: float) -> np.ndarray:
        """(3, 3) of a motion of such a length, in its right chart, [ω, v]."""
        turn = self.turn_per_m * way_m + self.turn_per_rad * turned_rad
        shift = self.shift_per_m * way_m + self.shift_per_rad * turned_rad
        return np.diag(np.square([turn, shift, shift]) + np.square([self.turn_rad, self.shift_m, self.shift_m]))

    def cov_without(self, seconds: float) -> np.ndarray:
        """The same for a motion without odometry."""
        turn, shift = self.speed_rad_s * seconds + self.turn_rad, self.speed_m_s * seconds + self.shift_m
        return np.diag(np.square([turn, shift, shift]))


@dataclass(frozen=True)
class LaserConfig(RunConfig):
    """A run of grid SLAM with a laser scanner."""

    particles: Count = 30  #: number of particles.
    #: a scan is matched and inserted once the robot has moved this far since the last one (0: every scan); in between, the
    #: pose follows the odometry.
    distance_m: NotNegative = 0.5
    angle_rad: NotNegative = 0.25  #: likewise once it has turned by this.
    seconds: Positive = 10.0  #: likewise after this time.
    #: length of wall that counts as one measurement, see `rbpf.sensors.laser.Scanner.beams`.
    correlation_m: Positive = 0.25
    least_beams: Count = 10  #: a scan with fewer returns is not used.
    grid: GridConfig = field(default_factory=GridConfig)  #: cells and likelihood.
    motion: MotionConfig = field(default_factory=MotionConfig)  #: noise of the odometry.
