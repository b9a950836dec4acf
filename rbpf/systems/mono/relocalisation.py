"""Tracking loss: the pose prior while the camera is lost, and relocalisation in the map.

A lost camera stays at its last trusted pose, with growing uncertainty. In each image it is relocalised without a prediction:
corners of the image are matched with the map's features by descriptors, triples of matches give poses (P3P), and one is
accepted if it has enough inliers. The last image before the loss helps: hundreds of its corners give the rotation since then
and the direction of the translation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, final

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import Kept, grey, integers, numbers, poses, truths
from rbpf.core.filter import Filter
from rbpf.core.models import Belief
from rbpf.core.particles import Particles, Prior, mixture_estimate
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
from rbpf.sensors.features import Keypoints
from rbpf.sensors.features.interface import WINDOW_SCALE_PX
from rbpf.sensors.patches.search import cut, search, warp
from rbpf.systems.mono.config import MonoConfig, RelocalisationConfig
from rbpf.systems.mono.feature_table import PATCH_HALF_PX, patch_affines
from rbpf.systems.mono.image_sensor import NO_IMAGE, ImageSensor, require_image

VIEWS_PER_FRAME = 2  #: Viewpoints of a known map tried per frame for a lost camera, in turn.
BORDER_PX = 16.0  #: Least distance of corners from the border.
#: Scales at which the lost image is described, relative to features seen from the last trusted pose.
SCALES = (0.7, 1.0, 1.4)
MIN_PATCH_SCALE, MAX_PATCH_SCALE = 0.4, 1.2  #: Range of scales at which a stored patch is described.
#: Largest distance of matching descriptors under similar views: half of all others are farther.
MAX_DISTANCE = 0.65
#: Features this close, relative to their depth, may be identical and are not rivals in the ratio test.
SAME_POINT = 0.05
SAME_CORNER = 1.5  #: Corners this close, in units of their least spacing, may show the same point.
#: Standard deviation of a re-detected corner, per axis; least correlation of a patch that refines it.
CORNER_PX, MIN_CORRELATION = 2.0, 0.5
MIN_FITTED = 3  #: Landmarks that determine the pose of another particle's world.
MAX_ROUNDS = 10  #: Maximum rounds of refining a pose on matches around its projections.
#: For corners of the last view: least correlation of a patch that refines it, and its standard deviation.
VIEW_CORRELATION, VIEW_PX = 0.8, 0.7
VIEW_DEPTH_RATIO = 0.5  #: Standard deviation of a corner's assumed depth, as a fraction of it.
VIEW_RATIO = 0.8  #: Ratio test of corners: best over second distance (D. Lowe).
VIEW_SAME_PX = 9.0  #: Corners of another image this close may show the same point.
MIN_VIEW_CORNERS = 30  #: Least matched corners: between images of different places about ten match by chance.
#: Fraction of the last view's matched corners that must agree with the motion by the map.
MIN_VIEW_FRACTION = 0.8


class Sighting(NamedTuple):
    """The pose of an image, from its matches with landmarks."""

    world_from_camera: np.ndarray  #: (7,).
    matches: tuple[np.ndarray, np.ndarray]  #: landmarks (M,) by row, and unambiguous matches (M, 2), px.
    agreeing: tuple[np.ndarray, np.ndarray]  #: likewise of the inliers, (A,) and (A, 2).
    noise_px: float  #: standard deviation of the inliers, per axis.


@dataclass(frozen=True)
class Attempt:
    """Result of a relocalisation attempt."""

    matches: int = 0  #: unambiguous matches of landmarks and corners.
    agreeing: int = 0  #: inliers of the pose, after the search around it; 0 without a pose.
    prior: PosePrior | None = None  #: the pose, for the heaviest particle's world; None if it was not accepted.
    certain: bool = False  #: whether the relocalisation is certain.
    sighting: Sighting | None = None  #: the pose, accepted or not; None without one.


@final
class TrackingLoss(Kept):
    """Stores the last trusted pose, and provides the pose prior while the camera is lost.

    A known map has viewpoints (V, 7) to try as well, and `size_m`: the standard deviation of the position until the camera is
    localised for the first time.
    """

    kept: ClassVar = {
        "_pose": poses(),
        "_cov": numbers(6, 6),
        "stamp_ns": integers(),
        "_image": grey("", ""),
        "_mode": poses(),
        "never_found": truths(),
    }
    prefix = "loss/"

    def __init__(
        self, sensor: ImageSensor, config: MonoConfig, views: np.ndarray | None = None, size_m: float = 0.0
    ) -> None:
        self.sensor = sensor
        self.config = config.relocalisation
        self.std_velocity = config.velocity.start_std()
        self.relocaliser = Relocaliser(sensor, config.relocalisation)
        self.views = np.zeros((0, 7)) if views is None else views
        self.size_m = size_m
        #: Whether the camera has not been localised yet in a known map.
        self.never_found = len(self.views) > 0
        self.stamp_ns = 0  #: Time of the last trusted pose.
        self._pose, self._cov = self.views[0] if self.never_found else SE3.identity(), np.zeros((6, 6))
        self._particles: Particles | None = None
        self._image = NO_IMAGE
        self._mode = SE3.identity()
        self._view: LastView | None = None

    def trust(self, filter_: Filter, image: np.ndarray | None) -> None:
        """Stores the particles after a step as the last trusted ones, with their image."""
        assert filter_.stamp_ns is not None
        particles = filter_.particles
        state = filter_.belief().map.world(particles.state[:, :7])
        self._particles, self.stamp_ns = Particles(state, particles.log_weights), filter_.stamp_ns
        self._image, self._view = NO_IMAGE if image is None else image, None
        self.never_found = False

    @property
    def trusted(self) -> tuple[np.ndarray, np.ndarray]:
        """The last trusted pose world_from_camera (7,) in the particles' world, and its covariance (6, 6)."""
        if self._particles is not None:
            # Averaged lazily, to save time while tracking.
            poses, log_weights = self._particles.state, self._particles.log_weights
            estimate = mixture_estimate(Prior.exactly(SE3, poses), None, log_weights)
            self._pose, self._cov, self._particles = estimate.mean, estimate.cov, None
            self._mode = poses[log_weights.argmax()].copy()
        return self._pose, self._cov

    def prior(self, filter_: Filter, image: np.ndarray | None) -> tuple[PosePrior, Attempt | None]:
        """Pose prior of a lost camera in the next frame: relocalised, else around the last trusted pose.

        Also returns the last relocalisation attempt.

        Extrapolating the last velocity for a second would be worse than staying, as hands turn back. Relocalisation starts
        from the last trusted pose; then from viewpoints of a known map, in the first frame from all of them, later from some
        in turn.
        """
        pose, cov = self.trusted
        attempt = None
        if image is not None:
            belief, count = filter_.belief(), len(self.views)
            if self._view is None and self._image.size:
                self._view = LastView(self.sensor, self._image, self._mode, self.config)
            attempt = self.relocaliser.find(belief, image, pose, self._view)
            tried = min(count, VIEWS_PER_FRAME if filter_.steps else count)
            for view in self.views[(filter_.steps * tried + np.arange(tried)) % max(count, 1)]:
                if attempt.prior is not None:
                    break
                attempt = self.relocaliser.find(belief, image, view)
            if attempt.prior is not None:
                found = attempt.prior
                # The covariance is in the camera's chart, independent of the particle's world.
                poses = self.relocaliser.in_all_worlds(belief, found.mean)
                return PosePrior(poses, found.cov, self.std_velocity), attempt
        std = np.repeat([self.config.search_std_rad, self.config.search_std_m], 3)
        return PosePrior(pose, cov + np.diag(std**2), self.std_velocity), attempt

    def drift(self, stamp_ns: int) -> np.ndarray:
        """Covariance (6, 6) of the camera's motion since the last trusted pose, [ω, v]."""
        if self.never_found:
            return np.diag(np.repeat([np.pi, self.size_m], 3) ** 2)
        seconds = (stamp_ns - self.stamp_ns) * 1e-9
        return np.diag((np.repeat([self.config.drift_rad_s, self.config.drift_m_s], 3) * seconds) ** 2)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint."""
        self._pose, self._cov = self.trusted
        return super().arrays()

    def restore(self, arrays: Mapping[str, np.ndarray], **sizes: int) -> None:
        """The inverse of `arrays`."""
        super().restore(arrays, **sizes)
        require_image(self._image, self.sensor.camera)
        self._particles = self._view = None


@dataclass(frozen=True)
class Candidates:
    """Inputs of the matching: an image and its corners (K, 2), landmarks by row (L,) and homogeneous points (L, 4)."""

    image: np.ndarray
    rows: np.ndarray
    positions: np.ndarray
    px: np.ndarray


@final
class Relocaliser:
    """Relocalises the camera in the map by the appearance of its features."""

    def __init__(self, sensor: ImageSensor, config: RelocalisationConfig) -> None:
        self.sensor = sensor
        self.camera = sensor.camera
        self.config = config
        self._described: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None
        self._looked_at: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def find(
        self,
        belief: Belief,
        image: np.ndarray,
        near: np.ndarray,
        last: "LastView | None" = None,
        among: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Attempt:
        """Relocalises the camera from an image (H, W) uint8, if it shows enough landmarks of known depth.

        Appearances are predicted from a nearby pose (7,), the last trusted one; `last` is the image from there. `among`
        restricts it to given landmarks, rows (K,) and world positions (K, 3).
        """
        config, camera = self.config, self.camera
        rows, points = self.known_landmarks(belief) if among is None else among
        if rows.size < (config.min_inliers if last is None else config.min_inliers_with_last_view):
            return Attempt()
        px, descriptors = self.corners(image)
        if px.shape[0] < config.min_inliers:
            return Attempt()

        # Match the landmarks' predicted appearances, and the last view, with the corners.
        candidates = Candidates(image, rows, np.insert(points, 3, 1.0, axis=1), px)
        products = similarities(self.describe_landmarks(candidates, near), descriptors)
        distances = np.sqrt(np.maximum(2.0 - 2.0 * products, 0.0))
        size = np.linalg.norm(points - SE3.translation(near), axis=-1).mean()
        pairs = match_by_ratio(distances, points / size, px / config.spacing_px, config.descriptor_ratio)
        again = None if last is None else last.match(descriptors, px, points)
        view, matched = (None, 0) if again is None else (again[1], again[0].size)
        attempt = Attempt(pairs[0].size)
        first = rows[pairs[0]], px[pairs[1]]

        # A consensus pose, then all matches around its projections.
        rough = self._consensus(points[pairs[0]], self.refine_px(candidates, pairs, near), view, belief.rng)
        if rough is None:
            return attempt
        if last is not None and again is not None:
            view = last.refine_px(image, *again, rough)
        best, places, best_pairs = None, px[:0], pairs[0][:0]
        for _ in range(MAX_ROUNDS):
            # Few landmarks in one part of the image determine a pose that is accurate only locally; it has to be extended to
            # their neighbours step by step.
            pairs = self._match_near(rough, points, px, distances)
            at = self.refine_px(candidates, pairs, rough)
            found = self._refined(rough, points[pairs[0]], at, view)
            if found is None or (best is not None and found.inliers.sum() <= best.inliers.sum()):
                break
            best, places, best_pairs, rough = found, at, pairs[0], found.world_from_camera
        if best is None:
            return attempt

        agreeing, confirming = int(best.inliers.sum()), 0
        if view is not None:
            confirming = int((squared_distances(camera, best.world_from_camera[None], view) <= GATE).sum())
        noise = max(best.rms_px, self.sensor.config.noise_px)
        seen = rows[best_pairs][best.inliers], places[best.inliers]
        sighting = Sighting(best.world_from_camera, first, seen, noise)
        attempt = replace(attempt, agreeing=agreeing, sighting=sighting)
        confirmed = is_confirmed(agreeing, confirming, matched, config)
        if not (confirmed or is_convincing(best, places, camera.width, config)):
            return attempt
        cov = gaussian.symmetrise((config.std_inflation * noise) ** 2 * np.linalg.inv(best.information))
        certain = confirmed or agreeing >= config.certain_inliers
        return replace(attempt, prior=PosePrior(best.world_from_camera, cov), certain=certain)

    def corners(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The best corners (K, 2) of an image and their descriptors (S, K, d) at `SCALES`, cached per image."""
        if self._looked_at is None or self._looked_at[0] is not image:
            px = image_corners(self.sensor, image, self.config, BORDER_PX).px
            scales = WINDOW_SCALE_PX * np.repeat(SCALES, px.shape[0])
            each = self.sensor.descriptor.describe(image, Keypoints.at(np.tile(px, (len(SCALES), 1)), scales))
            self._looked_at = image, px, each.reshape(len(SCALES), px.shape[0], each.shape[1])
        return self._looked_at[1:]

    def known_landmarks(self, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
        """Rows (K,) of the features in the map with known depth, and their positions (K, 3)."""
        features, rows = self.sensor.features, np.flatnonzero(self.sensor.table.alive)
        rows = rows[features.depth_known(belief, rows, self.config.depth_std_ratio)]
        which, position = features.positions(belief, rows)
        return rows[which], position[:, :3] / position[:, 3:]

    def in_all_worlds(self, belief: Belief, pose: np.ndarray) -> np.ndarray:
        """A pose (7,) of the heaviest particle's world in each particle's own (N, 7).

        It has the same pose relative to the landmarks in view: by the closest rigid motion of each particle, near landmarks
        weighted more. The map's deformation elsewhere does not matter.
        """
        rows, points = self.known_landmarks(belief)
        seen = SE3.inverse_transform(pose, points)
        in_view = self.camera.visible(seen)
        near = in_view if in_view.sum() >= self.config.min_inliers_with_last_view else np.ones_like(in_view)
        rows, seen = rows[near], seen[near]
        poses = np.empty((belief.log_weights.size, 7))
        which, all_places = self.sensor.features.positions_in(belief, rows, slice(None))
        for i, places in enumerate(all_places):
            ahead = places[:, 3] > 0.0
            poses[i] = pose
            if ahead.sum() >= MIN_FITTED:
                given = seen[which[ahead]]
                weights = 1.0 / np.square(given).sum(axis=1)
                poses[i] = SE3.closest(given, places[ahead, :3] / places[ahead, 3:], weights / weights.sum())
        return poses

    def describe_landmarks(self, candidates: Candidates, near: np.ndarray) -> np.ndarray:
        """Descriptors (L, d) of landmarks, warped to a nearby pose."""
        known, asked = self._described, (candidates.rows, candidates.positions, near)
        if known is not None and all(map(np.array_equal, known, asked)):
            return known[3]
        positions = candidates.positions
        patches, poses = self.sensor.table.nearest_appearance(candidates.rows, positions, near)
        affine = patch_affines(self.camera, positions, poses, near)
        # Features behind the camera or at a grazing angle are described by their first appearance.
        with np.errstate(all="ignore"):
            area = affine[:, 0, 0] * affine[:, 1, 1] - affine[:, 0, 1] * affine[:, 1, 0]
        scale = np.sqrt(np.abs(area))
        angle = np.arctan2(affine[:, 1, 0] - affine[:, 0, 1], affine[:, 0, 0] + affine[:, 1, 1])
        sane = np.isfinite(affine).all(axis=(1, 2)) & (scale > 0.25) & (scale < 4.0)
        scale, angle = np.where(sane, scale, 1.0), np.where(sane, angle, 0.0)
        size = WINDOW_SCALE_PX * np.clip(scale, MIN_PATCH_SCALE, MAX_PATCH_SCALE)
        descriptors = self.sensor.descriptor.describe_windows(patches, size, angle)
        self._described = *asked, descriptors
        return descriptors

    def refine_px(
        self, candidates: Candidates, pairs: tuple[np.ndarray, np.ndarray], world_from_camera: np.ndarray
    ) -> np.ndarray:
        """Refines the pixels (M, 2) of matched landmarks by correlation with their patches, warped to a pose.

        Corners are re-detected only to a few pixels. A match of low correlation keeps its corner's pixel.
        """
        rows, at, config = candidates.rows[pairs[0]], candidates.px[pairs[1]], self.sensor.config
        positions = candidates.positions[pairs[0]]
        patches, poses = self.sensor.table.nearest_appearance(rows, positions, world_from_camera)
        affines = patch_affines(self.camera, positions, poses, world_from_camera)
        templates = warp(patches, affines, config.template_px)
        cov = np.tile(CORNER_PX**2 * np.eye(2), (rows.size, 1, 1))
        sigmas, most_px = config.ellipse_sigmas, config.max_radius_px
        matches = search(candidates.image, templates, at, cov, sigmas=sigmas, most_px=most_px)
        return np.where((matches.score >= MIN_CORRELATION)[:, None], matches.px, at)

    def _match_near(
        self, world_from_camera: np.ndarray, points: np.ndarray, px: np.ndarray, distances: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pairs (M,), (M,) of landmarks and the most similar corner near their projections from a pose."""
        seen = SE3.inverse_transform(world_from_camera, points)
        near = np.linalg.norm(self.camera.project(seen)[:, None] - px, axis=-1) <= self.config.match_radius_px
        masked = np.where(near & self.camera.visible(seen)[:, None], distances, np.inf)
        best = masked.argmin(axis=1)
        chosen = masked[np.arange(best.size), best]
        return _one_each(best, chosen, chosen <= MAX_DISTANCE)

    def _consensus(
        self, points: np.ndarray, places: np.ndarray, view: Sights | None, rng: np.random.Generator
    ) -> np.ndarray | None:
        """The P3P pose (7,) with the best consensus of the landmarks (M, 3), and of the corners of the last view."""
        config, camera = self.config, self.camera
        if points.shape[0] < 3:
            return None
        if view is not None:
            poses = three_point_poses(points, camera.unproject(places), config.p3p_samples, rng)
            if poses.shape[0]:
                both = Sights.known(points, places, config.inlier_px / np.sqrt(GATE)) + view
                # A landmark has twice the information of a corner of unknown depth, and fixes the scale.
                weights = np.where(np.arange(both.std_px.size) < points.shape[0], 2.0, 1.0)
                losses = np.minimum(squared_distances(camera, poses, both), 4.0 * GATE) @ weights
                found = refined_on_all(camera, poses[losses.argmin()], both)
                if found is not None and most_agree(found.inliers[points.shape[0] :]):
                    return found.world_from_camera
        found = resect_consensus(camera, points, places, config.inlier_px, config.p3p_samples, rng)
        return None if found is None else found.world_from_camera

    def _refined(
        self, rough: np.ndarray, points: np.ndarray, places: np.ndarray, view: Sights | None
    ) -> Resected | None:
        """A pose refined on landmarks, and on the last view's corners if they agree; `inliers` are the landmarks'."""
        inlier_px = self.config.inlier_px
        if view is not None:
            std = inlier_px / np.sqrt(GATE)
            found = refined_on_all(self.camera, rough, Sights.known(points, places, std) + view)
            if found is not None and most_agree(found.inliers[len(points) :]):
                of_px = found.information * std**2  # in px of the landmarks, as without a view
                return Resected(found.world_from_camera, of_px, found.inliers[: len(points)], found.rms_px * std)
        return refined(self.camera, rough, points, places, inlier_px)


@final
class LastView:
    """The last image before a loss and its pose.

    The depth of its corners is unknown: each constrains the camera by its epipolar line. Hundreds of them determine the
    rotation and the direction of translation; the map's landmarks fix its length. `world_from_camera` (7,) is in the world of
    the map's particle.
    """

    def __init__(
        self, sensor: ImageSensor, image: np.ndarray, world_from_camera: np.ndarray, config: RelocalisationConfig
    ) -> None:
        self.camera = camera = sensor.camera
        self.world_from_camera = world_from_camera
        keypoints = image_corners(sensor, image, config, max(BORDER_PX, PATCH_HALF_PX + 1.0))
        uv = camera.unproject(keypoints.px)
        known = np.isfinite(uv).all(axis=1)
        #: (K, S, S) around the corners.
        self.patches = np.array([cut(image, place, PATCH_HALF_PX) for place in keypoints.px[known]])
        #: (K, 3) of the corners, in the camera's frame.
        self.rays = np.concatenate([uv[known], np.ones((int(known.sum()), 1))], axis=1)
        self.descriptors = sensor.descriptor.describe(image, keypoints.take(known))  #: (K, d).

    def match(self, descriptors: np.ndarray, px: np.ndarray, landmarks: np.ndarray) -> tuple[np.ndarray, Sights] | None:
        """Matches its corners (P,) with another image's, described at px (M, 2) at S scales; None with too few.

        They are assumed at about the depth of the landmarks (L, 3) in view.
        """
        held = SE3.inverse_transform(self.world_from_camera, landmarks)
        held = held[self.camera.visible(held), 2]
        if not held.size or min(self.rays.shape[0], px.shape[0]) < MIN_VIEW_CORNERS:
            return None
        one, other = mutual_matches(similarities(self.descriptors, descriptors), px)
        if one.size < MIN_VIEW_CORNERS:
            return None
        points = SE3.transform(self.world_from_camera, float(np.median(held)) * self.rays[one])
        spread = VIEW_DEPTH_RATIO * (points - SE3.translation(self.world_from_camera))
        return one, Sights(points, spread, px[other], np.full(one.size, CORNER_PX))

    def refine_px(self, image: np.ndarray, rows: np.ndarray, sights: Sights, pose: np.ndarray) -> Sights:
        """Refines the pixels of corners (P,) by correlation with their patches, warped to a pose (7,), where high enough."""
        position = np.concatenate([sights.points, np.ones((rows.size, 1))], axis=1)
        first = np.broadcast_to(self.world_from_camera, (rows.size, 7))
        templates = warp(self.patches[rows], patch_affines(self.camera, position, first, pose))
        cov = np.tile(CORNER_PX**2 * np.eye(2), (rows.size, 1, 1))
        matches = search(image, templates, sights.px, cov)
        alike = matches.score >= VIEW_CORRELATION
        px = np.where(alike[:, None], matches.px, sights.px)
        return replace(sights, px=px, std_px=np.where(alike, VIEW_PX, CORNER_PX))


def is_convincing(found: Resected, px: np.ndarray, width: int, config: RelocalisationConfig) -> bool:
    """Whether there are enough inliers, a sufficient fraction of the matches, spread in two directions of the image."""
    count = int(found.inliers.sum())
    if count < max(config.min_inliers, config.min_inlier_fraction * found.inliers.size):
        return False
    places = px[found.inliers]
    narrow = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] / np.sqrt(count)
    return bool(narrow >= config.min_spread * width)


def is_confirmed(landmarks: int, agreeing: int, matched: int, config: RelocalisationConfig) -> bool:
    """Whether some landmarks, which fix the scale, and most of the last view's corners agree."""
    least = max(MIN_VIEW_CORNERS, MIN_VIEW_FRACTION * matched)
    return landmarks >= config.min_inliers_with_last_view and agreeing >= least


def most_agree(agreeing: np.ndarray) -> bool:
    """Whether nearly all corners (K,) of the last view agree with the motion by the map.

    In an inconsistent map they do not, and the camera must be localised in the map.
    """
    return bool(agreeing.sum() >= max(MIN_VIEW_CORNERS, MIN_VIEW_FRACTION * agreeing.size))


def image_corners(sensor: ImageSensor, image: np.ndarray, config: RelocalisationConfig, border_px: float) -> Keypoints:
    """The best corners of an image, inside the lens' circle."""
    mask = sensor.camera.field_of_view_mask(border_px)
    return sensor.detector.detect(image, config.max_corners, None, config.spacing_px, border_px, mask)


def similarities(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Greatest product (L, K) of descriptors of unit length (L, d) with those of K places (S, K, d)."""
    products = (one @ other.reshape(-1, other.shape[-1]).T).reshape(-1, *other.shape[:2])
    return np.asarray(products.max(axis=1))


def match_by_ratio(
    distances: np.ndarray, points: np.ndarray, px: np.ndarray, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (M,), (M,) of landmarks and corners by D. Lowe's ratio test.

    Landmarks (L, 3) closer than `SAME_POINT` and corners (K, 2) closer than `SAME_CORNER` are not rivals.
    """
    best = distances.argmin(axis=1)
    chosen = distances[np.arange(best.size), best]
    other_corner = np.linalg.norm(px[best][:, None] - px, axis=-1) > SAME_CORNER
    other_point = np.linalg.norm(points[:, None] - points, axis=-1) > SAME_POINT
    next_corner = np.where(other_corner, distances, np.inf).min(axis=1)
    next_point = np.where(other_point, distances[:, best].T, np.inf).min(axis=1)
    return _one_each(best, chosen, chosen <= ratio * np.minimum(next_corner, next_point))


def _one_each(best: np.ndarray, chosen: np.ndarray, clear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of several landmarks at one corner only the most similar is kept: others are wrong, or identical."""
    order = np.flatnonzero(clear)[np.argsort(chosen[clear], kind="stable")]
    _, first = np.unique(best[order], return_index=True)
    kept = np.sort(order[first])
    return kept, best[kept]


def mutual_matches(alike: np.ndarray, px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mutual best pairs (P,), (P,) by products (K, M) that pass the ratio test against other positions.

    Positions (M, 2) closer than `VIEW_SAME_PX` to the best are not rivals.
    """
    best = alike.argmax(axis=1)
    rows = np.arange(best.size)
    near = np.linalg.norm(px[best][:, None] - px, axis=-1) <= VIEW_SAME_PX
    next_best = np.where(near, -1.0, alike).max(axis=1)
    away, next_away = (np.sqrt(np.maximum(2.0 - 2.0 * a, 0.0)) for a in (alike[rows, best], next_best))
    kept = np.flatnonzero((alike.argmax(axis=0)[best] == rows) & (away <= VIEW_RATIO * next_away))
    return kept, best[kept]
