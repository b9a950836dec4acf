"""Finds a lost camera in the map by what its landmarks look like, without a prediction."""

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.belief import Belief
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import PoseLaw
from rbpf.sensors.consensus_resection import Resected, refined, resect_consensus
from rbpf.sensors.corners import corners
from rbpf.sensors.keypoints import describe, describe_windows
from rbpf.sensors.patches import search, warp
from rbpf.sensors.pinhole import Pinhole
from rbpf.systems.mono.appearance import Appearances
from rbpf.systems.mono.config import RecoveryConfig
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.viewing import affines, turned

SCALES = (0.7, 1.0, 1.4)
"""Sizes at which the lost image is described, times that at which features are seen from the last trusted pose."""
BORDER_PX = 16.0
SAME = 0.05
"""Features this near to each other, in distances from the camera, may be one: they are no rivals of each other."""
RIVAL = 1.5
"""Places this near to each other, in least distances of corners, may show one thing."""
LARGEST_DISTANCE = 0.65
"""Of the descriptors of one thing, seen from places that are not too different: half of all others are further."""
CORNER_PX, LEAST_ALIKE = 2.0, 0.5
"""How well a corner is found again, per axis; the least correlation of a patch that says it better."""
MOST_ROUNDS = 10
"""Of a pose's refinement on what is seen around it."""
LEAST_SCALE, LARGEST_SCALE = 0.4, 1.2
"""A window that was kept is described at these sizes."""


@dataclass(frozen=True)
class Attempt:
    """How far the recognition of one image came.

    Attributes:
        landmarks: of known depth in the map.
        places: corners of the image.
        pairs: of a landmark and a place that are like each other and like nothing else.
        agreeing: pairs that a pose explains, after the search around it; 0 where no pose was computed.
        accepted: whether that was convincing.
    """

    landmarks: int
    places: int = 0
    pairs: int = 0
    agreeing: int = 0
    accepted: bool = False


@dataclass(frozen=True)
class Looks:
    """What is compared: an image and its corners (K, 2), and landmarks with their rows (L,) and points (L, 3)."""

    image: np.ndarray
    rows: np.ndarray
    points: np.ndarray
    px: np.ndarray


