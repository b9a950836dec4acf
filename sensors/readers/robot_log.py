"""What every reader of a robot log returns: odometry, observations of landmarks and, if known, the truth.

Also what these readers share: noise parameters of a caller in place of the log's, conversion of the logs' covariances
(upper triangles, in additive coordinates, rounded to a few digits), and frames from arrays.
"""

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Array, SE2Group, SE3Group
from rbpf.ranges import NotNegative, Positive, Ranged
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.text import Table

UNNAMED = -1  #: In place of a landmark's name for unknown association.
_ROUNDING = 1e-5  #: Rounding error of a covariance's printed digits, relative.
Numbers = NDArray[np.int64]  #: Times, steps, names of landmarks.


@dataclass(frozen=True)
class Frame:
    """One filter step: the motion since the previous frame and the observations after it."""

    stamp_ns: int  #: time of the observations, integer nanoseconds; a log without times counts steps.
    delta: np.ndarray | None  #: (E,) odometry, previous_robot_from_robot; None in the first frame.
    cov_delta: np.ndarray | None  #: (d, d) its covariance in the right chart at `delta`; None in the first frame.
    #: (K,) the log's integer names of the observed landmarks, `UNNAMED` without a name.
    landmarks: np.ndarray
    z: np.ndarray  #: (K, p) measurements.
    cov_z: np.ndarray  #: (K, p, p) their covariance.


@dataclass(frozen=True)
class RobotLog:
    """A recording of a robot that observes landmarks."""

    name: str  #: short name of the recording.
    space: SE2Group | SE3Group  #: SE2 or SE3, the group of the robot's pose.
    measurement: str  #: "range_bearing" (range, yaw[, pitch]) or "position" (point in the sensor's frame).
    robot_from_sensor: np.ndarray  #: (E,) mounting pose of the sensor.
    frames: list[Frame]  #: the steps in order of time.
    pitch_sign: float = 1.0  #: +1 where positive pitch points up, -1 where it points down.
    truth: Truth | None = None  #: ground truth, or None.
    #: whether associations in the log may be wrong, as for barcodes read by a camera.
    misread: bool = False


@dataclass(frozen=True)
class LogNoise(Ranged):
    """Noise of a log; None takes the log's value, or else the reader's documented default.

    Raises InputError: one is not finite, or negative, or zero where only a positive one makes sense.
    """

    std_range_m: Positive | None = None  #: of a measured range [m].
    std_bearing_rad: Positive | None = None  #: of a measured bearing (yaw) [rad].
    std_pitch_rad: Positive | None = None  #: of a measured pitch [rad].
    std_speed_mps: NotNegative | None = None  #: of the forward speed, white noise: its density [m/s per root hertz].
    #: of the turn rate, white noise: its density [rad/s per root hertz].
    std_turn_rate_radps: NotNegative | None = None
    std_position_m: Positive | None = None  #: of each coordinate of a measured position [m].
    scale_odometry: NotNegative | None = None  #: multiplies the odometry's standard deviations.

    def require_only(self, applicable: Collection[str], path: Path, kind: str) -> None:
        """Refuses fields that have no effect on a `kind` of log, which takes only the `applicable` ones."""
        for name in self.given():
            if name not in applicable:
                choice = ", ".join(sorted(applicable))
                raise InputError(f"{path}: {name} has no effect on {kind}; leave it out (it takes {choice}).")

    def odometry_variance_factor(self) -> float:
        """Factor of the odometry's covariance."""
        return 1.0 if self.scale_odometry is None else self.scale_odometry**2

    def given(self) -> dict[str, float]:
        """The fields that are not None."""
        return {name: value for name, value in vars(self).items() if value is not None}


def std_column(table: Table, column: str, given: float | None) -> Array:
    """(n,) a column of standard deviations, or the given value in its place, for which the column may hold zeros."""
    if given is None:
        table.require(table[column] > 0, column, "positive")
        return table[column]
    table.require(table[column] >= 0, column, "zero or positive")
    return np.full(len(table.rows), given)


def diagonal(std: list[Array]) -> Array:
    """(n, p, p) covariance of independent components from p arrays (n,) of standard deviations."""
    return np.square(np.stack(std, axis=1))[:, :, None] * np.eye(len(std))


