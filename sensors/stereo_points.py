"""World points measured by a rectified stereo pair: (u_left, v, u_right), which also tells where a point is."""

from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import FusedKernel, Records
from rbpf.lie import SE3
from rbpf.sensors.camera_points import CameraModel
from rbpf.sensors.pinhole import RectifiedStereo


@final
class StereoPoint(CameraModel):
    """A world point in metres, seen by both cameras.

    S05 (4)–(7) compares points in space, with C^L from the pixels' noise; here pixels are compared, which is the same
    to first order and stays Gaussian where the point is far.

    Args:
        rig: the two cameras.
        margin_px: see `CameraModel`.
    """

    def __init__(self, rig: RectifiedStereo, margin_px: float = 0.0) -> None:
        super().__init__(rig, margin_px)
        self.rig = rig

    def world_point(self, landmark: np.ndarray, const: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """The point, w = 1."""
        return landmark, np.ones((*landmark.shape[:-1], 1))

    def world_point_jacobian(
        self, landmark: np.ndarray, const: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Identity and zero."""
        return np.eye(3), np.zeros((1, 3))

    def invert(self, state: np.ndarray, z: np.ndarray) -> np.ndarray:
        """S05 (4); NaN without disparity."""
        return SE3.transform(state[..., :7], self.rig.triangulate(z))

    def initialise(self, state: np.ndarray, z: np.ndarray, cov: np.ndarray) -> Records:
        """Points (N, K, 3) with R C^L Rᵀ, S05 (4) and (7)."""
        local = self.rig.triangulate(z)
        by_pixel = np.linalg.inv(self.rig.jacobian(local))
        turned = SE3.rotation(state[:, None, :7]) @ by_pixel
        mean = SE3.transform(state[:, None, :7], local)
        return Records(mean, gaussian.symmetrise(turned @ cov @ np.swapaxes(turned, -1, -2)))

    def kernel(self) -> FusedKernel | None:
        """Compiled."""
        from rbpf.sensors.camera_kernels import stereo_point

        return FusedKernel(stereo_point, np.append(self.rig.camera.params[:4], self.rig.baseline_m))
