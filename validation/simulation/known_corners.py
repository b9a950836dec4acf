"""Points known beforehand: corners of the texture seen in the first image, with their positions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import Rectangle, TexturedScene, cast

MIDDLE = 0.15
"""The corners keep this fraction of the image's size from its border: they stay in view when the camera begins to move."""

FLAT = 0.025
"""All within this fraction of the image's width of a corner lies in one plane: its patch can be warped."""

THICK_M, PARALLEL = 0.005, 0.01
"""Sheets nearer to each other than this, with normals nearer than this [rad], lie in one plane."""

CANDIDATES, QUALITY = 300, 0.01
"""Most corners to look for, and the least quality of one, as a fraction of the best (J. Shi, C. Tomasi 1994)."""

STRONGEST = 0.5
"""Share of the corners found that are strong enough, if they are as many as asked for."""

LEAST_SPREAD = 0.05
"""Corners are on a line if they extend, in the image, less than this fraction of their length to the side."""


@dataclass(frozen=True)
class KnownCorners:
    """Corners, the first few of them spread as well as all, and where they are.

    Attributes:
        px: (M, 2) in the first image.
        positions: (M, 3) in the world, m.
    """

    px: np.ndarray
    positions: np.ndarray


def known_corners(scene: TexturedScene, renderer: Renderer, camera: Pinhole, count: int) -> KnownCorners:
    """Strong corners spread over the middle of the first image.

    Args:
        scene: the world.
        renderer: of its pictures.
        camera: that takes them.
        count: how many, M.

    Raises:
        InputError: there are too few, or they lie on a line.
    """
    pose = scene.world_from_camera[0]
    rows = renderer.depth(pose)[1]
    planes = np.where(rows >= 0, _planes(scene.rectangles)[rows], -1)
    px = _corners(renderer.image(pose), _usable(planes))
    if len(px) < count:
        raise InputError(
            f"the first image of the {scene.name} has {len(px)} corners that can be known, expected {count}: "
            "ask for fewer known points or give the world more contrast"
        )
    px = _spread(px[: max(count, round(STRONGEST * len(px)))], count)
    extent = np.linalg.svd(px - px.mean(axis=0), compute_uv=False)
    if count > 2 and extent[1] < LEAST_SPREAD * extent[0]:
        raise InputError(
            f"the known points of the {scene.name} lie on a line in the first image: use another seed or more points"
        )
    uv = camera.unproject(px)
    depth, _ = cast(scene.rectangles, pose, uv)
    local = depth[:, None] * np.concatenate([uv, np.ones((count, 1))], axis=1)
    return KnownCorners(px, SE3.transform(pose, local))


def _planes(rectangles: Sequence[Rectangle]) -> np.ndarray:
    """(R,) for each rectangle the first one in its plane."""
    normal = np.array([np.cross(r.across, r.down) for r in rectangles])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    corner = np.array([r.corner for r in rectangles])
    apart = np.einsum("rk,rqk->rq", normal, corner - corner[:, None])
    turned = np.linalg.norm(np.cross(normal[:, None], normal), axis=-1)
    return np.asarray(((np.abs(apart) < THICK_M) & (turned < PARALLEL)).argmax(axis=1))


def _usable(planes: np.ndarray) -> np.ndarray:
    """Mask (H, W) uint8 of pixels in the middle whose surroundings lie in one plane; planes (H, W), -1 for none."""
    import cv2

    side = 2 * round(FLAT * planes.shape[1]) + 1
    window = np.ones((side, side), dtype=np.uint8)
    label = planes.astype(np.float32)
    flat = cv2.erode(label, window) == cv2.dilate(label, window)
    middle = np.zeros(planes.shape, dtype=bool)
    top, left = (round(MIDDLE * size) for size in planes.shape)
    middle[top:-top, left:-left] = True
    return np.asarray(flat & middle & (planes >= 0)).astype(np.uint8)


def _corners(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(K, 2) pixels of corners within the mask, the strongest first."""
    import cv2

    apart = FLAT * image.shape[1]
    found = cv2.goodFeaturesToTrack(image, CANDIDATES, QUALITY, apart, mask=mask, blockSize=5)
    return np.zeros((0, 2)) if found is None else np.asarray(found, dtype=float).reshape(-1, 2)


def _spread(px: np.ndarray, count: int) -> np.ndarray:
    """The (M, 2) of pixels (K, 2), the strongest first, that are farthest from any stronger one; the farthest first.

    M. Brown, R. Szeliski and S. Winder, Multi-image matching using multi-scale oriented patches, 2005.
    """
    distance = np.linalg.norm(px[:, None] - px, axis=-1)
    stronger = np.where(np.tri(len(px), k=-1, dtype=bool), distance, np.inf)
    return px[np.argsort(-stronger.min(axis=1), kind="stable")[:count]]
