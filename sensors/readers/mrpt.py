"""Range-bearing logs in the tables that MRPT's simulated recordings are dumped to.

A folder with, comma-separated under a header line:

- `odometry.csv`, in the plane: step, dx_m, dy_m, dphi_rad, then the upper triangle of the covariance in this
  order (cxx, cxy, cxp, cyy, cyp, cpp); in space: step, dx_m, dy_m, dz_m, yaw_rad, pitch_rad, roll_rad, then
  the upper triangle cov00 to cov55. Row t moves the robot from step t - 1 to step t, in the frame of t - 1.
  The header tells the plane from space. Rotations are Rz(yaw) Ry(pitch) Rx(roll).
- `observations.csv`: step (from 0), landmark_id, range_m, yaw_rad, pitch_rad and their standard deviations.
  Without the column landmark_id, or where it is -1, it is not known which landmark was observed: for
  `--association ml`. Yaw is positive to the left. z is (range, yaw) in the plane, where pitch must be 0,
  and (range, yaw, pitch) in space.
- `sensor.yaml`: the sensor's mounting pose, and whether positive pitch is up or down, as in
  `robot_from_sensor: {x_m: 0, y_m: 0, z_m: 0, yaw_deg: 0, pitch_deg: 0, roll_deg: 0}`,
  `std: {range_m: 0.01, yaw_deg: 0.1}` and `positive_pitch: down`.
  `std` is optional and not read: every observation has its own standard deviations.
- `robot_path_groundtruth.csv` and `landmarks_groundtruth.csv`, if the truth is known: step, x_m, y_m, z_m,
  yaw_rad, pitch_rad, roll_rad (world_from_robot), and id, x_m, y_m, z_m.

A frame is a step, its stamp the step's number: steps 0 to the last one with an observation.
"""

from itertools import combinations_with_replacement
from pathlib import Path
from typing import final

import numpy as np

from rbpf.lie import SE2, SE3
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers import robot_log
from rbpf.sensors.readers.format import Format
from rbpf.sensors.readers.robot_log import UNNAMED, LogNoise, RobotLog, assemble
from rbpf.sensors.readers.text import read_csv
from rbpf.sensors.readers.yaml_files import read_yaml

#: Columns of the tables.
_POSE = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "roll_rad")
PLANAR = ("step", "dx_m", "dy_m", "dphi_rad", "cxx", "cxy", "cxp", "cyy", "cyp", "cpp")
_TRIANGLE = tuple(f"cov{i}{j}" for i, j in combinations_with_replacement(range(6), 2))
SPATIAL = ("step", "dx_m", "dy_m", "dz_m", *_POSE[3:], *_TRIANGLE)
_OBSERVATION = ("range_m", "yaw_rad", "pitch_rad", "std_range_m", "std_yaw_rad", "std_pitch_rad")
NAMED, ANONYMOUS = ("step", "landmark_id", *_OBSERVATION), ("step", *_OBSERVATION)
PATH, LANDMARKS = ("step", *_POSE), ("id", *_POSE[:3])
_MOUNT = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
_PITCH_SIGNS = {"up": 1.0, "down": -1.0}


