"""Measures a frame: checks the image, searches the map's features, manages them, and initialises new ones at corners."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, grey, integers, read_one, truths
from rbpf.core.models import Belief, NewLandmarks, Observations, Part, Sensor
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.joint_map import JointMap
from rbpf.maps.rows import MAP
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.features import CornerDetector, Descriptor, Detector, Sift, SiftConfig
from rbpf.sensors.patches.search import cut
from rbpf.systems.mono.active_search import ActiveSearch, OutlierGate, SearchResult
from rbpf.systems.mono.config import SearchConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.feature_table import PATCH_HALF_PX, FeatureTable, view_change

#: Points of a known map that determine the pose; with fewer in view the camera has left the map, and nothing new is mapped.
MIN_FIXED = 4
MIN_CONTRAST = 10  #: Range of grey levels below which the image is that of a lens cap.
UNIFORM = 12  #: Range of grey levels of a row or column up to which it counts as uniform, despite compression.
MAX_REPEATS = 5  #: Allowed repetitions of an image: drivers repeat single images when the camera is late.


def no_features(stamp_ns: int = 0) -> FeatureFrame:
    """A frame in which nothing was measured."""
    return FeatureFrame(stamp_ns, np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)))


def inside_bars(image: np.ndarray, border_px: int, within: np.ndarray | None) -> np.ndarray | None:
    """A mask (H, W), or None for everywhere, reduced to pixels away from uniform bars (letterbox) at the image's edges."""
    if all(np.ptp(line) > UNIFORM for line in (image[0], image[-1], image[:, 0], image[:, -1])):
        return within
    inside = np.ones(image.shape, dtype=bool) if within is None else within.copy()
    for axis, across in ((1, inside), (0, inside.T)):
        lines = np.flatnonzero(np.ptp(image, axis=axis) > UNIFORM)
        if lines.size and lines[0] > 0:
            across[: lines[0] + border_px] = False
        if lines.size and lines[-1] < len(across) - 1:
            across[lines[-1] + 1 - border_px :] = False
    return inside


@dataclass
class Measurement:
    """One image in the filter's step: the sensor's input and its results."""

    stamp_ns: int  #: time of the image.
    image: np.ndarray | None  #: (H, W) uint8; None if it is not usable.
    #: (M, 2) pixels of the known points in the run's first image; None in all others.
    known_px: np.ndarray | None = None
    #: the pose prior is from a certain relocalisation, which needs fewer matches to be confirmed.
    recognised: bool = False
    starting: bool = False  #: the first frames are still being adjusted, as depths are unknown.
    search: SearchResult = field(default_factory=SearchResult)  #: result of the search.
    #: features used by the filter; none if too few agreed.
    used: FeatureFrame = field(default_factory=no_features)
    started: FeatureFrame = field(default_factory=no_features)  #: features initialised after the step.
    seconds_search: float = 0.0  #: time that the search took.
    seconds_new_landmarks: float = 0.0  #: time of feature management.

    @property
    def features(self) -> FeatureFrame:
        """Features used, and features initialised."""
        pairs = ((getattr(self.used, name), getattr(self.started, name)) for name in ("landmarks", "z", "cov_z"))
        return FeatureFrame(self.stamp_ns, *map(np.concatenate, pairs))


NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)  #: Placeholder in checkpoints for no image.


def require_image(array: np.ndarray, camera: Pinhole) -> None:
    """Raises InputError: an image of a checkpoint has another size than the camera's."""
    if array.size and array.shape != (camera.height, camera.width):
        raise InputError(f"an image has shape {array.shape}, the camera's is {camera.height, camera.width}")