def require_ranges(table: Table, distance: str, *angles: str) -> None:
    """Refuse ranges that are not positive and angles beyond a turn, which are probably degrees."""
    table.require(table[distance] > 0, distance, "positive")
    for angle in angles:
        table.require(np.abs(table[angle]) <= 2 * np.pi, angle, "in radians, within a turn")


def read_covariances(table: Table, first: str, last: str) -> Array:
    """Symmetric matrices (n, d, d) from the columns of their upper triangle, row by row, from the first to the last entry.

    A matrix that is positive semi-definite up to the rounding of its printed digits is accepted.
    """
    triangle = table.block(first, last)
    dim = int(np.sqrt(2 * triangle.shape[1]))
    row, column = np.triu_indices(dim)
    cov = np.empty((len(triangle), dim, dim))
    cov[:, row, column] = cov[:, column, row] = triangle
    # Tested on the correlation matrix, because metres and radians differ by orders of magnitude.
    variance = np.einsum("nii->ni", cov)
    std = np.sqrt(np.maximum(variance, 0.0))
    bound = std[:, :, None] * std[:, None, :] * (1.0 + _ROUNDING)
    valid = (variance >= 0).all(1) & (np.abs(cov) <= bound).all((1, 2))
    scale = np.where(std > 0, std, 1.0)[valid]
    correlation = cov[valid] / scale[:, :, None] / scale[:, None, :]
    valid[valid] = np.linalg.eigvalsh(correlation)[:, 0] >= -_ROUNDING
    if not valid.all():
        problem = f"expected {first} to {last} to be a covariance, found an indefinite matrix"
        raise table.error(int(np.argmin(valid)), problem)
    return cov


def planar_to_chart(delta: Array, cov: Array) -> Array:
    """Covariances (n, 3, 3), order omega, v, in the right chart at delta (n, 3), of additive errors (x, y, heading) (n, 3, 3).

    delta Exp(xi) has the translation t + R v and the heading phi + omega to first order, so omega = d phi and v = R^T d t.
    """
    jacobian = np.zeros((len(delta), 3, 3))
    jacobian[:, 0, 2] = 1.0
    jacobian[:, 1:, :2] = SE2.rotation(delta).mT
    return jacobian @ cov @ jacobian.mT


def spatial_to_chart(delta: Array, ypr: Array, cov: Array) -> Array:
    """Covariances (n, 6, 6), order omega, v, in the right chart at delta (n, 7), of additive errors of position and angles.

    For R = Rz(yaw) Ry(pitch) Rx(roll), `ypr` (n, 3) [rad], the body's angular rate is
    omega = Rx^T (Ry^T e_z d yaw + e_y d pitch) + e_x d roll; the translation part is v = R^T d t. `cov` (n, 6, 6) is in the
    order x, y, z, yaw, pitch, roll.
    """
    _, pitch, roll = ypr.T
    jacobian = np.zeros((len(delta), 6, 6))
    jacobian[:, 0, 3] = -np.sin(pitch)
    jacobian[:, 1, 3] = np.sin(roll) * np.cos(pitch)
    jacobian[:, 2, 3] = np.cos(roll) * np.cos(pitch)
    jacobian[:, 1, 4] = np.cos(roll)
    jacobian[:, 2, 4] = -np.sin(roll)
    jacobian[:, 0, 5] = 1.0
    jacobian[:, 3:, :3] = SE3.rotation(delta).mT
    return jacobian @ cov @ jacobian.mT


def assemble(
    stamps_ns: Numbers, delta: Array, cov_delta: Array, frame: Numbers, landmarks: Numbers, z: Array, cov_z: Array
) -> list[Frame]:
    """T ordered frames at times (T,); frames without observations are empty.

    Consecutive frames are linked by motions (T - 1, E) with covariances (T - 1, d, d). The S observations, in order, have
    frames (S,), landmarks (S,), measurements (S, p) and their covariances (S, p, p).
    """
    bounds = np.searchsorted(frame, np.arange(len(stamps_ns) + 1))
    motions = [(None, None), *zip(delta, cov_delta, strict=True)]
    return [
        Frame(int(stamps_ns[t]), *motions[t], landmarks[start:stop], z[start:stop], cov_z[start:stop])
        for t, (start, stop) in enumerate(pairwise(bounds))
    ]
