"""Poses and tangents of GTSAM in ours.

Pose2 has the tangent [v, ω], Pose3 [ω, v]. In GTSAM 4.3 both retract by the exponential map on the right, so
only the order differs from ours, and a BetweenFactor's residual is Log(δ⁻¹ x⁻¹ y) with exact derivatives.
The tests check this of the installed build.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import gtsam
import numpy as np
from numpy.typing import NDArray

from rbpf.lie import Array


@final
@dataclass(frozen=True)
class Chart:
    """How GTSAM holds the poses of a group.

    Attributes:
        order: (d,) GTSAM's tangent is ours[order].
        pose: our storage (E,) to GTSAM's object.
        storage: values and key to our storage (E,).
        point: values and key to a landmark (D,).
        between: class of the native odometry factor.
        prior: class of the factor that holds the start.
    """

    order: NDArray[np.intp]
    pose: Callable[[Array], Any]
    storage: Callable[[Any, int], Array]
    point: Callable[[Any, int], Array]
    between: type
    prior: type

    def covariance(self, cov: Array) -> Array:
        """Ours of GTSAM's (d, d)."""
        out = np.empty_like(cov)
        out[np.ix_(self.order, self.order)] = cov
        return out


def _pose2(x: Array) -> Any:
    return gtsam.Pose2(x[1], x[2], x[0])


def _storage2(values: Any, key: int) -> Array:
    pose = values.atPose2(key)
    return np.array([pose.theta(), pose.x(), pose.y()])


def _pose3(x: Array) -> Any:
    return gtsam.Pose3(gtsam.Rot3.Quaternion(x[3], x[0], x[1], x[2]), x[4:])


def _storage3(values: Any, key: int) -> Array:
    pose = values.atPose3(key)
    return np.concatenate([pose.rotation().toQuaternion().coeffs(), pose.translation()])


PLANAR = Chart(
    order=np.array([1, 2, 0]),
    pose=_pose2,
    storage=_storage2,
    point=gtsam.Values.atPoint2,
    between=gtsam.BetweenFactorPose2,
    prior=gtsam.PriorFactorPose2,
)
SPATIAL = Chart(
    order=np.arange(6),
    pose=_pose3,
    storage=_storage3,
    point=gtsam.Values.atPoint3,
    between=gtsam.BetweenFactorPose3,
    prior=gtsam.PriorFactorPose3,
)