@final
class ImageScreen(Kept):
    """Rejects unusable images: wrong size or type, a lens cap, a frozen camera."""

    kept: ClassVar = {"_last": grey("", ""), "_repeats": integers(least=0), "_was_unusable": truths()}
    prefix = "screen/"

    def __init__(self, camera: Pinhole) -> None:
        self.camera = camera
        self._last = NO_IMAGE
        self._repeats = 0
        self._was_unusable = False

    def usable(self, image: np.ndarray | None) -> tuple[np.ndarray | None, str | None]:
        """The next image, or None if unusable; and the reason, only for the first such image in a row."""
        if image is None:
            return None, None
        wanted, found = (self.camera.height, self.camera.width), type(image).__name__
        if isinstance(image, np.ndarray):
            found = f"{image.shape} {image.dtype}"
        if not isinstance(image, np.ndarray) or image.shape != wanted or image.dtype != np.uint8:
            expected = f"{self.camera.width}x{self.camera.height} grey levels of 8 bits"
            return None, f"the image is not used: expected {expected}, got {found}"
        image = image.copy()  # a camera's driver may write the next image into the same memory
        is_same = np.array_equal(image, self._last)
        self._last, self._repeats = image, self._repeats + 1 if is_same else 0
        reason = None
        if int(image.max()) - int(image.min()) < MIN_CONTRAST:
            reason = "the image shows nothing, its grey levels are all alike: it is not used"
        elif self._repeats >= MAX_REPEATS:
            times = f"the {MAX_REPEATS + 1}th time"
            reason = f"the image is the same for {times}, the camera may be frozen: it is not used"
        was_unusable, self._was_unusable = self._was_unusable, reason is not None
        if reason is None:
            return image, None
        return None, None if was_unusable else reason

    def restore(self, arrays: Mapping[str, np.ndarray], **sizes: int) -> None:
        """The inverse of `arrays`."""
        super().restore(arrays, **sizes)
        require_image(self._last, self.camera)


