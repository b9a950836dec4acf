"""What a recording shows, pair by pair: features of images; of a log's named pixels in `name_front_end`."""

from abc import ABC, abstractmethod
from typing import Any, final

import numpy as np

from rbpf.core.filter import StepReport
from rbpf.core.models import NULL, Belief, Part, Sensor
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import CameraTruth, FeatureLog
from rbpf.sensors.features import Sift
from rbpf.sensors.readers import ImageFrame
from rbpf.sensors.stereo.features import StereoFeatures, match_frames
from rbpf.sensors.stereo.matching import StereoMatcher
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.dead_reckoning import Pixels
from rbpf.systems.stereo.feature_cache import CachedPair
from rbpf.systems.stereo.global_relocalisation import relocalise_globally
from rbpf.systems.stereo.motion_segmentation import MotionSegmentation
from rbpf.systems.stereo.seen import FEATURE, LANDMARK, TRIAL
from rbpf.systems.stereo.sensor import StereoFrame, StereoSensor
from rbpf.systems.stereo.tracks import Tracks


class FrontEnd(ABC):
    """Measures pairs; what it has measured last is what the next pair is matched with.

    Attributes:
        rig: the cameras.
        sensor: what the filter takes.
        segmentation: which features stand still; the map takes no others.
    """

    rig: RectifiedStereo
    sensor: Sensor
    segmentation: MotionSegmentation

    @abstractmethod
    def look(self, frame: Any) -> tuple[int, str]:
        """Measures a pair: how many features there are, and what is wrong with it, in words."""

    @abstractmethod
    def matches(self) -> Pixels:
        """The pair looked at, matched with the one kept."""

    @abstractmethod
    def keep(self) -> None:
        """The pair looked at is what the next one is matched with."""

    @abstractmethod
    def for_filter(self, doubt: bool = False) -> Any:
        """The pair looked at, as the sensor takes it.

        Args:
            doubt: the motion up to it was only assumed, for all or part of the way.
        """

    @property
    @abstractmethod
    def proven(self) -> int:
        """Landmarks of the map by which a place can be recognised."""

    @abstractmethod
    def recognised(self, belief: Belief) -> int:
        """Landmarks of the map that the pair looked at shows, all in one place, to particles in doubt."""

    @abstractmethod
    def log_support(self, belief: Belief, doubt: bool) -> float:
        """How well the map's landmarks are seen by particles, a log-density beside that of false matches."""

    @abstractmethod
    def relocalise_globally(self, belief: Belief) -> tuple[np.ndarray, int] | None:
        """Where in the map the pair looked at was taken, world_from_camera (7,), and landmarks that say so."""

    @abstractmethod
    def seen(self, updated: bool) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (K, 3) of the pair looked at, and what each was to the map (K,), see `rbpf.systems.stereo.seen`.

        Args:
            updated: whether the filter has taken the pair.
        """

    def observed(self, report: StepReport) -> int:
        """Landmarks that weighed the particles in the filter's last step."""
        weighed = (group.ids for group in report.groups if Part.STATE in group.updates)
        return sum(int((ids >= 0).sum()) for ids in weighed if ids is not None)

    def seconds(self) -> float:
        """Time that the sensor took to find landmarks in its last pair."""
        return 0.0

    @abstractmethod
    def note(self, step: int, agree: np.ndarray, updated: bool) -> None:
        """Takes note of what was used of the pair kept, for `log`.

        Args:
            step: number of the pair.
            agree: (M,) which of the matches agree with the motion; none where nothing was matched.
            updated: whether the filter has taken the pair.
        """

    @abstractmethod
    def log(self, name: str, stamps_ns: np.ndarray, truth: CameraTruth | None) -> FeatureLog:
        """The pixels that the pairs of stamps (T,) were filtered by."""

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint: the pair kept, and the sensor."""

    @abstractmethod
    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""


@final
class ImageFrontEnd(FrontEnd):
    """SIFT features of images.

    Args:
        rig: the cameras.
        config: all settings.
    """

    def __init__(self, rig: RectifiedStereo, config: StereoConfig) -> None:
        self.rig = rig
        self.config = config
        self.sift = StereoMatcher(rig, Sift(config.sift), config.pair)
        likelihood = config.likelihood.build()
        self.sensor: StereoSensor = StereoSensor(
            rig, config.map, config.new_landmarks, config.sift.length, likelihood
        )
        nothing = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0)
        self._none = StereoFeatures.measured(
            rig, *nothing, np.zeros((0, config.sift.length), dtype=np.float32)
        )
        self._now = self._kept = self._none
        self.segmentation = MotionSegmentation()
        self.tracks = Tracks()

    def look(self, frame: ImageFrame | CachedPair) -> tuple[int, str]:
        """SIFT in both images, matched along the rows; or what was measured in them before."""
        self._now = self._none
        self.segmentation.look()
        if isinstance(frame, CachedPair):
            self._now = self._none if frame.features is None else frame.features
            return len(self._now), frame.problem
        if frame.image is None or frame.right is None:
            return 0, frame.problem or "an image is missing"
        self._now = self.sift.measure(frame.image, frame.right)
        return len(self._now), self.sift.remark

    def relocalise_globally(self, belief: Belief) -> tuple[np.ndarray, int] | None:
        if not self.config.map.used:
            return None
        frame, least = self.for_filter(doubt=True), self.config.odometry.estimate
        return relocalise_globally(self.sensor, frame, belief, least)

    def matches(self) -> Pixels:
        """By their descriptors."""
        found = match_frames(self._kept, self._now, self.config.odometry.limits)
        if self.config.odometry.split != "none":
            found = found.take(
                split_by_descriptor(self._kept.descriptors)[found.first]
                & split_by_descriptor(self._now.descriptors)[found.second]
            )
        before, now = self._kept.take(found.first), self._now.take(found.second)
        self.segmentation.match(found.first, found.second)
        return Pixels(before.z, now.z, before.cov, now.cov)

    def keep(self) -> None:
        self._kept = self._now

    def for_filter(self, doubt: bool = False) -> StereoFrame:
        """All features that stand still, or the half of them that is the map's."""
        split, free = self.config.odometry.split, np.ones(len(self._now), dtype=bool)
        if split != "none":
            half = split_by_descriptor(self._now.descriptors)
            free = ~half if split == "apart" else half
        free[self.segmentation.moving] = False
        return StereoFrame(self._now, free, doubt)

    @property
    def proven(self) -> int:
        """Those that were found again, if there is a map."""
        return self.sensor.proven().size if self.config.map.used else 0

    def recognised(self, belief: Belief) -> int:
        """By their descriptors, as many as agree on one motion."""
        if not self.config.map.used:
            return 0
        return int((self.sensor.matched(self.for_filter(doubt=True), belief) >= 0).sum())

    def log_support(self, belief: Belief, doubt: bool) -> float:
        if not self.config.map.used:
            return 0.0
        return self.sensor.log_support(self.for_filter(doubt), belief)

    def seen(self, updated: bool) -> tuple[np.ndarray, np.ndarray]:
        return self._now.z, self.sensor.kinds() if updated else np.full(len(self._now), FEATURE)

    def seconds(self) -> float:
        return self.sensor.seconds

    def note(self, step: int, agree: np.ndarray, updated: bool) -> None:
        first, second = self.segmentation.matches[:, np.flatnonzero(agree)]
        names = self.sensor.names if updated else np.full(len(self._kept), NULL, dtype=np.int64)
        found = np.isin(self.seen(updated)[1], (LANDMARK, TRIAL))
        self.segmentation.note(len(self._kept), agree, np.flatnonzero(found))
        self.tracks.note(step, self._kept.z, self._kept.cov, (first, second), names)

    def log(self, name: str, stamps_ns: np.ndarray, truth: CameraTruth | None) -> FeatureLog:
        return FeatureLog(name, self.rig, self.tracks.frames(stamps_ns), truth=truth)

    def arrays(self) -> dict[str, np.ndarray]:
        kept = self._kept
        names = ("z", "cov", "scale", "orientation", "descriptors")
        pair = {f"pair/{name}": getattr(kept, name) for name in names}
        return pair | self.segmentation.arrays() | self.sensor.arrays() | self.tracks.arrays()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        names = ("z", "cov", "scale", "orientation", "descriptors")
        self._kept = StereoFeatures.measured(self.rig, *(arrays[f"pair/{name}"].copy() for name in names))
        self.segmentation.restore(arrays, len(self._kept))
        self.sensor.restore(arrays)
        self.tracks.restore(arrays)


def split_by_descriptor(descriptors: np.ndarray) -> np.ndarray:
    """A lot (K,) that falls alike whenever a feature is seen: whether the descriptor's first rows outweigh its last ones."""
    side = descriptors.shape[1] // 3
    return np.asarray(descriptors[:, :side].sum(axis=1) > descriptors[:, -side:].sum(axis=1))
