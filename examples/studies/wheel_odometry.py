"""`odometry.csv` and `odometry.yaml`: a robot's wheel odometry along with a sequence of images.

odometry.csv, one line per reading in order of time, comma-separated, lines that start with # are comments:

    #stamp_ns,dx_m,dy_m,dyaw_rad,sigma_x_m,sigma_y_m,sigma_yaw_rad
    1400000000000000000,0,0,0,0,0,0
    1400000000066666667,0.0179,0.0001,0.0052,0.0005,0.0001,0.0019

`dx_m`, `dy_m`, `dyaw_rad` are the motion since the line before, in the robot's frame there: x forwards, y to the left,
yaw to the left; on the first line they are zero. The sigmas are the standard deviations of its random errors, without
systematic errors such as wrong wheel diameters.

odometry.yaml has the camera's pose on the robot:

    robot_from_camera: [qx, qy, qz, qw, x, y, z]   # unit quaternion; m
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbpf.lie import SE2, SE3
from rbpf.runs.files import write_csv, write_text
from rbpf.sensors.readers.text import read_stamped
from rbpf.sensors.readers.yaml_files import read_yaml
from rbpf.validation.simulation.laser import dead_reckoning

NAME, MOUNT = "odometry.csv", "odometry.yaml"
KIND = "the readings of a robot's wheels"

MOTION = ("dx_m", "dy_m", "dyaw_rad")
SIGMA = ("sigma_x_m", "sigma_y_m", "sigma_yaw_rad")

UNIT = 1e-6  #: Tolerance of a quaternion's norm.


@dataclass(frozen=True)
class WheelOdometry:
    """Readings of a robot's wheels."""

    stamps_ns: np.ndarray  #: (T,) int64 times, strictly ascending.
    #: (T - 1, 3) motions between consecutive times, elements of SE(2): [theta, x, y] in the robot's frame.
    delta: np.ndarray
    std: np.ndarray  #: (T - 1, 3) standard deviations of theta [rad], x and y [m].
    robot_from_camera: np.ndarray  #: (7,) pose of the left camera on the robot.

    def world_from_robot(self) -> np.ndarray:
        """(T, 3) dead reckoning: elements of SE(2), the first the identity."""
        return dead_reckoning(self.delta)

    def world_from_camera(self, start: np.ndarray) -> np.ndarray:
        """(T, 7) dead reckoning of the camera in space, from its first pose (7,)."""
        theta, x, y = self.world_from_robot().T
        still = np.zeros_like(theta)
        first_from_robot = SE3.from_ypr(np.stack([x, y, still], axis=-1), theta, still, still)
        world_from_first = SE3.compose(start, SE3.inverse(self.robot_from_camera))
        return SE3.compose(world_from_first, SE3.compose(first_from_robot, self.robot_from_camera))


def read_wheel_odometry(folder: str | Path) -> WheelOdometry:
    """Reads `odometry.csv` and `odometry.yaml` in a folder.

    Raises InputError: a file is missing or not as described above.
    """
    path = Path(folder) / NAME
    rows = read_stamped(path, KIND, nanoseconds=True)
    table = rows.table(MOTION + SIGMA)
    later = np.diff(rows.stamps_ns) > 0
    if not later.all():
        raise table.error(int(np.argmin(later)) + 1, "expected a later time than on the line before")
    for name in SIGMA:
        table.require(table[name] >= 0.0, name, "zero or positive")
    motion = table.block(MOTION[0], MOTION[-1])
    if motion[0].any():
        raise table.error(0, "expected no motion on the first line, before which there is none")
    delta = SE2.normalise(np.roll(motion[1:], 1, axis=1))
    std = np.roll(table.block(SIGMA[0], SIGMA[-1])[1:], 1, axis=1)
    file = read_yaml(Path(folder) / MOUNT, "where the camera stands on the robot")
    mount = file.entries(["robot_from_camera"])["robot_from_camera"]
    pose = np.array([item.number() for item in mount.items(7)])
    if abs(np.linalg.norm(pose[:4]) - 1.0) > UNIT:
        raise mount.error("expected robot_from_camera to begin with a unit quaternion")
    return WheelOdometry(rows.stamps_ns, delta, std, np.asarray(SE3.normalise(pose)))


def write_wheel_odometry(folder: Path, odometry: WheelOdometry) -> None:
    """Writes odometry.csv and odometry.yaml, as described above."""
    table = np.roll(np.hstack([odometry.delta, odometry.std]).reshape(-1, 2, 3), -1, axis=2).reshape(-1, 6)
    rows = [[0.0] * 6, *table.tolist()]
    numbers = [[f"{x:.9g}" for x in row] for row in rows]
    header = ["#stamp_ns", *MOTION, *SIGMA]
    stamped = zip(odometry.stamps_ns.tolist(), numbers, strict=True)
    write_csv(folder / NAME, header, ([stamp, *row] for stamp, row in stamped))
    write_text(folder / MOUNT, f"robot_from_camera: {odometry.robot_from_camera.tolist()}\n")
