"""Active search (E06 §4.1): the belief says where to look, and `FeatureSensor` takes what is there."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import final

import numpy as np

from rbpf.core.belief import Belief
from rbpf.core.models import NewLandmarks, Observations, Part, Sensor
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera.points import CameraRay
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.features import CornerDetector, Descriptor, Detector, Sift, SiftConfig
from rbpf.sensors.patches.search import cut
from rbpf.sensors.readers.images import ImageFrame
from rbpf.systems.mono.active_search import ActiveSearch, Searched
from rbpf.systems.mono.appearance import SOURCE_HALF_PX, Appearances
from rbpf.systems.mono.config import SearchConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.viewing import turned

LEAST_SEEN = 4
"""Points of a known map that tell where the camera is; one that sees fewer has left the map, nothing new is mapped."""

_MAP = frozenset({Part.LANDMARK})


@final
class ImageSensor(Sensor):
    """Finds the features of the map in images, and new ones.

    Args:
        features: what turns found features into observations and landmarks; a feature's name is its row in `table`.
        config: settings of the search.
        detector: finds the corners that become landmarks, and those by which a lost camera is found.
        descriptor: tells them apart where a camera was lost.
    """

    def __init__(
        self,
        features: FeatureSensor,
        config: SearchConfig,
        detector: Detector | None = None,
        descriptor: Descriptor | None = None,
    ) -> None:
        self.features = features
        self.camera = features.camera
        self.config = config
        self.detector = detector or CornerDetector()
        self.descriptor = descriptor or Sift(SiftConfig(working_scale=1.0, length=128))
        self.table = Appearances()
        self.search = ActiveSearch(features, self.table, config)
        self.searched = Searched.nothing()
        self.measured = self._features(0, np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
        self.bad_frames = 0
        self._within = self.camera.field_of_view_mask(SOURCE_HALF_PX + 1.0)
        self._given: np.ndarray | None = None
        self.recognised = False
        """Whether the prediction of a lost camera is a place that was recognised beyond doubt."""
        self.seconds = 0.0
        """Time of the last search."""
        self.seconds_new_landmarks = 0.0
        """Time of the last `new_landmarks`."""

    @property
    def lost(self) -> bool:
        """Whether the camera is not where the filter believes."""
        return self.bad_frames >= self.config.lost_frames

    def begin(self, image: np.ndarray, known_px: np.ndarray, as_group: bool) -> None:
        """Takes the known points from the first image, where they are at known_px (M, 2).

        Args:
            image: the first one.
            known_px: (M, 2).
            as_group: whether they are one landmark, a constellation, or landmarks of their own.

        Raises:
            InputError: one is too near to the border.
        """
        members = np.arange(known_px.shape[0]) if as_group else None
        padded = np.pad(image, SOURCE_HALF_PX + 1, mode="edge")  # a known point may lie at the border
        source = np.array([self._window(padded, px + SOURCE_HALF_PX + 1.0) for px in known_px])
        self.table.add(source, known_px, SE3.identity(), members)
        self._given = known_px

    def begin_lost(
        self, windows: np.ndarray, first_px: np.ndarray, first_pose: np.ndarray, positions: np.ndarray
    ) -> None:
        """Takes the points of a map that is known, K of them; where in it the camera is has to be found out.

        Args:
            windows: (K, S, S) uint8 around their first sightings.
            first_px: (K, 2) where those were.
            first_pose: (K, 7) world_from_camera then.
            positions: (K, 3) of the points.
        """
        rows = self.table.add(windows, first_px, first_pose)
        self.table.place[rows] = np.concatenate([positions, np.ones((rows.size, 1))], axis=1)
        self.bad_frames = self.config.lost_frames

    def observe(self, frame: ImageFrame, belief: Belief) -> Sequence[Observations]:
        """What is found of the features that should be seen."""
        started = time.perf_counter()
        rows, px = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        self.searched = Searched.nothing()
        if self._given is not None:
            rows, px, self._given = np.arange(self._given.shape[0]), self._given, None
        elif self.table.alive.any():
            if frame.image is not None:
                self.searched = self.search.run(frame.image, belief)
                found = self.searched.found
                rows, px = self.searched.rows[found], self.searched.px[found]
            self.bad_frames = self.bad_frames + 1 if self._fails() else 0
            if self.bad_frames:
                rows, px = rows[:0], px[:0]
        else:
            self.bad_frames = 0 if frame.image is not None else self.bad_frames + 1
        self.measured = self._features(frame.stamp_ns, rows, px)
        self.seconds = time.perf_counter() - started
        return self._observations(belief)

    def new_landmarks(
        self, frame: ImageFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """Notes what was found, drops what fails, and starts features at corners where there is room."""
        started = time.perf_counter()
        failing = self._judge()
        self._place(belief, self.measured.landmarks)
        sightings = self.measured
        if frame.image is not None and not self.bad_frames:
            self._keep_looks(frame.image, belief)
            sightings = self._with_corners(frame, belief)
        new_landmarks = self.features.new_landmarks(sightings, belief, observed)
        self._place_rays(belief, new_landmarks)
        self.features.forget(belief, failing)
        self.seconds_new_landmarks = time.perf_counter() - started
        return new_landmarks

    def drawn_anew(self, belief: Belief, path: np.ndarray, started: np.ndarray) -> None:
        """Remembers where all features are and were seen first, after the particles were drawn anew.

        Args:
            belief: of the new particles.
            path: (T, 7) of the heaviest one.
            started: (F,) in which of the T frames each feature of the table was started.
        """
        table, rows = self.table, np.arange(started.size)
        held = np.isin(rows, list(belief.catalogue.values()))
        table.alive[rows[~held]] = False  # started in a frame that did not take part
        table.first_pose[rows] = table.last_pose[rows] = path[started]
        table.last_source[rows] = table.source[rows]  # later looks are from the old path
        self._place(belief, rows[held & table.alive[rows]])

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return self.table.arrays() | {"search/bad_frames": np.array(self.bad_frames)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self.table.restore(arrays)
        self.bad_frames = int(arrays["search/bad_frames"])
        self._given = None

    def _observations(self, belief: Belief) -> list[Observations]:
        """Of what was measured; what is not trusted only updates the map."""
        frame = self.measured
        trusted = self.search.trusted(frame.landmarks)
        if trusted.all():
            return list(self.features.observe(frame, belief))
        doubted = self.features.observe(_part(frame, ~trusted), belief)
        return [
            *self.features.observe(_part(frame, trusted), belief),
            *(replace(group, updates=_MAP) for group in doubted if Part.LANDMARK in group.updates),
        ]

    def _fails(self) -> bool:
        """Whether so little agrees that it may be chance. Once lost, more has to agree: the camera may be anywhere.

        Only features whose whole ellipse was searched tell something then: in a larger one something alike is found by
        chance, or what is there is missed. Of a place that was recognised beyond doubt it is enough that it can be
        tracked: patches look different from there.
        """
        found, config = self.searched.found, self.config
        if not found.size or (self.features.fixed and found.sum() < LEAST_SEEN):
            return True
        if not self.lost:
            return bool(found.mean() < config.lost_fraction)
        least = min(config.recovered_features, int(self.table.alive.sum()))
        reach = config.ellipse_sigmas * np.sqrt(np.einsum("kii->ki", self.searched.cov).max(axis=1))
        found = found[reach <= config.max_radius_px]
        fraction = config.lost_fraction if self.recognised else config.recovered_fraction
        return bool(found.sum() < max(least, fraction * found.size))

    def _judge(self) -> np.ndarray:
        """Counts hits and misses; rows of what is missed too often."""
        searched, config, table = self.searched, self.config, self.table
        nothing = np.zeros(0, dtype=np.int64)
        if not searched.rows.size or self.bad_frames:
            return nothing
        table.note(searched.rows, searched.found)
        if self.features.fixed:
            return nothing
        rows = searched.rows
        failing = 1.0 - table.found[rows] / table.attempts[rows] > config.max_failure_ratio
        drop = rows[failing & (table.attempts[rows] >= config.min_attempts)]
        table.alive[drop] = False
        return np.asarray(drop[table.member[drop] < 0])

    def _place(self, belief: Belief, rows: np.ndarray) -> None:
        """Remembers where in the mode's world features are now."""
        if rows.size:
            chosen, place = self.features.places(belief, rows, self.table.member[rows])
            self.table.place[rows[chosen]] = place

    def _keep_looks(self, image: np.ndarray, belief: Belief) -> None:
        """Keeps windows of the features that were found and look different by now.

        How a patch lies in space is not known. A patch that is taken to face the camera of its first sighting is alike
        to about 25° from there; a camera that was lost and comes from another side would not know it again.
        """
        rows, px = self.measured.landmarks, self.measured.z
        if not rows.size:
            return
        config, table, pose = self.config, self.table, belief.state[belief.mode][:7]
        cosine, ratio = turned(table.place[rows], pose, table.last_pose[rows])
        away = np.maximum(ratio, 1.0 / ratio) >= config.appearance_scale_change
        for k in np.flatnonzero((cosine <= np.cos(np.deg2rad(config.appearance_turn_deg))) | away):
            window = cut(image, px[k], SOURCE_HALF_PX)
            if window is not None:
                table.last_source[rows[k]], table.last_pose[rows[k]] = window, pose

    def _place_rays(self, belief: Belief, new_landmarks: Sequence[NewLandmarks]) -> None:
        """Remembers where in the mode's world features start."""
        for group in new_landmarks:
            assert isinstance(group.model, CameraRay) and group.facts is not None
            pose = belief.state[belief.mode][:7]
            self.table.place[list(group.facts)] = self.features.first_places(pose, group.z, group.model)

    def _with_corners(self, frame: ImageFrame, belief: Belief) -> FeatureFrame:
        assert frame.image is not None
        config, measured = self.config, self.measured
        room = config.measurements - measured.landmarks.size
        if self.table.count > measured.landmarks.size:
            room = min(config.min_in_view - self.search.in_view.shape[0], config.new_per_frame)
        room = min(room, self.features.max_new_per_frame)
        if room <= 0:
            return measured
        occupied = np.concatenate([measured.z, self.search.in_view])
        px = self.detector.detect(
            frame.image, room, occupied, config.spacing_px, SOURCE_HALF_PX + 1.0, self._within
        ).px
        px = px[np.isfinite(self.camera.unproject(px)).all(axis=1)]
        if not px.shape[0]:
            return measured
        source = np.array([self._window(frame.image, place) for place in px])
        rows = self.table.add(source, px, belief.state[belief.mode][:7])
        return self._features(
            frame.stamp_ns, np.append(measured.landmarks, rows), np.concatenate([measured.z, px])
        )

    def _features(self, stamp_ns: int, rows: np.ndarray, px: np.ndarray) -> FeatureFrame:
        cov = np.repeat(self.config.noise_px**2 * np.eye(2)[None], rows.size, axis=0)
        return FeatureFrame(stamp_ns, rows, px, cov)

    def _window(self, image: np.ndarray, px: np.ndarray) -> np.ndarray:
        window = cut(image, px, SOURCE_HALF_PX)
        if window is None:
            raise InputError(
                f"a known point at ({px[0]:.1f}, {px[1]:.1f}) px is nearer than {SOURCE_HALF_PX} px to the border"
            )
        return window


def _part(frame: FeatureFrame, rows: np.ndarray) -> FeatureFrame:
    return FeatureFrame(frame.stamp_ns, frame.landmarks[rows], frame.z[rows], frame.cov_z[rows])
