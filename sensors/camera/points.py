"""Landmarks measured by a camera whose pose is the state, world_from_camera: points (E06 (6)–(9)), rays (§5), stereo points.

Also groups of known points stored as one landmark, see `rbpf.maps.constellation`.

For a right perturbation [ω, v] of world_from_camera, the direction c = Rᵀ(x − w t) of a homogeneous world point (x, w)
moves by −ω × c − w v. A state that holds more than the pose starts with the pose.
"""

from abc import abstractmethod
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import FusedKernel, Given, Jacobians, ObservationModel, Part, Records
from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.camera.distortion import MIN_DEPTH_FRACTION


class CameraModel(ObservationModel):
    """The chain from a landmark to pixels; a subclass maps the landmark to a homogeneous world point.

    `about` (m,) is the calibration substate at which the given camera holds, if the calibration is estimated. Its last four
    numbers are those of `Pinhole.tuned`; for a stereo pair the last one is the offset of the right image's columns.
    """

    def __init__(self, camera: Pinhole | RectifiedStereo, about: Given = None) -> None:
        self.camera = camera
        self.dim = camera.dim
        self.about = about
        if about is not None:
            self.reads = self.reads | {Part.SUBSTATE}

    @abstractmethod
    def world_point(self, landmark: Array, const: Given) -> tuple[Array, Array]:
        """Homogeneous world point: x (…, 3) and w (…, 1)."""

    @abstractmethod
    def world_point_jacobian(self, landmark: Array, const: Given) -> tuple[Array, Array]:
        """Derivatives of x (…, 3, D) and w (…, 1, D) by the landmark."""

    def in_camera(self, state: Array, landmark: Array, const: Given = None) -> Array:
        """Direction (…, 3) in the camera's frame; the point itself for w = 1."""
        x, w = self.world_point(landmark, const)
        position = SE3.translation(state[..., :7])
        return SE3.inverse_transform(state[..., :7], x + (1.0 - w) * position)

    def predict(self, state: Array, landmark: Given = None, const: Given = None, substate: Given = None) -> Array:
        assert landmark is not None
        px = self.camera.project(clamp_depth(self.in_camera(state, landmark, const)))
        if self.about is None or substate is None:
            return px
        return px + (self.by_substate(state, landmark, const) @ (substate - self.about)[..., None])[..., 0]

    def by_substate(self, state: Array, landmark: Array, const: Given = None) -> Array:
        assert isinstance(self.camera, Pinhole) and self.about is not None
        slope = self.camera.by_tuning(clamp_depth(self.in_camera(state, landmark, const)))
        return np.concatenate([np.zeros((*slope.shape[:-1], self.about.size - slope.shape[-1])), slope], axis=-1)

    def jacobians(self, state: Array, landmark: Given = None, const: Given = None, substate: Given = None) -> Jacobians:
        """∂z/∂ξ = D [[c]× | −w I] and ∂z/∂b = D Rᵀ(∂x/∂b − t ∂w/∂b), with D the projection's Jacobian."""
        assert landmark is not None
        direction = clamp_depth(self.in_camera(state, landmark, const))
        slope = self.camera.jacobian(direction)
        _, w = self.world_point(landmark, const)
        by_rotation = np.cross(slope, direction[..., None, :])
        by_state = np.zeros((*by_rotation.shape[:-1], 6 + state.shape[-1] - 7))
        by_state[..., :3], by_state[..., 3:6] = by_rotation, -w[..., None] * slope
        dx, dw = self.world_point_jacobian(landmark, const)
        moved = dx - SE3.translation(state[..., :7])[..., :, None] * dw
        turned = np.swapaxes(SE3.rotation(state[..., :7]), -1, -2) @ moved
        by_substate = None if self.about is None or substate is None else self.by_substate(state, landmark, const)
        return Jacobians(by_state, slope @ turned, by_substate)

    def visible(self, state: Array, landmark: Array, const: Given = None) -> np.ndarray:
        return self.camera.visible(self.in_camera(state, landmark, const))


class CameraPoint(CameraModel):
    """A world point in metres (E06 §3.2): two pixel coordinates from one camera, three from a stereo pair."""

    def world_point(self, landmark: Array, const: Given) -> tuple[Array, Array]:
        return landmark, np.ones((*landmark.shape[:-1], 1))

    def world_point_jacobian(self, landmark: Array, const: Given) -> tuple[Array, Array]:
        return np.eye(3), np.zeros((1, 3))

    def kernel(self) -> FusedKernel | None:
        from rbpf.sensors.camera.kernels import camera_point

        if not isinstance(self.camera, Pinhole):
            return None
        return FusedKernel(camera_point, self.camera.params)


