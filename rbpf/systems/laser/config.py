"""Every setting of a run with a laser scanner, with its default, its unit and what it does."""

from dataclasses import dataclass, field

import numpy as np

from rbpf.maps.grid import GridConfig
from rbpf.ranges import Count, NotNegative, Positive, Ranged
from rbpf.systems.filtering import RunConfig


@dataclass(frozen=True)
class MotionConfig(Ranged):
    """How uncertain the motion between two scans is before the scanner is asked; standard deviations, those of GMapping."""

    shift_per_m: NotNegative = 0.1  #: of the shift, m per metre driven.
    shift_per_rad: NotNegative = 0.2  #: of the shift, m per radian turned.
    turn_per_m: NotNegative = 0.1  #: of the turn, rad per metre driven.
    turn_per_rad: NotNegative = 0.2  #: of the turn, rad per radian turned.
    shift_m: Positive = 0.01  #: of the shift, at rest too.
    turn_rad: Positive = 0.01  #: of the turn, at rest too.
    speed_m_s: Positive = 0.5  #: of the change of speed, m/s, where without odometry the motion goes on as before.
    speed_rad_s: Positive = 0.5  #: of the change of turning rate, rad/s, likewise.
    #: odometry that says more than this, m/s or rad/s, jumps: it is taken for none.
    fastest: Positive = 10.0

    def cov(self, way_m: float, turned_rad: float) -> np.ndarray:
        """(3, 3) of a motion of such a length, in its right chart, [ω, v]."""
        turn = self.turn_per_m * way_m + self.turn_per_rad * turned_rad
        shift = self.shift_per_m * way_m + self.shift_per_rad * turned_rad
        return np.diag(np.square([turn, shift, shift]) + np.square([self.turn_rad, self.shift_m, self.shift_m]))

    def cov_without(self, seconds: float) -> np.ndarray:
        """The same of a motion that nothing measured."""
        turn, shift = self.speed_rad_s * seconds + self.turn_rad, self.speed_m_s * seconds + self.shift_m
        return np.diag(np.square([turn, shift, shift]))


@dataclass(frozen=True)
class LaserConfig(RunConfig):
    """A run of grid SLAM with a laser scanner."""

    particles: Count = 30  #: number of particles.
    #: a scan is matched and written when the robot has moved so far since the last one that was (0: every scan); in
    #: between the odometry says where it is.
    distance_m: NotNegative = 0.5
    angle_rad: NotNegative = 0.25  #: or when it has turned so far.
    seconds: Positive = 10.0  #: or when so much time has gone.
    #: length of wall that counts as one measurement, see `rbpf.sensors.laser.Scanner.beams`.
    correlation_m: Positive = 0.25
    least_beams: Count = 10  #: a scan with fewer returns is not used.
    grid: GridConfig = field(default_factory=GridConfig)  #: cells and likelihood.
    motion: MotionConfig = field(default_factory=MotionConfig)  #: noise of the odometry.
