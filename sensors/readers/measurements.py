"""The measurements that one run used: what a batch optimiser needs to solve the same problem."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Literal, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from rbpf.core.checkpoint import covariances, elements, integers, numbers, require, stamps
from rbpf.errors import InputError
from rbpf.lie import Array, SE2Group, SE3Group
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition

Kind = Literal["range_bearing", "position"]
KINDS: dict[str, Kind] = {"range_bearing": "range_bearing", "position": "position"}

_NEGATIVE = 1e-9
_UNIT = 1e-6


@final
@dataclass(frozen=True, eq=False)
class Measurements:
    """Odometry, and observations of landmarks with fixed association; T steps, K observations.

    Raises InputError: shapes do not fit together, or a number is not as described.
    """

    recording: str  #: short name of the recording, one line.
    space: SE2Group | SE3Group  #: SE2 or SE3, the group of the robot's pose.
    measurement: Kind  #: "range_bearing" (range, yaw[, pitch]) or "position" (point in the sensor's frame).
    pitch_sign: float  #: +1 where positive pitch points up, -1 where it points down.
    robot_from_sensor: Array  #: (E,) mounting pose.
    start: Array  #: (E,) world_from_robot of step 0, taken as exact.
    stamps_ns: NDArray[np.int64]  #: (T,) time of each step, integer nanoseconds.
    deltas: Array  #: (T - 1, E) odometry, previous_robot_from_robot of the steps from 1 on.
    covs: Array  #: (T - 1, d, d) their covariance in the right chart there, order [omega, v]; may be singular.
    steps: NDArray[np.int64]  #: (K,) the step of each observation.
    landmarks: NDArray[np.int64]  #: (K,) the map's name of the observed landmark.
    z: Array  #: (K, p) what was measured.
    cov_z: Array  #: (K, p, p) covariance of its noise.

    def __post_init__(self) -> None:
        if self.recording.splitlines() != [self.recording.strip()]:
            raise InputError(f"Expected a name on one line without blanks around it, found {self.recording!r}.")
        if self.measurement not in KINDS or self.pitch_sign not in (-1.0, 1.0):
            expected = f"a measurement {' or '.join(KINDS)} and a pitch sign 1 or -1"
            raise InputError(f"Expected {expected}, found {self.measurement!r} and {self.pitch_sign!r}.")
        # Measurements and landmarks have the same dimension.
        dim, point, poses = self.space.dim, self.space.point_dim, partial(elements, self.space)
        schema = {
            "robot_from_sensor": poses(),
            "start": poses(),
            "stamps_ns": stamps("T"),
            "deltas": poses("moves"),
            "covs": covariances("moves", dim, dim),
            "steps": integers("K", least=0, below="T"),
            "landmarks": integers("K"),
            "z": numbers("K", point),
            "cov_z": covariances("K", point, point),
        }
        require(self.recording, vars(self), schema, moves=max(len(self.stamps_ns) - 1, 0))

    def model(self) -> RangeBearing | RelativePosition:
        """The observation model, the same one that the filter uses."""
        if self.measurement == "position":
            return RelativePosition(self.space, self.robot_from_sensor)
        return RangeBearing(self.space, self.robot_from_sensor, self.pitch_sign)


class InitialEstimate(NamedTuple):
    """The initial values of an optimiser: world_from_body (T, E), and name of each landmark to its (D,) position."""

    world_from_body: Array
    landmarks: Mapping[int, Array]


def dead_reckoning(m: Measurements) -> Array:
    """(T, E) world_from_robot by odometry alone."""
    return np.array(list(accumulate(m.deltas, m.space.compose, initial=m.start)))


def initial_estimate(m: Measurements) -> InitialEstimate:
    """Dead reckoning, and every landmark initialised by its first observation from there."""
    path, model = dead_reckoning(m), m.model()
    by_step = np.argsort(m.steps, kind="stable")
    names, first = np.unique(m.landmarks[by_step], return_index=True)
    rows = by_step[first]
    points = model.invert(path[m.steps[rows]], m.z[rows])
    return InitialEstimate(path, dict(zip(names.tolist(), points, strict=True)))


def are_covariances(cov: Array) -> NDArray[np.bool_]:
    """Mask (K,) of the finite matrices (K, n, n) that are symmetric and positive semi-definite up to rounding."""
    largest = np.abs(cov).max((-1, -2), initial=0.0)
    symmetric = np.abs(cov - cov.mT).max((-1, -2), initial=0.0) <= _NEGATIVE * largest
    return symmetric & (np.linalg.eigvalsh(cov)[:, 0] >= -_NEGATIVE * largest)


def are_poses(space: SE2Group | SE3Group, poses: Array) -> NDArray[np.bool_]:
    """Mask (K,) of the elements (K, E) that have a quaternion of length 1; in the plane all of them."""
    if isinstance(space, SE2Group):
        return np.ones(len(poses), dtype=bool)
    return np.abs(np.linalg.norm(poses[:, :4], axis=1) - 1.0) <= _UNIT
