"""A camera's view of a constellation: several known points at once, which share the pose of their frame."""

from functools import cached_property
from typing import final

import numpy as np

from rbpf.lie import SE3
from rbpf.models import FusedKernel, Jacobians, ObservationModel
from rbpf.sensors.camera_points import forward
from rbpf.sensors.pinhole import Pinhole


@final
class ConstellationView(ObservationModel):
    """The pixels of m points of a `Constellation`, one after the other: z (2m,).

    The landmark is (ξ, e_1, …) with constant G: point k lies at G Exp(ξ) (p_k + e_k). Where the state holds more than
    world_from_camera, the pose comes first.

    Args:
        camera: of the image.
        points: (m, 3) p_k of the points that are seen, in the group's frame.
        places: (m,) which of the landmark's errors e are theirs; None where the points are exact.
    """

    def __init__(self, camera: Pinhole, points: np.ndarray, places: np.ndarray | None) -> None:
        self.camera = camera
        self.points = points
        self.places = places
        self.dim = 2 * points.shape[0]

    def predict(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> np.ndarray:
        """Every point by E06 (7)–(9)."""
        assert landmark is not None and const is not None
        _, _, in_camera = self._chain(state, landmark, const)
        px = self.camera.project(forward(in_camera))
        return px.reshape(*px.shape[:-2], self.dim)

    def jacobians(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> Jacobians:
        """∂z/∂state = D [[c]× | −I]; ∂z/∂ξ = D R [−[p]× | I] J_r(ξ); ∂z/∂e = D R, with R = R_cᵀ R_G Exp(ξ)."""
        assert landmark is not None and const is not None
        frame, in_group, in_camera = self._chain(state, landmark, const)
        direction = forward(in_camera)
        slope = self.camera.slope(direction)
        by_state = np.zeros((*slope.shape[:-1], 6 + state.shape[-1] - 7))
        by_state[..., :3], by_state[..., 3:6] = np.cross(slope, direction[..., None, :]), -slope
        turned = (
            slope @ (np.swapaxes(SE3.rotation(state[..., :7]), -1, -2) @ SE3.rotation(frame))[..., None, :, :]
        )
        # a·(−[p]× ω) = (a × p)·ω with the sign of dω × p = −[p]× dω reversed twice.
        by_frame = np.concatenate([-np.cross(turned, in_group[..., None, :]), turned], axis=-1)
        by_xi = by_frame @ SE3.right_jacobian(landmark[..., :6])[..., None, :, :]
        by_landmark = np.zeros((*slope.shape[:-1], landmark.shape[-1]))
        by_landmark[..., :6] = by_xi
        if self.places is not None:
            for k, place in enumerate(self.places.tolist()):
                by_landmark[..., k, :, 6 + 3 * place : 9 + 3 * place] = turned[..., k, :, :]
        shape = (*slope.shape[:-3], self.dim)
        return Jacobians(by_state.reshape(*shape, -1), by_landmark.reshape(*shape, -1))

    def visible(self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """Whether all of its points are in the image."""
        assert const is not None
        return np.asarray(self.camera.visible(self._chain(state, landmark, const)[2]).all(axis=-1))

    def in_world(self, landmark: np.ndarray, const: np.ndarray | None) -> np.ndarray:
        """The points (…, m, 3) in the world."""
        assert const is not None
        frame = SE3.retract(const, landmark[..., :6])
        return SE3.transform(frame[..., None, :], self._in_group(landmark))

    def in_camera(self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray | None) -> np.ndarray:
        """The points (…, m, 3) in the camera's frame."""
        assert const is not None
        return self._chain(state, landmark, const)[2]

    def kernel(self) -> FusedKernel | None:
        """Compiled."""
        from rbpf.sensors.constellation_kernel import constellation_view

        return FusedKernel(constellation_view, self._params)

    @cached_property
    def _params(self) -> np.ndarray:
        """The camera's, then (x, y, z, place) of each point: asked for several times in a step."""
        places = -np.ones(len(self.points)) if self.places is None else self.places
        return np.concatenate([self.camera.params, np.column_stack([self.points, places]).ravel()])

    def _chain(
        self, state: np.ndarray, landmark: np.ndarray, const: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """world_from_group (…, 7), and the points (…, m, 3) in the group's and in the camera's frame."""
        frame = SE3.retract(const, landmark[..., :6])
        in_group = self._in_group(landmark)
        world = SE3.transform(frame[..., None, :], in_group)
        return frame, in_group, SE3.inverse_transform(state[..., None, :7], world)

    def _in_group(self, landmark: np.ndarray) -> np.ndarray:
        """The points (…, m, 3) with their errors."""
        if self.places is None:
            return self.points
        errors = landmark[..., 6:].reshape(*landmark.shape[:-1], -1, 3)
        return np.asarray(self.points + errors[..., self.places, :])
