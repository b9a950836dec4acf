"""Finds a lost camera in the map by what its landmarks look like, without a prediction."""

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.belief import Belief
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import PosePrior
from rbpf.sensors.camera.resection import (
    GATE,
    Resected,
    Sights,
    refined,
    refined_on_all,
    resect_consensus,
    squared_distances,
    three_point_poses,
)
from rbpf.sensors.features.interface import WINDOW_SCALE_PX
from rbpf.sensors.patches.search import search, warp
from rbpf.systems.mono.config import RelocalisationConfig
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.last_view import LEAST, LastView
from rbpf.systems.mono.likeness import (
    described,
    distances,
    expected,
    known_places,
    nearest_looks,
    unmistakable,
)
from rbpf.systems.mono.viewing import affines

BORDER_PX = 16.0
CORNER_PX, LEAST_ALIKE = 2.0, 0.5
"""How well a corner is found again, per axis; the least correlation of a patch that says it better."""
MOST_ROUNDS = 10
"""Of a pose's refinement on what is seen around it."""
MOST_FRACTION = 0.8
"""Of the corners of the last view that are found again, so many must show the motion that the map shows."""
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
        matched: corners of the last view before the loss that are found again; 0 where they were too few.
        confirming: of these, how many the pose explains.
        accepted: whether that was convincing.
    """

    landmarks: int
    places: int = 0
    pairs: int = 0
    agreeing: int = 0
    matched: int = 0
    confirming: int = 0
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

    def __init__(self, sensor: ImageSensor, config: RelocalisationConfig) -> None:
        self.sensor = sensor
        self.config = config
        self.attempt: Attempt | None = None
        """The last one."""
        self._seen_from: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None

    @property
    def sure(self) -> bool:
        """Whether the last image was recognised beyond doubt."""
        one, config = self.attempt, self.config
        return one is not None and (
            one.agreeing >= config.certain_inliers
            or confirmed(one.agreeing, one.confirming, one.matched, config)
        )

    def find(
        self, belief: Belief, image: np.ndarray, near: np.ndarray, last: LastView | None = None
    ) -> PosePrior | None:
        """Where the camera must be, if enough of the map's landmarks with known depth are seen.

        Args:
            belief: where they are, in the heaviest particle.
            image: (H, W) uint8.
            near: (7,) world_from_camera from which the landmarks' looks are predicted: the last trusted pose.
            last: the image from there, if there is one.

        Returns:
            The law in the heaviest particle's world; None where the camera is not found.
        """
        config, camera = self.config, self.sensor.camera
        rows, points = known_places(self.sensor, belief, config.depth_std_ratio)
        self.attempt = Attempt(rows.size)
        if rows.size < (config.min_inliers if last is None else config.min_inliers_with_last_view):
            return None
        within = camera.field_of_view_mask(BORDER_PX)
        px = self.sensor.detector.detect(
            image, config.max_corners, None, config.spacing_px, BORDER_PX, within
        ).px
        self.attempt = replace(self.attempt, places=px.shape[0])
        if px.shape[0] < config.min_inliers:
            return None
        there = described(self.sensor.descriptor, image, px)
        away = distances(self._looks(rows, points, near), there)
        size = np.linalg.norm(points - SE3.translation(near), axis=-1).mean()
        pairs = unmistakable(away, points / size, px / config.spacing_px, config.descriptor_ratio)
        again = None if last is None else last.seen_again(there, px, points)
        matched, view = (0, None) if again is None else (again[0].size, again[1])
        self.attempt = replace(self.attempt, pairs=pairs[0].size, matched=matched)
        looks = Looks(image, rows, points, px)
        rough = self._rough(points[pairs[0]], self._sharp(looks, pairs, near), view)
        if rough is None:
            return None
        if last is not None and again is not None:
            view = last.sharpened(image, *again, rough)
        grown = self._grown(looks, rough, away, view)
        if grown is None:
            return None
        found, places = grown
        confirming = 0
        if view is not None:
            confirming = int((squared_distances(camera, found.world_from_camera[None], view) <= GATE).sum())
        accepted = convincing(found, places, camera.width, config) or confirmed(
            int(found.inliers.sum()), confirming, matched, config
        )
        self.attempt = replace(
            self.attempt, agreeing=int(found.inliers.sum()), confirming=confirming, accepted=accepted
        )
        if not accepted:
            return None
        noise = config.std_inflation * max(found.rms_px, self.sensor.config.noise_px)
        return PosePrior(
            found.world_from_camera, gaussian.symmetrise(noise**2 * np.linalg.inv(found.information))
        )

    def _rough(self, points: np.ndarray, places: np.ndarray, view: Sights | None) -> np.ndarray | None:
        """The pose (7,) of three landmarks (M, 3) that most of them agree with, and the corners of the last view."""
        config, camera = self.config, self.sensor.camera
        # Drawn anew for each image: a run that is resumed draws the same.
        rng = np.random.default_rng(points.shape[0])
        if points.shape[0] < 3:
            return None
        both = None if view is None else self._rough_with(points, places, view, rng)
        if both is not None:
            return both
        found = resect_consensus(camera, points, places, config.inlier_px, config.p3p_samples, rng)
        return None if found is None else found.world_from_camera

    def _rough_with(
        self, points: np.ndarray, places: np.ndarray, view: Sights, rng: np.random.Generator
    ) -> np.ndarray | None:
        """The same with the corners of the last view; None where these show another motion, or none."""
        config, camera = self.config, self.sensor.camera
        poses = three_point_poses(points, camera.unproject(places), config.p3p_samples, rng)
        if not poses.shape[0]:
            return None
        both = known_sights(points, places, config.inlier_px) + view
        # A landmark says twice as much as a corner of unknown depth, and fixes the scale.
        weights = np.where(np.arange(both.std_px.size) < points.shape[0], 2.0, 1.0)
        losses = np.minimum(squared_distances(camera, poses, both), 4.0 * GATE) @ weights
        found = refined_on_all(camera, poses[losses.argmin()], both)
        if found is None or not agrees(found.inliers[points.shape[0] :]):
            return None
        return found.world_from_camera

    def _refined(
        self, rough: np.ndarray, points: np.ndarray, places: np.ndarray, view: Sights | None
    ) -> Resected | None:
        """A pose refined on landmarks, and on the corners of the last view if these agree; `inliers` of landmarks."""
        config, camera = self.config, self.sensor.camera
        alone = refined(camera, rough, points, places, config.inlier_px)
        if view is None:
            return alone
        found = refined_on_all(camera, rough, known_sights(points, places, config.inlier_px) + view)
        if found is None or not agrees(found.inliers[len(points) :]):
            return alone
        return replace(found, inliers=found.inliers[: len(points)])

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
        matches = search(
            looks.image, templates, at, cov, sigmas=config.ellipse_sigmas, most_px=config.max_radius_px
        )
        return np.where((matches.score >= LEAST_ALIKE)[:, None], matches.px, at)

    def _grown(
        self, looks: Looks, rough: np.ndarray, away: np.ndarray, view: Sights | None = None
    ) -> tuple[Resected, np.ndarray] | None:
        """The pose (7,) refined on all that is found around it, again and again while it explains more of it.

        Few landmarks in one part of the image determine a pose that is right for them alone; from there it has to reach
        their neighbours first. With the places (M, 2) that were taken into account; None where nothing agrees.
        """
        best = None
        for _ in range(MOST_ROUNDS):
            pairs = expected(
                self.sensor.camera, rough, looks.points, looks.px, away, self.config.match_radius_px
            )
            places = self._sharp(looks, pairs, rough)
            found = self._refined(rough, looks.points[pairs[0]], places, view)
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
        size = WINDOW_SCALE_PX * np.clip(scale, LEAST_SCALE, LARGEST_SCALE)
        looks = self.sensor.descriptor.describe_windows(sources, size, angle)
        self._seen_from = *asked, looks
        return looks


def convincing(found: Resected, px: np.ndarray, width: int, config: RelocalisationConfig) -> bool:
    """Enough landmarks agree, a fair fraction of those matched, and they do not lie on a line or in a corner."""
    count = int(found.inliers.sum())
    if count < max(config.min_inliers, config.min_inlier_fraction * found.inliers.size):
        return False
    places = px[found.inliers]
    narrow = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] / np.sqrt(count)
    return bool(narrow >= config.min_spread * width)


def confirmed(landmarks: int, corners_: int, of: int, config: RelocalisationConfig) -> bool:
    """Some landmarks agree, which fix the scale, and most of the last view's corners: these alone leave no doubt."""
    return landmarks >= config.min_inliers_with_last_view and corners_ >= max(LEAST, MOST_FRACTION * of)


def agrees(corners_: np.ndarray) -> bool:
    """Whether nearly all corners (K,) of the last view show the motion that the map shows.

    Where the map is torn they do not, and it is the map in which the camera has to be found.
    """
    return bool(corners_.sum() >= max(LEAST, MOST_FRACTION * corners_.size))


def known_sights(points: np.ndarray, px: np.ndarray, within_px: float) -> Sights:
    """Of landmarks (M, 3) at px (M, 2), which agree within so many pixels."""
    return Sights(points, np.zeros_like(points), px, np.full(len(px), within_px / np.sqrt(GATE)))
