"""A camera's view of known points that one landmark holds together, see `rbpf.maps.constellation`."""

from abc import abstractmethod
from functools import cached_property
from typing import final

import numpy as np

from rbpf.core.models import FusedKernel, Jacobians, ObservationModel
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraPoint, clamp_depth


class PointsView(ObservationModel):
    """The pixels of m points that one landmark holds together, one after the other: z (2m,).

    Where the state holds more than world_from_camera, the pose comes first.

    Args:
        camera: of the image.
        count: m.
    """

    def __init__(self, camera: Pinhole, count: int) -> None:
        self.camera = camera
        self.dim = 2 * count

    @abstractmethod
    def in_world(self, landmark: np.ndarray, const: np.ndarray | None) -> np.ndarray:
        """The points (…, m, 3) in the world."""

    @abstractmethod
    def slopes(
        self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """∂z/∂state (…, m, 2, d) and ∂z/∂landmark (…, m, 2, D) of each point."""

    def in_camera(self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray | None) -> np.ndarray:
        """The points (…, m, 3) in the camera's frame."""
        return SE3.inverse_transform(state[..., None, :7], self.in_world(landmark, const))

    def predict(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> np.ndarray:
        """Every point by E06 (7)–(9)."""
        assert landmark is not None
        px = self.camera.project(clamp_depth(self.in_camera(state, landmark, const)))
        return px.reshape(*px.shape[:-2], self.dim)

    def jacobians(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> Jacobians:
        """Those of each point, one below the other."""
        assert landmark is not None
        by_state, by_landmark = self.slopes(state, landmark, const)
        shape = (*by_state.shape[:-3], self.dim)
        return Jacobians(by_state.reshape(*shape, -1), by_landmark.reshape(*shape, -1))

    def visible(self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """Whether all of its points are in the image."""
        return np.asarray(self.camera.visible(self.in_camera(state, landmark, const)).all(axis=-1))


@final
class MembersView(PointsView):
    """The pixels of m points of an `UncertainConstellation` (p_1, p_2, …), one after the other: z (2m,).

    Args:
        camera: of the image.
        places: (m,) which of the landmark's points are seen.
    """

    def __init__(self, camera: Pinhole, places: np.ndarray) -> None:
        super().__init__(camera, places.size)
        self.places = places
        self._point = CameraPoint(camera)

    def in_world(self, landmark: np.ndarray, const: np.ndarray | None) -> np.ndarray:
        """The points (…, m, 3) in the world."""
        points = landmark.reshape(*landmark.shape[:-1], -1, 3)
        return np.asarray(points[..., self.places, :])

    def slopes(
        self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Those of a `CameraPoint`; a pixel depends on its own point alone."""
        by_state, by_point, _ = self._point.jacobians(state[..., None, :], self.in_world(landmark, const))
        assert by_state is not None and by_point is not None
        by_landmark = np.zeros((*by_point.shape[:-1], landmark.shape[-1]))
        for k, place in enumerate(self.places.tolist()):
            by_landmark[..., k, :, 3 * place : 3 * place + 3] = by_point[..., k, :, :]
        return by_state, by_landmark

    def kernel(self) -> FusedKernel | None:
        """Compiled."""
        from rbpf.sensors.camera.constellation_kernels import members_view

        return FusedKernel(members_view, self._params)

    @cached_property
    def _params(self) -> np.ndarray:
        """The camera's, then which points: asked for several times in a step."""
        return np.concatenate([self.camera.params, self.places])


@final
class ConstellationView(PointsView):
    """The pixels of m exact points of a `Constellation`, one after the other: z (2m,).

    The landmark is ξ with constant G: point m lies at G Exp(ξ) k_m.

    Args:
        camera: of the image.
        points: (m, 3) k_m of the points that are seen, in the group's frame.
    """

    def __init__(self, camera: Pinhole, points: np.ndarray) -> None:
        super().__init__(camera, points.shape[0])
        self.points = points

    def in_world(self, landmark: np.ndarray, const: np.ndarray | None) -> np.ndarray:
        """The points (…, m, 3) in the world."""
        assert const is not None
        return SE3.transform(SE3.retract(const, landmark)[..., None, :], self.points)

    def slopes(
        self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """∂z/∂state = D [[c]× | −I]; ∂z/∂ξ = D R [−[k]× | I] J_r(ξ), with R = R_cᵀ R_G Exp(ξ)."""
        assert const is not None
        direction = clamp_depth(self.in_camera(state, landmark, const))
        slope = self.camera.jacobian(direction)
        by_state = np.zeros((*slope.shape[:-1], 6 + state.shape[-1] - 7))
        by_state[..., :3], by_state[..., 3:6] = np.cross(slope, direction[..., None, :]), -slope
        frame = SE3.retract(const, landmark)
        turned = (
            slope @ (np.swapaxes(SE3.rotation(state[..., :7]), -1, -2) @ SE3.rotation(frame))[..., None, :, :]
        )
        # a·(ω × k) = −(a × k)·ω
        by_frame = np.concatenate([-np.cross(turned, self.points[:, None, :]), turned], axis=-1)
        return by_state, by_frame @ SE3.right_jacobian(landmark)[..., None, :, :]

    def kernel(self) -> FusedKernel | None:
        """Compiled."""
        from rbpf.sensors.camera.constellation_kernels import constellation_view

        return FusedKernel(constellation_view, self._params)

    @cached_property
    def _params(self) -> np.ndarray:
        """The camera's, then (x, y, z) of each point: asked for several times in a step."""
        return np.concatenate([self.camera.params, self.points.ravel()])
