"""What the last image before a camera was lost shows beside the map: corners, which say how it has moved since."""

from dataclasses import replace
from typing import final

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.resection import Sights
from rbpf.sensors.features import Descriptor, Detector
from rbpf.sensors.patches.search import cut, search, warp
from rbpf.systems.mono.appearance import SOURCE_HALF_PX
from rbpf.systems.mono.viewing import affines

CORNER_PX = 2.0
"""How well a corner is found again, per axis."""
LEAST_ALIKE, SHARP_PX = 0.8, 0.7
"""Correlation of a patch that says it better, and how well: it is taken to face the last view's camera."""
DEPTH_FRACTION = 0.5
"""Standard deviation of a corner's depth, as a fraction of that of the landmarks around."""
RATIO = 0.8
"""A corner's distance from the one most like it is below this fraction of that from the next (D. Lowe)."""
RIVAL_PX = 9.0
"""Places this near to each other may show one thing."""
LEAST = 30
"""Corners that must be found again: in images of different places about ten are, by chance."""


@final
class LastView:
    """An image and where it was taken.

    The depth of its corners is not known: each says on which line it must be seen. Hundreds of them determine how
    the camera turned and in which direction it went; how far, the map's landmarks say.

    Args:
        camera: of all images.
        image: (H, W) uint8.
        world_from_camera: (7,) in the world of the map's particle.
        detector: of the corners.
        descriptor: of the corners.
        count: of corners at most.
        spacing_px: their least distance.
        border_px: no corner is nearer to the border.
    """

    def __init__(
        self,
        camera: Pinhole,
        image: np.ndarray,
        world_from_camera: np.ndarray,
        detector: Detector,
        descriptor: Descriptor,
        count: int,
        spacing_px: float,
        border_px: float,
    ) -> None:
        self.camera = camera
        self.world_from_camera = world_from_camera
        border_px = max(border_px, SOURCE_HALF_PX + 1.0)
        within = camera.field_of_view_mask(border_px)
        keypoints = detector.detect(image, count, None, spacing_px, border_px, within)
        px = keypoints.px
        uv = camera.unproject(px)
        known = np.isfinite(uv).all(axis=1)
        self.windows = np.array([cut(image, place, SOURCE_HALF_PX) for place in px[known]])
        """(K, S, S) around the corners."""
        self.rays = np.concatenate([uv[known], np.ones((int(known.sum()), 1))], axis=1)
        """(K, 3) of the corners, in the camera's frame."""
        self.looks = descriptor.describe(image, keypoints.take(known))
        """(K, 128) their descriptors."""

    def seen_again(
        self, there: np.ndarray, px: np.ndarray, landmarks: np.ndarray
    ) -> tuple[np.ndarray, Sights] | None:
        """Its corners (P,) and where another image shows them; None where there are too few.

        Args:
            there: (S, M, 128) descriptors of places in the other image, at S sizes.
            px: (M, 2) these places.
            landmarks: (L, 3) in the world: the corners are about as far away as those in view.
        """
        held = SE3.inverse_transform(self.world_from_camera, landmarks)
        held = held[self.camera.visible(held), 2]
        if not held.size or self.rays.shape[0] < LEAST or px.shape[0] < LEAST:
            return None
        alike = (self.looks @ there.reshape(-1, there.shape[-1]).T).reshape(-1, *there.shape[:2]).max(axis=1)
        one, other = mutual(alike, px)
        if one.size < LEAST:
            return None
        points = SE3.transform(self.world_from_camera, float(np.median(held)) * self.rays[one])
        spread = DEPTH_FRACTION * (points - SE3.translation(self.world_from_camera))
        return one, Sights(points, spread, px[other], np.full(one.size, CORNER_PX))

    def sharpened(self, image: np.ndarray, rows: np.ndarray, sights: Sights, pose: np.ndarray) -> Sights:
        """The same corners (P,) where their patches, seen from a pose (7,), fit best; as they were where none fits."""
        place = np.concatenate([sights.points, np.ones((rows.size, 1))], axis=1)
        first = np.broadcast_to(self.world_from_camera, (rows.size, 7))
        templates = warp(self.windows[rows], affines(self.camera, place, first, pose))
        cov = np.tile(CORNER_PX**2 * np.eye(2), (rows.size, 1, 1))
        matches = search(image, templates, sights.px, cov)
        alike = matches.score >= LEAST_ALIKE
        px = np.where(alike[:, None], matches.px, sights.px)
        return replace(sights, px=px, std_px=np.where(alike, SHARP_PX, CORNER_PX))


def mutual(alike: np.ndarray, px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (P,), (P,) that are most alike both ways and clearly more than the next place.

    Args:
        alike: (K, M) products of descriptors of unit length.
        px: (M, 2) places; nearer than `RIVAL_PX` to the best they are no rivals of it.
    """
    best = alike.argmax(axis=1)
    rows = np.arange(best.size)
    near = np.linalg.norm(px[best][:, None] - px, axis=-1) <= RIVAL_PX
    next_best = np.where(near, -1.0, alike).max(axis=1)
    away, next_away = (np.sqrt(np.maximum(2.0 - 2.0 * a, 0.0)) for a in (alike[rows, best], next_best))
    kept = np.flatnonzero((alike.argmax(axis=0)[best] == rows) & (away <= RATIO * next_away))
    return kept, best[kept]
