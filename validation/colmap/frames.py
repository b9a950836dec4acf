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
