"""The first camera, from points of known position that are seen in its image."""

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.corners import texture
from rbpf.sensors.pinhole import Pinhole
from rbpf.sensors.readers.images import KnownPixels
from rbpf.sensors.resection import resect

MOST_SIGMAS, MOST_PX = 6.0, 4.0
"""A known point may be seen this far from where the resected camera sees it: so many σ, and so many pixels more."""

SAME_PX = 1.0
"""Known points nearer to each other in the image are one."""

LEAST_TEXTURE = 2.0
"""Slope that a known point's surroundings must have in every direction, grey levels per pixel: noise has as much."""


def resect_known(camera: Pinhole, known: KnownPixels, noise_px: float) -> np.ndarray:
    """Pose world_from_camera (7,) that explains the known points.

    Args:
        camera: of the first image.
        known: M points.
        noise_px: standard deviation of where they are seen.

    Raises:
        InputError: a point lies outside the image, two are at one place, the points do not determine the camera, or no
            pose explains them.
    """
    inside = camera.inside(known.px)
    if not inside.all():
        worst = int(np.argmin(inside))
        u, v = known.px[worst]
        raise InputError(
            f"known point {known.names[worst]} at ({u:.1f}, {v:.1f}) px lies outside the first image of "
            f"{camera.width}x{camera.height} px: give points that are seen in it"
        )
    _require_different(known)
    world_from_camera = resect(camera, known.positions, known.px)
    local = SE3.inverse_transform(world_from_camera, known.positions)
    error = np.linalg.norm(camera.project(local) - known.px, axis=1)
    allowed = MOST_SIGMAS * np.hypot(noise_px, camera.fx * known.std_m / local[:, 2]) + MOST_PX
    if (error > allowed).any():
        worst = int(np.argmax(error / allowed))
        raise InputError(
            f"no camera sees the known points as given: from the best one, known point {known.names[worst]} is "
            f"{error[worst]:.1f} px away; check the positions, their axes and which point is which"
        )
    return world_from_camera


def require_texture(image: np.ndarray, known: KnownPixels) -> None:
    """Refuses known points that could not be found again.

    Args:
        image: the first one, (H, W) uint8.
        known: M points that are seen in it.

    Raises:
        InputError: there is nothing to recognise at a point.
    """
    score = texture(image, known.px)
    worst = int(np.argmin(score))
    if score[worst] < LEAST_TEXTURE:
        u, v = known.px[worst]
        raise InputError(
            f"known point {known.names[worst]} at ({u:.1f}, {v:.1f}) px cannot be found again, the first image shows "
            "no corner there: check the pixel, or leave the point out"
        )


def _require_different(known: KnownPixels) -> None:
    for what, places, least in (("pixel", known.px, SAME_PX), ("position", known.positions, 0.0)):
        first, second = np.triu_indices(known.names.size, 1)
        near = np.flatnonzero(np.linalg.norm(places[first] - places[second], axis=1) <= least)
        if near.size:
            one, other = known.names[first[near[0]]], known.names[second[near[0]]]
            raise InputError(f"known points {one} and {other} have the same {what}: keep one of the two")
