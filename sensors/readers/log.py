"""What every reader of a robot log returns: odometry, sightings of landmarks and, where known, the truth."""

from dataclasses import dataclass, field

import numpy as np

from rbpf.lie import SE2Group, SE3Group


@dataclass(frozen=True)
class Frame:
    """One filter step: the motion since the previous frame and what was then seen.

    Attributes:
        stamp_ns: time of the sightings, integer nanoseconds; a log without times counts steps.
        delta: (E,) odometry, previous_robot_from_robot; None in the first frame.
        cov_delta: (d, d) its covariance in the right chart at `delta`; None in the first frame.
        landmarks: (K,) integer names that the log gives the landmarks seen.
        z: (K, p) measurements.
        cov_z: (K, p, p) their covariance.
    """

    stamp_ns: int
    delta: np.ndarray | None
    cov_delta: np.ndarray | None
    landmarks: np.ndarray
    z: np.ndarray
    cov_z: np.ndarray


@dataclass(frozen=True)
class Truth:
    """Ground truth of a log.

    Attributes:
        stamps_ns: (T,) times of the poses.
        world_from_robot: (T, E) poses at these times.
        landmarks: name of a landmark to its (D,) position in the world.
    """

    stamps_ns: np.ndarray
    world_from_robot: np.ndarray
    landmarks: dict[int, np.ndarray] = field(default_factory=dict)

    @property
    def poses(self) -> np.ndarray:
        """(T, E) of the body."""
        return self.world_from_robot


@dataclass(frozen=True)
class RobotLog:
    """A recording of a robot that sees landmarks.

    Attributes:
        name: short name of the recording.
        space: SE2 or SE3, the group of the robot's pose.
        measurement: "range_bearing" (range, yaw[, pitch]) or "position" (point in the sensor's frame).
        robot_from_sensor: (E,) mounting pose of the sensor.
        pitch_sign: +1 where positive pitch points up, -1 where it points down.
        frames: the steps in order of time.
        truth: ground truth, None where the log has none.
    """

    name: str
    space: SE2Group | SE3Group
    measurement: str
    robot_from_sensor: np.ndarray
    frames: list[Frame]
    pitch_sign: float = 1.0
    truth: Truth | None = None
