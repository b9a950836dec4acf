"""Simulates a robot among landmarks and writes a log for `rbpf run range-bearing`.

The folder has the layout of `rbpf.sensors.readers.mrpt`: odometry, observations, sensor and both ground truths.
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np

from rbpf.lie import SE3
from rbpf.ranges import MOST, Angle, Count, NotNegative, Positive, Range, Ranged
from rbpf.runs.files import write_csv, write_text
from rbpf.sensors.readers import RobotLog, mrpt, open_log
from rbpf.sensors.readers.robot_log import UNNAMED


@dataclass(frozen=True)
class RobotWorld(Ranged):
    """A robot among random landmarks, on a circle (planar) or on a tilted, undulating loop (in space)."""

    steps: Annotated[int, Range(ge=2, le=MOST)] = 200  #: number of steps.
    landmarks: Count = 60  #: number of landmarks.
    spatial: bool = False  #: six degrees of freedom instead of three.
    radius_m: Positive = 5.0  #: of the circle.
    laps: float = 2.0  #: number of laps.
    extent_m: Positive = 9.0  #: maximum distance of landmarks from the circle's centre, per axis.
    max_range_m: Positive = 6.0  #: of the sensor.
    half_field_of_view_deg: Angle = 60.0  #: in yaw (and pitch).
    std_range_m: Positive = 0.02  #: standard deviation of the range.
    std_angle_deg: Positive = 0.3  #: standard deviation of yaw and pitch.
    std_translation_m: NotNegative = 0.03  #: standard deviation of the odometry per step and axis.
    std_rotation_deg: NotNegative = 0.3  #: likewise.
    unnamed: bool = False  #: whether the log leaves out the landmarks' names, for unknown association.


def simulate_robot(world: RobotWorld, folder: Path, seed: int) -> None:
    """Writes a log into a folder, which is created if necessary; existing files are replaced."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    # True poses (T, 7), starting at the origin, and landmarks in a box around the circle's centre: in the plane z = 0
    # unless spatial.
    phase = 2 * np.pi * world.laps * np.arange(world.steps) / (world.steps - 1)
    wave = np.sin(3 * phase) if world.spatial else np.zeros_like(phase)
    position = np.stack([world.radius_m * np.sin(phase), world.radius_m * (1 - np.cos(phase)), 0.5 * wave], axis=-1)
    truth = SE3.from_ypr(position, phase, 0.1 * wave, 0.2 * wave)
    size = np.array([world.extent_m, world.extent_m, 2.0 if world.spatial else 0.0])
    points = [0.0, world.radius_m, 0.0] + rng.uniform(-1, 1, (world.landmarks, 3)) * size
    yaw, pitch, roll = SE3.ypr(truth)
    table = np.column_stack([SE3.translation(truth), yaw, pitch, roll]).tolist()
    write_csv(folder / "robot_path_groundtruth.csv", mrpt.PATH, ([t, *row] for t, row in enumerate(table)))
    named = ([i, *place] for i, place in enumerate(points.tolist(), 1))
    write_csv(folder / "landmarks_groundtruth.csv", mrpt.LANDMARKS, named)
    # Odometry: noise is added to the increment's coordinates, in accordance with the log's covariance.
    delta = SE3.between(truth[:-1], truth[1:])
    yaw, pitch, roll = SE3.ypr(delta)
    turn = np.deg2rad(world.std_rotation_deg)
    if world.spatial:
        std = np.array([world.std_translation_m] * 3 + [turn] * 3)
        exact = np.column_stack([SE3.translation(delta), yaw, pitch, roll])
    else:
        std = np.array([world.std_translation_m] * 2 + [turn])
        exact = np.column_stack([SE3.translation(delta)[:, :2], yaw])
    noisy = exact + std * rng.standard_normal(exact.shape)
    cov = np.diag(std**2)[np.triu_indices(std.size)].tolist()
    header = mrpt.SPATIAL if world.spatial else mrpt.PLANAR
    write_csv(folder / "odometry.csv", header, ([t, *row, *cov] for t, row in enumerate(noisy.tolist(), 1)))
    # Range, yaw and pitch of the landmarks within range and in view.
    turn = np.deg2rad(world.std_angle_deg)
    std = np.array([world.std_range_m, turn, turn if world.spatial else 0.0])
    view = np.deg2rad(world.half_field_of_view_deg)
    rows: list[list[float]] = []
    for t, pose in enumerate(truth):
        x, y, h = SE3.inverse_transform(pose, points).T
        z = np.stack([np.sqrt(x * x + y * y + h * h), np.arctan2(y, x), np.arctan2(h, np.hypot(x, y))], axis=-1)
        near = (z[:, 0] <= world.max_range_m) & (z[:, 0] > max(0.2, 4.0 * world.std_range_m))  # else noise may give ≤ 0
        seen = near & (np.abs(z[:, 1]) <= view) & (np.abs(z[:, 2]) <= view)
        noisy = z[seen] + std * rng.standard_normal((int(seen.sum()), 3))
        rows.extend(
            [t, UNNAMED if world.unnamed else i + 1, *row, *std]
            for i, row in zip(np.flatnonzero(seen).tolist(), noisy.tolist(), strict=True)
        )
    write_csv(folder / "observations.csv", mrpt.NAMED, rows)
    text = (
        "robot_from_sensor: {x_m: 0, y_m: 0, z_m: 0, yaw_deg: 0, pitch_deg: 0, roll_deg: 0}\n"
        f"std: {{range_m: {world.std_range_m}, yaw_deg: {world.std_angle_deg}, pitch_deg: {world.std_angle_deg}}}\n"
        "positive_pitch: up\n"
    )
    write_text(folder / "sensor.yaml", text)


def simulated_log(world: RobotWorld, seed: int) -> RobotLog:
    """The log of `simulate_robot`, in memory."""
    with TemporaryDirectory() as folder:
        simulate_robot(world, Path(folder), seed)
        return open_log(folder)