@final
class Relocaliser:
    """Finds the camera in the map.

    Args:
        sensor: that remembers what landmarks look like.
        config: when a pose is accepted.
    """

    def __init__(self, sensor: ImageSensor, config: RecoveryConfig) -> None:
        self.sensor = sensor
        self.config = config
        self.attempt: Attempt | None = None
        """The last one."""
        self._seen_from: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None

    def find(self, belief: Belief, image: np.ndarray, near: np.ndarray) -> PoseLaw | None:
        """Where the camera must be, if enough of the map's landmarks with known depth are seen.

        Args:
            belief: where they are, in the heaviest particle.
            image: (H, W) uint8.
            near: (7,) world_from_camera from which the landmarks' looks are predicted: the last trusted pose.

        Returns:
            The law in the heaviest particle's world; None where the camera is not found.
        """
        config, camera = self.config, self.sensor.camera
        rows, points = known_places(self.sensor, belief, config.depth_share)
        self.attempt = Attempt(rows.size)
        if rows.size < config.inliers:
            return None
        px, _ = corners(image, np.zeros((0, 2)), config.corners, config.spacing_px, BORDER_PX)
        self.attempt = replace(self.attempt, places=px.shape[0])
        if px.shape[0] < config.inliers:
            return None
        away = distances(self._looks(rows, points, near), image, px)
        size = np.linalg.norm(points - SE3.translation(near), axis=-1).mean()
        pairs = unmistakable(away, points / size, px / config.spacing_px, config.ratio)
        self.attempt = replace(self.attempt, pairs=pairs[0].size)
        # Drawn anew for each image: a run that is resumed draws the same.
        rng = np.random.default_rng(px.shape[0])
        looks = Looks(image, rows, points, px)
        places = self._sharp(looks, pairs, near)
        rough = resect_consensus(camera, points[pairs[0]], places, config.within_px, config.triples, rng)
        if rough is None:
            return None
        grown = self._grown(looks, rough.world_from_camera, away)
        if grown is None:
            return None
        found, places = grown
        accepted = convincing(found, places, camera.width, config)
        self.attempt = replace(self.attempt, agreeing=int(found.inliers.sum()), accepted=accepted)
        if not accepted:
            return None
        noise = config.inflation * max(found.rms_px, self.sensor.config.noise_px)
        return PoseLaw(
            found.world_from_camera, gaussian.symmetrise(noise**2 * np.linalg.inv(found.information))
        )

    def _sharp(
        self, looks: Looks, pairs: tuple[np.ndarray, np.ndarray], world_from_camera: np.ndarray
    ) -> np.ndarray:
        """Where in the image the landmarks of pairs are (M, 2): where their patches, seen from a pose, fit best.

        A corner is found again within a few pixels only. Where the patch is too unlike to say better, it stays.
        """
        rows, at = looks.rows[pairs[0]], looks.px[pairs[1]]
        table, config = self.sensor.table, self.sensor.config
        homogeneous = np.concatenate([looks.points[pairs[0]], np.ones((rows.size, 1))], axis=-1)
        sources, poses = nearest_looks(table, rows, homogeneous, world_from_camera)
        turn = affines(self.sensor.camera, homogeneous, poses, world_from_camera)
        templates = warp(sources, turn, config.template_px)
        cov = np.tile(CORNER_PX**2 * np.eye(2), (rows.size, 1, 1))
        matches = search(looks.image, templates, at, cov, sigmas=config.sigmas, most_px=config.largest_px)
        return np.where((matches.score >= LEAST_ALIKE)[:, None], matches.px, at)

    def _grown(self, looks: Looks, rough: np.ndarray, away: np.ndarray) -> tuple[Resected, np.ndarray] | None:
        """The pose (7,) refined on all that is found around it, again and again while it explains more of it.

        Few landmarks in one part of the image determine a pose that is right for them alone; from there it has to reach
        their neighbours first. With the places (M, 2) that were taken into account; None where nothing agrees.
        """
        best = None
        for _ in range(MOST_ROUNDS):
            pairs = expected(self.sensor.camera, rough, looks.points, looks.px, away, self.config.around_px)
            places = self._sharp(looks, pairs, rough)
            found = refined(self.sensor.camera, rough, looks.points[pairs[0]], places, self.config.within_px)
            if found is None or (best is not None and found.inliers.sum() <= best[0].inliers.sum()):
                break
            best, rough = (found, places), found.world_from_camera
        return best

    def _looks(self, rows: np.ndarray, points: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Descriptors (K, 128) of features, turned and scaled as they would be seen from a pose near by."""
        known, asked = self._seen_from, (rows, points, near)
        if known is not None and all(map(np.array_equal, known, asked)):
            return known[3]
        table = self.sensor.table
        homogeneous = np.concatenate([points, np.ones((rows.size, 1))], axis=-1)
        sources, poses = nearest_looks(table, rows, homogeneous, near)
        turn = affines(self.sensor.camera, homogeneous, poses, near)
        # Features behind the camera or at a grazing angle are described as they were seen at first.
        with np.errstate(all="ignore"):
            area = turn[:, 0, 0] * turn[:, 1, 1] - turn[:, 0, 1] * turn[:, 1, 0]
        scale = np.sqrt(np.abs(area))
        angle = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
        sane = np.isfinite(turn).all(axis=(1, 2)) & (scale > 0.25) & (scale < 4.0)
        scale, angle = np.where(sane, scale, 1.0), np.where(sane, angle, 0.0)
        looks = describe_windows(sources, np.clip(scale, LEAST_SCALE, LARGEST_SCALE), angle)
        self._seen_from = *asked, looks
        return looks


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


def known_places(sensor: ImageSensor, belief: Belief, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of the living features whose depth is known to this share, and where they are (K, 3)."""
    table = sensor.table
    rows = np.flatnonzero(table.alive)
    rows = rows[sensor.features.deep(belief, rows, table.member[rows], share)]
    which, places = sensor.features.places(belief, rows, table.member[rows])
    return rows[which], places[:, :3] / places[:, 3:]


def distances(looks: np.ndarray, image: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Least distance (L, K) of descriptors (L, 128) from those of places (K, 2) of an image, over `SCALES`."""
    scales = np.repeat(SCALES, px.shape[0])
    there = describe(image, np.tile(px, (len(SCALES), 1)), scales)
    alike = (looks @ there.T).reshape(looks.shape[0], len(SCALES), -1).max(axis=1)
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


def convincing(found: Resected, px: np.ndarray, width: int, config: RecoveryConfig) -> bool:
    """Enough landmarks agree, a fair share of those matched, and they do not lie on a line or in a corner."""
    count = int(found.inliers.sum())
    if count < max(config.inliers, config.inlier_share * found.inliers.size):
        return False
    places = px[found.inliers]
    narrow = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] / np.sqrt(count)
    return bool(narrow >= config.spread * width)
