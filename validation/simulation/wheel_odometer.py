"""Simulates what the wheels of a robot say about its motion, with the errors that wheels have."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.runs.files import write_csv, write_text
from rbpf.sensors.readers.wheel_odometry import MOTION, MOUNT, NAME, SIGMA, WheelOdometry
from rbpf.validation.simulation.driven_paths import Travelled
from rbpf.validation.simulation.limits import check_not_negative, check_positive


@dataclass(frozen=True)
class WheelOdometer:
    """Two driven wheels side by side, whose turns are counted.

    Wrong diameters and a wrong distance between the wheels err the same way all the time (J. Borenstein, L. Feng,
    Measurement and correction of systematic odometry errors in mobile robots, 1996); slip is a random walk whose
    variance grows with the way of each wheel (K. S. Chong, L. Kleeman, Accurate odometry and error modelling for a
    mobile robot, 1997).

    Attributes:
        wheelbase_m: true distance between the wheels.
        scale: both wheels report so much more than they went, as a fraction.
        inequality: the right one reports so much more than the left one, as a fraction: a drift of the heading.
        wheelbase_error: the robot takes the distance between its wheels for so much greater, as a fraction.
        slip_m: standard deviation of a wheel's error after 1 m, in m; it grows with the root of the way.

    Raises:
        InputError: a number makes no sense.
    """

    wheelbase_m: float = 0.4
    scale: float = 0.01
    inequality: float = 0.002
    wheelbase_error: float = 0.02
    slip_m: float = 0.004

    def __post_init__(self) -> None:
        check_positive(self, "wheelbase_m")
        check_not_negative(self, "slip_m")
        for name in ("scale", "inequality", "wheelbase_error"):
            if not abs(getattr(self, name)) < 0.5:
                raise InputError(f"{name} must be between -0.5 and 0.5, got {getattr(self, name)!r}")

    def measure(
        self,
        travelled: Travelled,
        stamps_ns: np.ndarray,
        robot_from_camera: np.ndarray,
        rng: np.random.Generator,
    ) -> WheelOdometry:
        """Readings of a drive.

        Args:
            travelled: the robot at T times.
            stamps_ns: (T,) int64 these times.
            robot_from_camera: (7,) passed on.
            rng: generator of the slip; more times leave the first readings as they are.
        """
        side = 0.5 * self.wheelbase_m * np.array([-1.0, 1.0])
        way = np.diff(travelled.way_m[:, None] + travelled.heading_rad[:, None] * side, axis=0)
        counted = way * (1.0 + self.scale + 0.5 * self.inequality * np.array([-1.0, 1.0]))
        counted += self.slip_m * np.sqrt(np.abs(way)) * rng.standard_normal(way.shape)
        base = self.wheelbase_m * (1.0 + self.wheelbase_error)
        forward, turn = counted.mean(axis=1), (counted[:, 1] - counted[:, 0]) / base
        delta = SE2.exp(np.stack([turn, forward, np.zeros_like(turn)], axis=-1))
        spread = self.slip_m * np.sqrt(np.abs(counted).sum(axis=1))
        std = np.stack([spread / base, 0.5 * spread, 0.5 * np.abs(forward) * spread / base], axis=-1)
        return WheelOdometry(stamps_ns, delta, std, robot_from_camera)


def write_wheel_odometry(folder: Path, odometry: WheelOdometry) -> None:
    """odometry.csv and odometry.yaml, as `rbpf.sensors.readers.wheel_odometry` describes them."""
    table = np.roll(np.hstack([odometry.delta, odometry.std]).reshape(-1, 2, 3), -1, axis=2).reshape(-1, 6)
    rows = [[0.0] * 6, *table.tolist()]
    numbers = [[f"{x:.9g}" for x in row] for row in rows]
    header = ["#stamp_ns", *MOTION, *SIGMA]
    stamped = zip(odometry.stamps_ns.tolist(), numbers, strict=True)
    write_csv(folder / NAME, header, ([stamp, *row] for stamp, row in stamped))
    write_text(folder / MOUNT, f"robot_from_camera: {odometry.robot_from_camera.tolist()}\n")
