"""Measurements of a point seen from a moving body: one Jacobian per link of the chain.

    world point --world_from_robot⁻¹--> robot frame --robot_from_sensor⁻¹--> sensor frame --measure--> z

For a right perturbation of world_from_robot, p_robot moves by −ω × p_robot − v.
"""

from abc import abstractmethod

import numpy as np

from rbpf.core.models import Jacobians, ObservationModel
from rbpf.lie import SE2Group, SE3Group


class RigidPointModel(ObservationModel):
    """A sensor mounted on a robot that measures points; a subclass says what is measured in the sensor's frame.

    A landmark's mean is taken as a world point and its constants are not read: anchored ones need a model of their own.

    Args:
        space: SE2 or SE3, of world_from_robot.
        robot_from_sensor: (E,) mounting pose, fixed from then on; by default the robot's origin.
    """

    def __init__(self, space: SE2Group | SE3Group, robot_from_sensor: np.ndarray | None = None) -> None:
        self.space = space
        mounting = space.identity() if robot_from_sensor is None else robot_from_sensor
        self.robot_from_sensor = np.array(mounting, dtype=float)
        self.robot_from_sensor.flags.writeable = False
        rotation = space.rotation(self.robot_from_sensor)
        self._mounting = np.concatenate([rotation.ravel(), space.translation(self.robot_from_sensor)])

    @abstractmethod
    def measure(self, point: np.ndarray) -> np.ndarray:
        """Z (…, p) of points (…, D) in the sensor's frame."""

    @abstractmethod
    def measure_jacobian(self, point: np.ndarray) -> np.ndarray:
        """∂z/∂point (…, p, D)."""

    @abstractmethod
    def locate(self, z: np.ndarray) -> np.ndarray:
        """The point (…, D) in the sensor's frame that is measured as z (…, p)."""

    def predict(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> np.ndarray:
        """The chain above."""
        assert landmark is not None
        in_robot = self.space.inverse_transform(state, landmark)
        return self.measure(self.space.inverse_transform(self.robot_from_sensor, in_robot))

    def jacobians(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> Jacobians:
        """∂z/∂ξ = D [−ω × p | −I] and ∂z/∂landmark = D Rᵀ, with D taken to the robot's frame."""
        assert landmark is not None
        in_robot = self.space.inverse_transform(state, landmark)
        slope = self.measure_jacobian(self.space.inverse_transform(self.robot_from_sensor, in_robot))
        slope = slope @ np.swapaxes(self.space.rotation(self.robot_from_sensor), -1, -2)
        by_landmark = slope @ np.swapaxes(self.space.rotation(state), -1, -2)
        return Jacobians(np.concatenate([_by_rotation(slope, in_robot), -slope], axis=-1), by_landmark)

    def invert(self, state: np.ndarray, z: np.ndarray) -> np.ndarray:
        """The chain backwards."""
        in_robot = self.space.transform(self.robot_from_sensor, self.locate(z))
        return self.space.transform(state, in_robot)

    def mounting(self) -> np.ndarray:
        """Parameters of the fused kernels: rotation of the mounting pose by rows, then its translation."""
        return self._mounting


def _by_rotation(slope: np.ndarray, point: np.ndarray) -> np.ndarray:
    """D ∂p/∂ω, with ∂p/∂ω = (y, −x) in the plane and [p]× in space."""
    if point.shape[-1] == 2:
        turned = np.stack([point[..., 1], -point[..., 0]], axis=-1)
        return (slope @ turned[..., None])[..., :1]
    x, y, z = (point[..., i] for i in range(3))
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*point.shape, 3)
    return slope @ cross
