"""Which landmarks and which places of an image are like each other."""

import numpy as np

from rbpf.core.belief import Belief
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.features import Descriptor, Keypoints
from rbpf.sensors.features.interface import WINDOW_SCALE_PX
from rbpf.systems.mono.appearance import Appearances
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.viewing import turned

SCALES = (0.7, 1.0, 1.4)
"""Sizes at which the lost image is described, times that at which features are seen from the last trusted pose."""
SAME = 0.05
"""Features this near to each other, in distances from the camera, may be one: they are no rivals of each other."""
RIVAL = 1.5
"""Places this near to each other, in least distances of corners, may show one thing."""
LARGEST_DISTANCE = 0.65
"""Of the descriptors of one thing, seen from places that are not too different: half of all others are further."""


def nearest_looks(
    table: Appearances, rows: np.ndarray, place: np.ndarray, world_from_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of features at homogeneous places (K, 4), the windows (K, S, S) that were kept from the side nearest to a pose.

    And the poses (K, 7) from which that was.
    """
    first, last = table.first_pose[rows], table.last_pose[rows]
    of_first, of_last = (turned(place, pose, world_from_camera)[0] for pose in (first, last))
    later = of_last > of_first
    sources = np.where(later[:, None, None], table.last_source[rows], table.source[rows])
    return sources, np.where(later[:, None], last, first)


def known_places(sensor: ImageSensor, belief: Belief, fraction: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of the living features whose depth is known to this fraction, and where they are (K, 3)."""
    table = sensor.table
    rows = np.flatnonzero(table.alive)
    rows = rows[sensor.features.deep(belief, rows, table.member[rows], fraction)]
    which, places = sensor.features.places(belief, rows, table.member[rows])
    return rows[which], places[:, :3] / places[:, 3:]


def described(descriptor: Descriptor, image: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Descriptors (S, K, 128) of places (K, 2) of an image, at `SCALES`."""
    scales = WINDOW_SCALE_PX * np.repeat(SCALES, px.shape[0])
    looks = descriptor.describe(image, Keypoints.at(np.tile(px, (len(SCALES), 1)), scales))
    return looks.reshape(len(SCALES), px.shape[0], looks.shape[1])


def distances(looks: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Least distance (L, K) of descriptors (L, 128) from those of K places (S, K, 128)."""
    alike = (looks @ there.reshape(-1, there.shape[-1]).T).reshape(-1, *there.shape[:2]).max(axis=1)
    return np.asarray(np.sqrt(np.maximum(2.0 - 2.0 * alike, 0.0)))


def unmistakable(
    away: np.ndarray, points: np.ndarray, px: np.ndarray, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (M,), (M,) of landmark and place that are like each other and like nothing else (D. Lowe's ratio).

    Args:
        away: (L, K) distances of descriptors.
        points: (L, 3) of the landmarks; nearer than `SAME` they are no rivals.
        px: (K, 2) of the places; nearer than `RIVAL` they are no rivals.
        ratio: of the distances from the best and the next.
    """
    best = away.argmin(axis=1)
    chosen = away[np.arange(best.size), best]
    other_place = np.linalg.norm(px[best][:, None] - px, axis=-1) > RIVAL
    other_point = np.linalg.norm(points[:, None] - points, axis=-1) > SAME
    next_place = np.where(other_place, away, np.inf).min(axis=1)
    next_point = np.where(other_point, away[:, best].T, np.inf).min(axis=1)
    return _one_each(best, chosen, chosen <= ratio * np.minimum(next_place, next_point))


def expected(
    camera: Pinhole,
    world_from_camera: np.ndarray,
    points: np.ndarray,
    px: np.ndarray,
    away: np.ndarray,
    around_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (M,), (M,) of landmark and the place most like it near to where it should be seen from a pose."""
    seen = SE3.inverse_transform(world_from_camera, points)
    near = np.linalg.norm(camera.project(seen)[:, None] - px, axis=-1) <= around_px
    masked = np.where(near & camera.visible(seen)[:, None], away, np.inf)
    best = masked.argmin(axis=1)
    chosen = masked[np.arange(best.size), best]
    return _one_each(best, chosen, chosen <= LARGEST_DISTANCE)


def _one_each(best: np.ndarray, chosen: np.ndarray, clear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of several landmarks at one place only the most alike counts: one is mistaken, or they are the same."""
    order = np.flatnonzero(clear)[np.argsort(chosen[clear], kind="stable")]
    _, first = np.unique(best[order], return_index=True)
    kept = np.sort(order[first])
    return kept, best[kept]
