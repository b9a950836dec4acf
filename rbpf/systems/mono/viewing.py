"""How a feature looks from where the camera is now: the affine homography of its patch (E06 §4.1)."""

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole

NEAREST = 1e-3
"""Least inverse-depth weight of a homogeneous point for its patch to be placed in space: beyond, it is at infinity."""

_OFFSETS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def directions(place: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """Directions (K, 3) in the camera's frame of homogeneous world points (K, 4)."""
    position = SE3.translation(world_from_camera)
    return SE3.inverse_transform(world_from_camera, place[:, :3] + (1.0 - place[:, 3:]) * position)


def affines(
    camera: Pinhole, place: np.ndarray, first_pose: np.ndarray, world_from_camera: np.ndarray
) -> np.ndarray:
    """∂(pixel in the first image)/∂(pixel now) (K, 2, 2) of patches that faced their first camera.

    Args:
        camera: of both images.
        place: (K, 4) homogeneous world points.
        first_pose: (K, 7) world_from_camera of the first sightings.
        world_from_camera: (7,) now.
    """
    weight = np.maximum(place[:, 3:], NEAREST)
    point = place[:, :3] / weight
    first_position = SE3.translation(first_pose)
    normal = first_position - point
    now = camera.project(directions(place, world_from_camera))
    uv = camera.unproject(now[:, None] + _OFFSETS)
    rays = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1)
    position = SE3.translation(world_from_camera)
    world_rays = SE3.transform(world_from_camera, rays) - position
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (normal * (point - position)).sum(axis=-1)[:, None] / (normal[:, None] * world_rays).sum(
            axis=-1
        )
    on_patch = position + along[..., None] * world_rays
    first = camera.project(SE3.inverse_transform(first_pose[:, None], on_patch))
    return np.stack([first[:, 0] - first[:, 1], first[:, 2] - first[:, 3]], axis=-1) / 2.0


def turned(place: np.ndarray, one_pose: np.ndarray, other_pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Between two cameras, of each place: cosine (K,) of the lines of sight, and ratio (K,) of the distances.

    Args:
        place: (K, 4) homogeneous world points.
        one_pose: (7,) or (K, 7) world_from_camera.
        other_pose: likewise.
    """
    one, other = (place[:, :3] - place[:, 3:] * SE3.translation(pose) for pose in (one_pose, other_pose))
    far, near = np.linalg.norm(one, axis=-1), np.linalg.norm(other, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (one * other).sum(axis=-1) / (far * near), far / near