@final
class Mrpt(Format[LogNoise, RobotLog]):
    """Range-bearing logs in MRPT's tables; ranges, bearings and pitches take the standard deviations given, if any."""

    kind = "an MRPT log (a folder with observations.csv, odometry.csv and sensor.yaml)"

    def recognises(self, path: Path) -> bool:
        return any((path / name).is_file() for name in ("observations.csv", "odometry.csv", "sensor.yaml"))

    def read(self, path: Path, noise: LogNoise) -> RobotLog:
        odometry = read_csv(path / "odometry.csv", [PLANAR, SPATIAL], self.kind)
        table = read_csv(path / "observations.csv", [NAMED, ANONYMOUS], self.kind)
        planar = odometry.columns == PLANAR
        applicable = ["std_range_m", "std_bearing_rad", "scale_odometry"] + ["std_pitch_rad"] * (not planar)
        noise.require_only(applicable, path, f"an MRPT log in {'the plane' if planar else 'space'}")
        # The sensor's mounting pose; in the plane its height is ignored.
        entries = read_yaml(path / "sensor.yaml", self.kind).entries(("robot_from_sensor", "positive_pitch"), ("std",))
        placed = entries["robot_from_sensor"].entries(_MOUNT, optional=())
        x, y, height, *angles = (placed[key].number() for key in _MOUNT)
        yaw, pitch, roll = np.deg2rad(angles)
        pitch_sign = _PITCH_SIGNS[entries["positive_pitch"].choice(tuple(_PITCH_SIGNS))]
        if planar and (pitch or roll):
            problem = "expected pitch_deg and roll_deg to be 0, as the odometry is planar"
            raise entries["robot_from_sensor"].error(problem)
        if planar:
            robot_from_sensor = SE2.normalise(np.array([yaw, x, y]))
            delta = SE2.normalise(np.roll(odometry.block("dx_m", "dphi_rad"), 1, axis=1))
            cov_delta = robot_log.planar_to_chart(delta, robot_log.read_covariances(odometry, "cxx", "cpp"))
        else:
            robot_from_sensor = SE3.from_ypr(np.array([x, y, height]), yaw, pitch, roll)
            ypr = odometry.block("yaw_rad", "roll_rad")
            delta = SE3.from_ypr(odometry.block("dx_m", "dz_m"), *ypr.T)
            cov_delta = robot_log.spatial_to_chart(delta, ypr, robot_log.read_covariances(odometry, "cov00", "cov55"))
        cov_delta *= noise.odometry_variance_factor()
        # Observations in steps that the odometry reaches, in order.
        counted = np.arange(1, len(odometry.rows) + 1)
        odometry.require(odometry["step"] == counted, "step", "one more than in the row before, from 1")
        step, named = table.integers("step"), "landmark_id" in table.columns
        landmarks = table.integers("landmark_id") if named else np.full(len(step), UNNAMED)
        last = counted[-1]
        table.require((step >= 0) & (step <= last), "step", f"one with odometry, 0 to {last}")
        ordered = np.diff(step, prepend=0) >= 0
        if not ordered.all():
            row = int(np.argmin(ordered))
            backwards = f"time runs backwards from step {step[row - 1]} to {step[row]}"
            raise table.error(row, f"{backwards}, expected rows in order")
        # A step may have several unnamed observations; here each counts as a landmark of its own.
        apart = np.where(landmarks == UNNAMED, UNNAMED - 1 - np.arange(len(step)), landmarks)
        if named:
            table.require(landmarks >= UNNAMED, "landmark_id", f"{UNNAMED} or the number of a landmark")
        table.require_distinct(step, apart, "step")
        # Measurements and their covariances.
        robot_log.require_ranges(table, "range_m", "yaw_rad")
        std = [
            robot_log.std_column(table, "std_range_m", noise.std_range_m),
            robot_log.std_column(table, "std_yaw_rad", noise.std_bearing_rad),
        ]
        if planar:
            table.require(table["pitch_rad"] == 0, "pitch_rad", "0, as the odometry is planar")
            table.require(table["std_pitch_rad"] >= 0, "std_pitch_rad", "zero or positive")
        else:
            table.require(np.abs(table["pitch_rad"]) <= np.pi / 2, "pitch_rad", "in radians, within a quarter turn")
            std.append(robot_log.std_column(table, "std_pitch_rad", noise.std_pitch_rad))
        z = table.block("range_m", "yaw_rad" if planar else "pitch_rad")
        frames = step[-1] + 1
        motion = delta[: frames - 1], cov_delta[: frames - 1]
        return RobotLog(
            name=path.resolve().name,
            space=SE2 if planar else SE3,
            measurement="range_bearing",
            robot_from_sensor=robot_from_sensor,
            frames=assemble(np.arange(frames), *motion, step, landmarks, z, robot_log.diagonal(std)),
            pitch_sign=pitch_sign,
            truth=_read_truth(path, planar),
        )


def _read_truth(path: Path, planar: bool) -> Truth | None:
    path_file, landmark_file = path / "robot_path_groundtruth.csv", path / "landmarks_groundtruth.csv"
    if not path_file.exists() and not landmark_file.exists():
        return None
    stamps, poses = np.empty(0, dtype=np.int64), np.empty((0, 3 if planar else 7))
    landmarks: dict[int, np.ndarray] = {}
    if path_file.exists():
        table = read_csv(path_file, [PATH])
        stamps = table.integers("step")
        table.require(np.diff(table["step"], prepend=-1) > 0, "step", "later than in the row before, from 0")
        if planar:
            for angle in ("pitch_rad", "roll_rad"):
                table.require(table[angle] == 0, angle, "0, as the odometry is planar")
            poses = SE2.normalise(np.stack([table["yaw_rad"], table["x_m"], table["y_m"]], axis=1))
        else:
            poses = SE3.from_ypr(table.block("x_m", "z_m"), *table.block("yaw_rad", "roll_rad").T)
    if landmark_file.exists():
        table = read_csv(landmark_file, [LANDMARKS])
        positions = table.block("x_m", "y_m" if planar else "z_m")
        landmarks = dict(zip(table.names("id").tolist(), positions, strict=True))
    return Truth(stamps, poses, landmarks)
