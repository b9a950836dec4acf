"""Cameras, pixels and poses of COLMAP in ours, and back.

COLMAP writes poses as camera-from-world and puts the centre of the top-left pixel at (0.5, 0.5); here poses are
world-from-camera and it is at (0, 0). The half pixel is added and taken away in this module and nowhere else.
J. L. Schönberger and J.-M. Frahm, "Structure-from-motion revisited" (2016).
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole

HALF_PX = 0.5
"""Added to our pixels it gives COLMAP's."""
HALF_ANGLE = 2.0
"""Radians per unit of the tangent of COLMAP's quaternions."""


def camera_model(camera: Pinhole) -> tuple[str, list[float]]:
    """Name and parameters of COLMAP's model that is exactly our camera.

    PINHOLE without distortion; OPENCV with k1, k2, p1, p2; FULL_OPENCV, whose denominator is left at 1, with k3;
    OPENCV_FISHEYE where it is equidistant.
    """
    plain = [camera.fx, camera.fy, camera.cx + HALF_PX, camera.cy + HALF_PX]
    if camera.distortion_model == "equidistant":
        return "OPENCV_FISHEYE", [*plain, *camera.distortion]
    *four, k3 = camera.distortion
    if k3:
        return "FULL_OPENCV", [*plain, *four, k3, 0.0, 0.0, 0.0]
    return ("OPENCV", [*plain, *four]) if any(four) else ("PINHOLE", plain)


def to_colmap_camera(camera: Pinhole, camera_id: int = 1) -> Any:
    """A `pycolmap.Camera` with a known focal length."""
    import pycolmap

    name, params = camera_model(camera)
    return pycolmap.Camera(
        model=name,
        width=camera.width,
        height=camera.height,
        params=params,
        camera_id=camera_id,
        has_prior_focal_length=True,
    )


def to_colmap_pose(world_from_camera: ArrayLike) -> Any:
    """The `pycolmap.Rigid3d` cam_from_world of a pose (7,)."""
    import pycolmap

    inverse = SE3.inverse(np.asarray(world_from_camera, dtype=float))
    return pycolmap.Rigid3d(pycolmap.Rotation3d(inverse[:4]), inverse[4:])


def from_colmap_pose(cam_from_world: Any) -> Array:
    """The pose world_from_camera (7,) of a `pycolmap.Rigid3d`."""
    inverse = np.concatenate([cam_from_world.rotation.quat, cam_from_world.translation])
    return SE3.inverse(SE3.normalise(inverse))


def from_colmap_covariance(cov_cam_from_world: ArrayLike, world_from_camera: Array) -> Array:
    """Our covariance (..., 6, 6) of a pose (..., 7) from COLMAP's of its inverse, both in the order [omega, v].

    COLMAP's Ceres perturbs cam_from_world = (R, t) as (Exp(2 delta) R, t + v): the quaternion from the left by HALF a
    rotation vector, the translation by addition, all in the camera's axes. With T = cam_from_world^-1 that is T Exp(xi)
    with xi = -(2 delta, v - 2 delta x t) to first order. `pycolmap.get_covariance_for_inverse` takes a whole rotation
    vector and so does not fit what `estimate_ba_covariance` returns. The tests check this of the installed build.
    """
    slope = tangent_slope(world_from_camera)
    return np.asarray(slope @ np.asarray(cov_cam_from_world) @ np.swapaxes(slope, -1, -2))


def tangent_slope(world_from_camera: Array) -> Array:
    """Matrices (..., 6, 6) from COLMAP's tangent at the inverse of poses (..., 7) to ours; see above."""
    shift = SE3.translation(SE3.inverse(world_from_camera))
    slope = np.zeros((*shift.shape[:-1], 6, 6))
    slope[..., :3, :3] = -HALF_ANGLE * np.eye(3)
    slope[..., 3:, :3] = -HALF_ANGLE * _cross(shift)
    slope[..., 3:, 3:] = -np.eye(3)
    return slope


def _cross(v: Array) -> Array:
    """Matrices (..., 3, 3) with [v] w = v x w."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape, 3)