@final
class ImageSensor(Sensor):
    """Searches the map's features in images, and detects new ones. It takes a `Measurement` and completes it.

    A feature's name is its row in `table`. The detector finds corners for new features and for relocalisation; the descriptor
    distinguishes the latter.
    """

    def __init__(
        self,
        features: FeatureSensor,
        config: SearchConfig,
        gate: OutlierGate | None = None,
        detector: Detector | None = None,
        descriptor: Descriptor | None = None,
    ) -> None:
        self.features = features
        self.config = config
        self.table = FeatureTable()
        self.search = ActiveSearch(features, self.table, config, gate)
        self.detector = detector or CornerDetector()
        self.descriptor = descriptor or Sift(SiftConfig(working_scale=1.0, length=128))
        self.bad_frames = 0  #: Consecutive frames with too few matches.
        self._within = self.camera.field_of_view_mask(PATCH_HALF_PX + 1.0)

    @property
    def camera(self) -> Pinhole:
        """The camera, with its current self-calibration."""
        return self.features.camera

    @property
    def lost(self) -> bool:
        """Whether tracking is lost."""
        return self.bad_frames >= self.config.lost_frames

    def begin(self, image: np.ndarray, known_px: np.ndarray, is_group: bool) -> None:
        """Adds the known points from the first image, at known_px (M, 2); is_group: as a constellation."""
        padded = np.pad(image, PATCH_HALF_PX + 1, mode="edge")  # known points may be at the border
        patches = [cut(padded, px + PATCH_HALF_PX + 1.0, PATCH_HALF_PX) for px in known_px]
        member = np.arange(known_px.shape[0]) if is_group else -1
        self.table.add(np.array(patches), known_px, SE3.identity(), member)

    def begin_lost(
        self, patches: np.ndarray, first_px: np.ndarray, first_pose: np.ndarray, positions: np.ndarray
    ) -> None:
        """Adds the points (K, 3) of a known map, in which the camera has to be localised.

        Their first appearances are patches (K, S, S) uint8 at first_px (K, 2), from first_pose (K, 7) world_from_camera.
        """
        rows = self.table.add(patches, first_px, first_pose)
        self.table.position[rows] = np.concatenate([positions, np.ones((rows.size, 1))], axis=1)
        self.bad_frames = self.config.lost_frames

    def observe(self, frame: Measurement, belief: Belief) -> Sequence[Observations]:
        """Matches of the features in view."""
        started = time.perf_counter()
        if isinstance(belief.map, JointMap):
            self._follow_sub_maps(belief.map, self.features.pose(belief))
        if frame.known_px is not None:
            rows, px = np.arange(frame.known_px.shape[0]), frame.known_px
            frame.used = self._features(frame.stamp_ns, rows, px)
        elif self.table.alive.any():
            if frame.image is not None:
                frame.search = self.search.run(frame.image, belief, frame.starting)
            self.bad_frames = self.bad_frames + 1 if self._too_little(frame.search, frame.recognised) else 0
            found = frame.search.found & (not self.bad_frames)
            frame.used = self._features(frame.stamp_ns, frame.search.features[found], frame.search.px[found])
        else:
            self.bad_frames = 0 if frame.image is not None else self.bad_frames + 1
        frame.seconds_search = time.perf_counter() - started
        # The constellation has already been initialised by the first image.
        is_placed = frame.known_px is not None and self.features.group is not None
        return [] if is_placed else self.observations(frame.used, belief)

    def observations(self, used: FeatureFrame, belief: Belief) -> list[Observations]:
        """Observations of matches; untrusted features only update the map, and a joint map not at all."""
        trusted = self.table.trusted(used.landmarks, self.config.trusted_fraction)
        if trusted.all():
            return list(self.features.observe(used, belief))
        of_trusted, others = (self.features.observe(used.take(rows), belief) for rows in (trusted, ~trusted))
        if isinstance(belief.map, JointMap):
            return list(of_trusted)
        only_map = [replace(group, updates=MAP) for group in others if Part.LANDMARK in group.updates]
        return [*of_trusted, *only_map]

    def new_landmarks(
        self, frame: Measurement, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """Counts matches, drops failing features, and initialises features at corners where there is room."""
        started = time.perf_counter()
        rows, table, config = frame.search.features, self.table, self.config
        failing = np.zeros(0, dtype=np.int64)
        if rows.size and not self.bad_frames:
            table.count_search(rows, frame.search.found)
            if not self.features.fixed:
                failing = rows[table.failing(rows, config)]
                table.alive[failing] = False
                failing = failing[table.member[failing] < 0]
        self.place(belief, frame.used.landmarks)
        pose = self.features.pose(belief)
        if frame.image is not None and not self.bad_frames:
            self._keep_appearances(frame.image, frame.used, pose)
            frame.started = self._started(frame, frame.image, pose)
        new_landmarks = self.features.start(frame.features, belief, observed)
        for group in new_landmarks:
            records = group.model.initialise(pose[None], group.z, np.zeros((len(group.z), 2, 2)))
            const = None if records.const is None else records.const[0]
            x, w = self.features.unknown_depth.model.world_point(records.mean[0], const)
            self.table.position[group.ids] = np.concatenate([x, w], axis=-1)
        self.features.remove(belief, failing)
        table.alive[self.features.make_room(belief, frame.features.landmarks)] = False
        frame.seconds_new_landmarks = time.perf_counter() - started
        return new_landmarks

    def _follow_sub_maps(self, joint: JointMap, pose: np.ndarray) -> None:
        """Follows the features of a joint map; requests old points that should be in view from a pose (7,)."""
        table, held, most = self.table, joint.ids, joint.submap or 0
        table.alive[:] = False
        table.alive[held] = True
        table.alive[joint.leaving] = False
        old, places = joint.old.places()
        if not old.size or self.bad_frames:
            return
        away = ~joint.holds(old)
        table.position[old[away]] = np.insert(places[away], 3, 1.0, axis=1)
        wanted = np.zeros(len(table), dtype=bool)
        wanted[old[away & ~table.failing(old, self.config) & self.features.expected(joint, old)]] = True
        rows, _ = self.search.in_view(pose, wanted)
        joint.bring_back(rows[: max(min(most // 4, 2 * most - held.size), 0)])

    def resampled(self, belief: Belief, names: np.ndarray, first_pose: np.ndarray) -> None:
        """Stores the positions of all features, and the poses (F, 7) of first observation of names (F,) on a new path."""
        table = self.table
        if self.features.group is None:
            table.member[:] = -1
        table.alive &= belief.map.holds(np.arange(len(table)))  # not those initialised in a frame that was not adjusted
        table.first_pose[names] = table.last_pose[names] = first_pose
        table.last_patch[names] = table.first_patch[names]  # later appearances are from the old path
        self.place(belief, np.flatnonzero(table.alive))

    def move(self, new_from_old: np.ndarray) -> None:
        """Transforms positions and viewpoints of features to a new world (7,), or (F, 7) per feature."""
        table = self.table
        table.first_pose[:], table.last_pose[:] = (
            SE3.compose(new_from_old, poses) for poses in (table.first_pose, table.last_pose)
        )
        x, w = table.position[:, :3], table.position[:, 3:]
        table.position[:, :3] = SE3.transform(new_from_old, x) + (w - 1.0) * SE3.translation(new_from_old)

    def place(self, belief: Belief, rows: np.ndarray) -> None:
        """Stores the current positions of features in the heaviest particle's world."""
        if rows.size:
            which, position = self.features.positions(belief, rows)
            self.table.position[rows[which]] = position

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint."""
        return self.table.arrays() | {
            "search/bad_frames": np.array(self.bad_frames),
            "search/is_fast": np.array(self.search.is_fast),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        group = self.features.group
        self.table.restore(arrays, 0 if group is None else group.names.size)
        self.bad_frames = int(read_one(arrays, "search/bad_frames", integers(least=0)))
        self.search.is_fast = bool(read_one(arrays, "search/is_fast", truths()))

    def _too_little(self, search: SearchResult, recognised: bool) -> bool:
        """Whether the matches may be by chance. Once lost, more have to agree, as the pose prior is wide.

        Then only features whose whole ellipse was searched are evidence: in a larger one similar features match by chance, or
        the right one is missed. After a certain relocalisation it suffices that tracking continues, as patches look different
        from there.
        """
        found, config = search.found, self.config
        if not found.size or (self.features.fixed and found.sum() < MIN_FIXED):
            return True
        if not self.lost:
            return bool(found.mean() < config.lost_fraction)
        least = min(config.recovered_features, int(self.table.alive.sum()))
        radius = config.ellipse_sigmas * np.sqrt(np.einsum("kii->ki", search.cov).max(axis=1))
        found = found[recognised | (radius <= config.max_radius_px)]
        fraction = config.lost_fraction if recognised else config.recovered_fraction
        return bool(found.sum() < max(least, fraction * found.size))

    def _keep_appearances(self, image: np.ndarray, used: FeatureFrame, pose: np.ndarray) -> None:
        """Renews the last appearance of features under changed viewing conditions.

        A patch's orientation is unknown. If it is assumed to face the first camera, it is similar up to about 25° from there;
        a lost camera that returns from another side would not recognise it.
        """
        rows, px = used.landmarks, used.z
        if not rows.size:
            return
        config, table = self.config, self.table
        cosine, ratio = view_change(table.position[rows], pose, table.last_pose[rows])
        is_turned = cosine <= np.cos(np.deg2rad(config.appearance_turn_deg))
        is_scaled = np.maximum(ratio, 1.0 / ratio) >= config.appearance_scale_change
        for k in np.flatnonzero(is_turned | is_scaled):
            patch = cut(image, px[k], PATCH_HALF_PX)
            if patch is not None:
                table.last_patch[rows[k]], table.last_pose[rows[k]] = patch, pose

    def _started(self, frame: Measurement, image: np.ndarray, pose: np.ndarray) -> FeatureFrame:
        """New features at corners, if there is room in the image and in the number searched."""
        config, used, in_view = self.config, frame.used, frame.search.in_view
        room = config.measurements - used.landmarks.size
        if len(self.table) > used.landmarks.size:
            room = min(config.min_in_view - in_view.shape[0], config.new_per_frame)
        room = min(room, self.features.max_new_per_frame)
        if room <= 0:
            return no_features(frame.stamp_ns)
        occupied, border_px = np.concatenate([used.z, in_view]), PATCH_HALF_PX + 1.0
        within = inside_bars(image, int(border_px), self._within)
        found = self.detector.detect(image, room, occupied, config.spacing_px, border_px, within)
        px = found.px
        px = px[np.isfinite(self.camera.unproject(px)).all(axis=1)]
        if not px.shape[0]:
            return no_features(frame.stamp_ns)
        patches = np.array([cut(image, place, PATCH_HALF_PX) for place in px])
        return self._features(frame.stamp_ns, self.table.add(patches, px, pose), px)

    def _features(self, stamp_ns: int, rows: np.ndarray, px: np.ndarray) -> FeatureFrame:
        cov = np.repeat(self.config.noise_px**2 * np.eye(2)[None], rows.size, axis=0)
        return FeatureFrame(stamp_ns, rows, px, cov)