class CameraRay(CameraModel):
    """A landmark `InverseDepth` (u, v, q), anchored at world_from_anchor: its 2-D measurement (E06 §5.1).

    `rho` (2,) is the inverse depth of a new landmark: mean and standard deviation, 1/m.
    """

    def __init__(self, camera: Pinhole, rho: tuple[float, float] = (1.0, 0.5), about: Given = None) -> None:
        super().__init__(camera, about)
        if not (np.isfinite(rho).all() and min(rho) > 0.0):
            raise InputError(f"the prior of the inverse depth needs a positive mean and deviation, got {rho}")
        self.pinhole = camera
        self.rho = rho

    def world_point(self, landmark: Array, const: Given) -> tuple[Array, Array]:
        """The ray: x = R_a (u, v, 1) + q t_a, w = q."""
        assert const is not None
        ray = np.concatenate([landmark[..., :2], np.ones((*landmark.shape[:-1], 1))], axis=-1)
        rho, position = landmark[..., 2:], SE3.translation(const)
        return SE3.transform(const, ray) + (rho - 1.0) * position, rho

    def world_point_jacobian(self, landmark: Array, const: Given) -> tuple[Array, Array]:
        """First two columns of R_a, and t_a."""
        assert const is not None
        turned = SE3.rotation(const)[..., :2]
        dx = np.concatenate([turned, SE3.translation(const)[..., None]], axis=-1)
        return dx, np.array([[0.0, 0.0, 1.0]])

    def initialise(self, state: Array, z: Array, cov: Array) -> Records:
        """The ray through z from each particle's own camera, with the prior inverse depth."""
        n, k = state.shape[0], z.shape[0]
        uv, slope = self.pinhole.unproject(z), self.pinhole.unproject_jacobian(z)
        mean = np.concatenate([uv, np.full((k, 1), self.rho[0])], axis=1)
        full = np.zeros((k, 3, 3))
        full[:, :2, :2] = gaussian.symmetrise(slope @ cov @ np.swapaxes(slope, -1, -2))
        full[:, 2, 2] = self.rho[1] ** 2
        anchor = np.broadcast_to(state[:, None, :7], (n, k, 7))
        return Records(np.broadcast_to(mean, (n, k, 3)), np.broadcast_to(full, (n, k, 3, 3)), anchor)

    def new_by_substate(self, z: Array) -> Array | None:
        """Another calibration moves the ray of the same z: ∂(u, v)/∂s = −(∂z/∂(u, v))⁻¹ ∂z/∂s."""
        if self.about is None:
            return None
        ahead = np.insert(self.pinhole.unproject(z), 2, 1.0, axis=1)
        out = np.zeros((len(z), 3, self.about.size))
        out[:, :2, -4:] = -self.pinhole.unproject_jacobian(z) @ self.pinhole.by_tuning(ahead)
        return out

    def kernel(self) -> FusedKernel | None:
        from rbpf.sensors.camera.kernels import camera_ray

        return FusedKernel(camera_ray, self.pinhole.params)


@final
class EpipolarRay(CameraRay):
    """The part of a ray's measurement that does not depend on its depth: E06 §5.2, the epipolar constraint.

    y = n̂ᵀ(z − h(b̂)) with n̂ ⟂ ∂h/∂q is the limit P_qq → ∞ of the 2-D marginal. It is returned as the 2-D residual n̂ y
    with noise R: across the line that is y's noise, along it a constant equal in all particles, if R is a multiple of the
    identity. For features of which every particle's camera has moved sideways; for one that has not there is no epipolar
    line, and the full residual is returned.
    """

    def jacobians(self, state: Array, landmark: Given = None, const: Given = None, substate: Given = None) -> Jacobians:
        """Those of the ray, projected on n̂."""
        by_state, by_landmark, _ = super().jacobians(state, landmark, const)
        assert by_state is not None and by_landmark is not None
        across = self._across(by_landmark[..., 2])
        return Jacobians(across @ by_state, across @ by_landmark)

    def innovation(
        self, z: Array, state: Array, landmark: Given = None, const: Given = None, substate: Given = None
    ) -> Array:
        """n̂ y."""
        assert landmark is not None
        _, by_landmark, _ = super().jacobians(state, landmark, const)
        assert by_landmark is not None
        nu = z - self.predict(state, landmark, const)
        return (self._across(by_landmark[..., 2]) @ nu[..., None])[..., 0]

    def kernel(self) -> FusedKernel | None:
        from rbpf.sensors.camera.kernels import epipolar_ray

        return FusedKernel(epipolar_ray, self.pinhole.params)

    @staticmethod
    def _across(by_rho: Array) -> Array:
        """n̂ n̂ᵀ (…, 2, 2), or the identity where ∂h/∂q (…, 2) is 0."""
        squared = np.square(by_rho).sum(axis=-1)[..., None, None]
        along = by_rho[..., :, None] * by_rho[..., None, :]
        return np.eye(2) - along / np.where(squared > 0.0, squared, 1.0)


