"""Range-bearing sensors in the plane and in space, and sensors that measure a point's position.

All are chains with one Jacobian per link:

    world point --world_from_robot⁻¹--> robot frame --robot_from_sensor⁻¹--> sensor frame --measure--> z

For a right perturbation of world_from_robot, p_robot moves by −ω × p_robot − v.
"""

from abc import abstractmethod
from copy import copy
from typing import Self, final

import numpy as np

from rbpf.core.models import FusedKernel, Given, Jacobians, ObservationModel, Part
from rbpf.lie import Array, SE2Group, SE3Group


class RigidPointModel(ObservationModel):
    """A sensor mounted on a robot that measures points; a subclass defines the measurement of a point in the sensor's frame.

    A landmark's mean is read as a world point and its constants are ignored: anchored landmarks need a model of their own.
    The mounting pose robot_from_sensor (E,) in SE2 or SE3 is by default the identity; `tuned` is for one that is estimated.
    """

    _by_about: Array

    def __init__(self, space: SE2Group | SE3Group, robot_from_sensor: Array | None = None) -> None:
        self.space = space
        self.dim = space.point_dim
        self._mount(space.identity() if robot_from_sensor is None else robot_from_sensor)

    def _mount(self, robot_from_sensor: Array) -> None:
        self.robot_from_sensor = np.array(robot_from_sensor, dtype=float)
        self.robot_from_sensor.flags.writeable = False
        rotation = self.space.rotation(self.robot_from_sensor)
        #: Parameters of the fused kernels: rotation of the mounting pose by rows, then its translation.
        self.mounting = np.concatenate([rotation.ravel(), self.space.translation(self.robot_from_sensor)])

    def tuned(self, about: Array, free: Array) -> Self:
        """The sensor mounted at robot_from_sensor Exp(free s), linearised at the substate s = `about` (m,); free (d, m)."""
        moved = self.space.exp(free @ about)
        tuned = copy(self)
        tuned._mount(self.space.compose(self.robot_from_sensor, moved))
        tuned.about, tuned.reads = about, self.reads | {Part.SUBSTATE}
        # The mounting pose's derivative by s, in the right chart there.
        tuned._by_about = self.space.right_jacobian(free @ about) @ free
        return tuned

    @abstractmethod
    def measure(self, point: Array) -> Array:
        """Z (…, p) of points (…, D) in the sensor's frame."""

    @abstractmethod
    def measure_jacobian(self, point: Array) -> Array:
        """∂z/∂point (…, p, D)."""

    @abstractmethod
    def locate(self, z: Array) -> Array:
        """The point (…, D) in the sensor's frame with the measurement z (…, p)."""

    def predict(self, state: Array, landmark: Given = None, const: Given = None, substate: Given = None) -> Array:
        assert landmark is not None
        z = self.measure(self._in_sensor(state, landmark))
        if self.about is None or substate is None:
            return z
        return z + (self.by_substate(state, landmark) @ (substate - self.about)[..., None])[..., 0]

    def _in_sensor(self, state: Array, landmark: Array) -> Array:
        return self.space.inverse_transform(self.robot_from_sensor, self.space.inverse_transform(state, landmark))

    def by_substate(self, state: Array, landmark: Array, const: Given = None) -> Array:
        """As the derivative by the robot's pose, D [−ω × p | −I], but in the sensor's frame."""
        at = self._in_sensor(state, landmark)
        return -self.measure_jacobian(at) @ self.space.transform_jacobian(at) @ self._by_about

    def new_by_substate(self, z: Array) -> Array | None:
        if self.about is None:
            return None
        turned = self.space.rotation(self.robot_from_sensor) @ self.space.transform_jacobian(self.locate(z))
        return turned @ self._by_about

    def jacobians(self, state: Array, landmark: Given = None, const: Given = None, substate: Given = None) -> Jacobians:
        """∂z/∂ξ = D [−ω × p | −I] and ∂z/∂landmark = D Rᵀ, with D rotated to the robot's frame."""
        assert landmark is not None
        in_robot = self.space.inverse_transform(state, landmark)
        slope = self.measure_jacobian(self.space.inverse_transform(self.robot_from_sensor, in_robot))
        slope = slope @ np.swapaxes(self.space.rotation(self.robot_from_sensor), -1, -2)
        by_landmark = slope @ np.swapaxes(self.space.rotation(state), -1, -2)
        by_substate = None if self.about is None or substate is None else self.by_substate(state, landmark)
        return Jacobians(-slope @ self.space.transform_jacobian(in_robot), by_landmark, by_substate)

    def invert(self, state: Array, z: Array) -> Array:
        in_robot = self.space.transform(self.robot_from_sensor, self.locate(z))
        return self.space.transform(state, in_robot)