@final
class StereoPoint(CameraPoint):
    """A world point in metres, seen by both cameras.

    S05 (4)–(7) compares points in space, with C^L from the pixel noise; here pixels are compared, which is the same to
    first order and stays Gaussian for far points. With `about` (1,), that column offset has been subtracted from every
    u_right.
    """

    def __init__(self, rig: RectifiedStereo, about: Given = None) -> None:
        super().__init__(rig, about)
        self.rig = rig

    def by_substate(self, state: Array, landmark: Array, const: Given = None) -> Array:
        assert self.about is not None
        out = np.zeros((*np.broadcast_shapes(state.shape[:-1], landmark.shape[:-1]), 3, self.about.size))
        out[..., 2, -1] = 1.0
        return out

    def new_by_substate(self, z: Array) -> Array | None:
        """∂point/∂s = −∂point/∂u_right."""
        if self.about is None:
            return None
        out = np.zeros((len(z), 3, self.about.size))
        out[..., -1] = -np.linalg.inv(self.rig.jacobian(self.rig.triangulate(z)))[..., 2]
        return out

    def invert(self, state: Array, z: Array) -> Array:
        """S05 (4); NaN without disparity."""
        return SE3.transform(state[..., :7], self.rig.triangulate(z))

    def initialise(self, state: Array, z: Array, cov: Array) -> Records:
        """Points (N, K, 3) with R C^L Rᵀ, S05 (4) and (7)."""
        local = self.rig.triangulate(z)
        by_pixel = np.linalg.inv(self.rig.jacobian(local))
        turned = SE3.rotation(state[:, None, :7]) @ by_pixel
        mean = SE3.transform(state[:, None, :7], local)
        return Records(mean, gaussian.symmetrise(turned @ cov @ np.swapaxes(turned, -1, -2)))

    def kernel(self) -> FusedKernel | None:
        from rbpf.sensors.camera.kernels import stereo_point

        return FusedKernel(stereo_point, np.append(self.rig.camera.params[:4], self.rig.baseline_m))


def clamp_depth(direction: Array) -> Array:
    """Directions (…, 3) with the depth raised to a positive minimum: points behind the camera project far outside."""
    length = np.sqrt(np.square(direction).sum(axis=-1))
    depth = np.maximum(direction[..., 2], MIN_DEPTH_FRACTION * length)
    return np.concatenate([direction[..., :2], depth[..., None]], axis=-1)


@final
class MembersView(ObservationModel):
    """The pixels of the points (p_1, p_2, …) of a `Constellation` at `places` (m,), one after the other: z (2m,).

    A state that holds more than world_from_camera starts with the pose.
    """

    def __init__(self, camera: Pinhole, places: np.ndarray) -> None:
        self.camera = camera
        self.dim = 2 * places.size
        self.places = places
        self._point = CameraPoint(camera)
        self._params = np.concatenate([camera.params, places])

    def in_camera(self, state: Array, landmark: Array) -> Array:
        """The points (…, m, 3) in the camera's frame."""
        return SE3.inverse_transform(state[..., None, :7], self.in_world(landmark))

    def predict(self, state: Array, landmark: Given = None, const: Given = None, substate: Given = None) -> Array:
        """Every point by E06 (7)–(9)."""
        assert landmark is not None
        px = self.camera.project(clamp_depth(self.in_camera(state, landmark)))
        return px.reshape(*px.shape[:-2], self.dim)

    def jacobians(self, state: Array, landmark: Given = None, const: Given = None, substate: Given = None) -> Jacobians:
        """Those of `CameraPoint`, stacked; a pixel depends on its own point alone."""
        assert landmark is not None
        by_state, by_point, _ = self._point.jacobians(state[..., None, :], self.in_world(landmark))
        assert by_state is not None and by_point is not None
        by_landmark = np.zeros((*by_point.shape[:-1], landmark.shape[-1]))
        for k, place in enumerate(self.places.tolist()):
            by_landmark[..., k, :, 3 * place : 3 * place + 3] = by_point[..., k, :, :]
        shape = (*by_state.shape[:-3], self.dim)
        return Jacobians(by_state.reshape(*shape, -1), by_landmark.reshape(*shape, -1))

    def visible(self, state: Array, landmark: Array, const: Given = None) -> np.ndarray:
        """Whether all points are in the image."""
        return np.asarray(self.camera.visible(self.in_camera(state, landmark)).all(axis=-1))

    def kernel(self) -> FusedKernel | None:
        from rbpf.sensors.camera.kernels import members_view

        return FusedKernel(members_view, self._params)

    def in_world(self, landmark: Array, const: Given = None) -> Array:
        """The points (…, m, 3) in the world."""
        points = landmark.reshape(*landmark.shape[:-1], -1, 3)
        return np.asarray(points[..., self.places, :])