def wrap_angle(angle: Array) -> Array:
    """The same angle in [−π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@final
class RangeBearing(RigidPointModel):
    """z = (range, yaw) in the plane, (range, yaw, pitch) in space; metres and radians.

    The point is r (cos yaw cos pitch, sin yaw cos pitch, ± sin pitch), x forward, y left, z up, with the sign `pitch_sign`.
    It is visible up to `max_range` and at yaws up to `half_field_of_view`.
    """

    def __init__(
        self,
        space: SE2Group | SE3Group,
        robot_from_sensor: Array | None = None,
        pitch_sign: float = 1.0,
        max_range: float = np.inf,
        half_field_of_view: float = np.pi,
    ) -> None:
        super().__init__(space, robot_from_sensor)
        self.pitch_sign = float(pitch_sign)
        self.max_range = max_range
        self.half_field_of_view = half_field_of_view

    def measure(self, point: Array) -> Array:
        flat = np.hypot(point[..., 0], point[..., 1])
        yaw = np.arctan2(point[..., 1], point[..., 0])
        if self.dim == 2:
            return np.stack([flat, yaw], axis=-1)
        pitch = self.pitch_sign * np.arctan2(point[..., 2], flat)
        return np.stack([np.hypot(flat, point[..., 2]), yaw, pitch], axis=-1)

    def measure_jacobian(self, point: Array) -> Array:
        x, y = point[..., 0], point[..., 1]
        flat2 = x * x + y * y
        if self.dim == 2:
            distance = np.sqrt(flat2)
            rows = [x / distance, y / distance, -y / flat2, x / flat2]
            return np.stack(rows, axis=-1).reshape(*point.shape, 2)
        z, flat = point[..., 2], np.sqrt(flat2)
        distance2 = flat2 + z * z
        distance = np.sqrt(distance2)
        tilt = self.pitch_sign * z / (flat * distance2)
        rows = [x / distance, y / distance, z / distance, -y / flat2, x / flat2, np.zeros_like(x)]
        rows += [-x * tilt, -y * tilt, self.pitch_sign * flat / distance2]
        return np.stack(rows, axis=-1).reshape(*point.shape, 3)

    def locate(self, z: Array) -> Array:
        distance, yaw = z[..., 0], z[..., 1]
        if self.dim == 2:
            return np.stack([distance * np.cos(yaw), distance * np.sin(yaw)], axis=-1)
        flat = distance * np.cos(z[..., 2])
        height = self.pitch_sign * distance * np.sin(z[..., 2])
        return np.stack([flat * np.cos(yaw), flat * np.sin(yaw), height], axis=-1)

    def residual(self, z: Array, predicted: Array) -> Array:
        difference = z - predicted
        difference[..., 1:] = wrap_angle(difference[..., 1:])
        return difference

    def visible(self, state: Array, landmark: Array, const: Array | None = None) -> np.ndarray:
        z = self.predict(state, landmark)
        return (z[..., 0] <= self.max_range) & (np.abs(z[..., 1]) <= self.half_field_of_view)

    def kernel(self) -> FusedKernel | None:
        if self.about is not None:
            return None
        from rbpf.sensors.range_bearing import kernels as compiled

        if self.dim == 2:
            return FusedKernel(compiled.range_bearing_planar, self.mounting)
        return FusedKernel(compiled.range_bearing_spatial, np.append(self.mounting, self.pitch_sign))


@final
class RelativePosition(RigidPointModel):
    """z = the point in the sensor's frame, metres; visible up to `max_range`."""

    def __init__(
        self, space: SE2Group | SE3Group, robot_from_sensor: Array | None = None, max_range: float = np.inf
    ) -> None:
        super().__init__(space, robot_from_sensor)
        self.max_range = max_range

    def measure(self, point: Array) -> Array:
        return point

    def measure_jacobian(self, point: Array) -> Array:
        return np.broadcast_to(np.eye(self.dim), (*point.shape, self.dim))

    def locate(self, z: Array) -> Array:
        return z

    def visible(self, state: Array, landmark: Array, const: Array | None = None) -> np.ndarray:
        return np.linalg.norm(self.predict(state, landmark), axis=-1) <= self.max_range

    def kernel(self) -> FusedKernel | None:
        if self.about is not None:
            return None
        from rbpf.sensors.range_bearing import kernels as compiled

        function = compiled.position_planar if self.dim == 2 else compiled.position_spatial
        return FusedKernel(function, self.mounting)
