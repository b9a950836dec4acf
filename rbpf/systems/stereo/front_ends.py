"""What a recording shows, pair by pair: features of images, or the named pixels of a log."""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, final

import numpy as np

from rbpf.belief import Belief
from rbpf.errors import InputError
from rbpf.exchange import NULL
from rbpf.filter import StepReport
from rbpf.maps.point import Point
from rbpf.models import Part, Sensor
from rbpf.motion.stereo_odometer import match_names
from rbpf.sensors.features import CameraTruth, FeatureFrame, FeatureLog
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.pinhole import RectifiedStereo
from rbpf.sensors.readers.images import ImageFrame
from rbpf.sensors.stereo_features import StereoFeatures, match_frames
from rbpf.sensors.stereo_matching import StereoSift
from rbpf.sensors.stereo_points import StereoPoint
from rbpf.systems.stereo.anywhere import find_anywhere
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.dead_reckoning import Pixels
from rbpf.systems.stereo.measured import MeasuredPair
from rbpf.systems.stereo.seen import FEATURE, LANDMARK
from rbpf.systems.stereo.sensor import StereoFrame, StereoSensor, log_support
from rbpf.systems.stereo.tracks import Tracks


class FrontEnd(ABC):
    """Measures pairs; what it has measured last is what the next pair is matched with.

    Attributes:
        rig: the cameras.
        sensor: what the filter takes.
    """

    rig: RectifiedStereo
    sensor: Sensor

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

    @abstractmethod
    def recognised(self, belief: Belief) -> int:
        """Landmarks of the map that the pair looked at shows, all in one place, to particles in doubt."""

    @abstractmethod
    def log_support(self, belief: Belief, doubt: bool) -> float:
        """How well the map's landmarks are seen by particles, a log-density beside that of false matches."""

    @abstractmethod
    def stood(self) -> np.ndarray:
        """Of each match (M,) whether it stood still in the pair kept, see `rbpf.motion.stereo_motions.Known`."""

    @abstractmethod
    def anywhere(self, belief: Belief) -> tuple[np.ndarray, int] | None:
        """Where in the map the pair looked at was taken, world_from_camera (7,), and landmarks that say so."""

    @abstractmethod
    def leave_out(self, moving: np.ndarray) -> None:
        """Matches (M,) that are of things that move: the map does not take their features."""

    @abstractmethod
    def seen(self, updated: bool) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (K, 3) of the pair looked at, and what each was to the map (K,), see `rbpf.systems.stereo.seen`.

        Args:
            updated: whether the filter has taken the pair.
        """

    def observed(self, report: StepReport) -> int:
        """Landmarks that weighed the particles in the filter's last step."""
        weighed = (group.ids for group in report.groups if Part.STATE in group.informs)
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
        self.sift = StereoSift(rig, config.sift, config.pair)
        likelihood = config.likelihood.build()
        self.sensor: StereoSensor = StereoSensor(rig, config.map, config.keys, config.sift.length, likelihood)
        self._likelihoods = likelihood, config.recovery.likelihood.build()
        nothing = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0)
        self._none = StereoFeatures.measured(
            rig, *nothing, np.zeros((0, config.sift.length), dtype=np.float32)
        )
        self._now = self._kept = self._none
        self._matches = np.zeros((2, 0), dtype=np.intp)
        self._moving = np.zeros(0, dtype=np.intp)
        self._stood = np.zeros(0, dtype=np.int8)
        self.tracks = Tracks()

    def look(self, frame: ImageFrame | MeasuredPair) -> tuple[int, str]:
        """SIFT in both images, matched along the rows; or what was measured in them before."""
        self._now, self._matches = self._none, np.zeros((2, 0), dtype=np.intp)
        self._moving = self._matches[1]
        if isinstance(frame, MeasuredPair):
            self._now = self._none if frame.features is None else frame.features
            return len(self._now), frame.problem
        if frame.image is None or frame.right is None:
            return 0, frame.problem or "an image is missing"
        self._now = self.sift.measure(frame.image, frame.right)
        return len(self._now), self.sift.remark

    def stood(self) -> np.ndarray:
        return self._stood[self._matches[0]]

    def anywhere(self, belief: Belief) -> tuple[np.ndarray, int] | None:
        if not self.config.map.used:
            return None
        frame, least = self.for_filter(doubt=True), self.config.odometry.estimate
        return find_anywhere(self.sensor, frame, belief, least)

    def leave_out(self, moving: np.ndarray) -> None:
        self._moving = self._matches[1, moving]

    def matches(self) -> Pixels:
        """By their keys."""
        found = match_frames(self._kept, self._now, self.config.odometry.limits)
        if self.config.odometry.split != "none":
            found = found.take(half_of(self._kept.keys)[found.first] & half_of(self._now.keys)[found.second])
        before, now = self._kept.take(found.first), self._now.take(found.second)
        self._matches = np.stack([found.first, found.second])
        return Pixels(before.z, now.z, before.cov, now.cov)

    def keep(self) -> None:
        self._kept = self._now

    def for_filter(self, doubt: bool = False) -> StereoFrame:
        """All features that stand still, or the half of them that is the map's."""
        self.sensor.likelihood = self._likelihoods[doubt]
        split, free = self.config.odometry.split, np.ones(len(self._now), dtype=bool)
        if split != "none":
            half = half_of(self._now.keys)
            free = ~half if split == "apart" else half
        free[self._moving] = False
        return StereoFrame(self._now, free, doubt)

    def recognised(self, belief: Belief) -> int:
        """By their keys, as many as agree on one motion."""
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
        first, second = self._matches[:, agree] if agree.size else self._matches[:, :0]
        names = self.sensor.names if updated else np.full(len(self._kept), NULL, dtype=np.int64)
        self._stood = standing(self._stood, self._matches, agree, self._moving, len(self._kept))
        self._stood[names >= 0] = 1
        self.tracks.note(step, self._kept.z, self._kept.cov, (first, second), names)

    def log(self, name: str, stamps_ns: np.ndarray, truth: CameraTruth | None) -> FeatureLog:
        return FeatureLog(name, self.rig, self.tracks.frames(stamps_ns), truth=truth)

    def arrays(self) -> dict[str, np.ndarray]:
        kept = self._kept
        names = ("z", "cov", "scale", "orientation", "keys")
        pair = {f"pair/{name}": getattr(kept, name) for name in names} | {"pair/stood": self._stood}
        return pair | self.sensor.arrays() | self.tracks.arrays()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        names = ("z", "cov", "scale", "orientation", "keys")
        self._kept = StereoFeatures.measured(self.rig, *(arrays[f"pair/{name}"].copy() for name in names))
        self._stood = arrays["pair/stood"].copy()
        self.sensor.restore(arrays)
        self.tracks.restore(arrays)


@final
class NameFrontEnd(FrontEnd):
    """The named pixels of a log, known association.

    Args:
        log: of a stereo pair.
        config: all settings.

    Raises:
        InputError: the log is of one camera.
    """

    def __init__(self, log: FeatureLog, config: StereoConfig) -> None:
        if not isinstance(log.camera, RectifiedStereo):
            raise InputError(
                f"{log.name}: stereo SLAM needs a log of a rectified pair, this one is of one camera"
            )
        self.rig = log.camera
        self.config = config
        self._log = log
        self._likelihoods = config.likelihood.build(), config.recovery.likelihood.build()
        self.sensor = NamedLandmarkSensor(StereoPoint(log.camera), Point(3), self._likelihoods[False])
        self._now = self._kept = FeatureFrame(
            0, np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))
        )
        self._matches, self._stood = np.zeros((2, 0), dtype=np.intp), np.zeros(0, dtype=np.int8)
        self._moving = self._matches[1]

    def look(self, frame: FeatureFrame) -> tuple[int, str]:
        """Nothing is to be done."""
        self._now, self._matches = frame, np.zeros((2, 0), dtype=np.intp)
        self._moving = self._matches[1]
        return frame.landmarks.size, ""

    def matches(self) -> Pixels:
        """By their names."""
        before, now = match_names(self._kept.landmarks, self._now.landmarks)
        if self.config.odometry.split != "none":
            even = self._kept.landmarks[before] % 2 == 0
            before, now = before[even], now[even]
        kept, seen, self._matches = self._kept, self._now, np.stack([before, now])
        return Pixels(kept.z[before], seen.z[now], kept.cov_z[before], seen.cov_z[now])

    def keep(self) -> None:
        self._kept = self._now

    def recognised(self, belief: Belief) -> int:
        """By their names."""
        return int(np.isin(self.for_filter().landmarks, list(belief.catalogue.values())).sum())

    def log_support(self, belief: Belief, doubt: bool) -> float:
        frame, ids = self.for_filter(), {name: i for i, name in belief.catalogue.items()}
        rows = np.flatnonzero(np.isin(frame.landmarks, list(ids)))
        if not rows.size:
            return 0.0
        named = np.array([ids[name] for name in frame.landmarks[rows].tolist()])
        mean, cov = belief.project(self.sensor.model, named)
        return log_support(frame.z[rows] - mean, frame.cov_z[rows] + cov, frame.z, self.rig)

    def stood(self) -> np.ndarray:
        return self._stood[self._matches[0]]

    def anywhere(self, belief: Belief) -> tuple[np.ndarray, int] | None:
        """A name is looked for everywhere as it is."""
        return None

    def leave_out(self, moving: np.ndarray) -> None:
        self._moving = self._matches[1, moving]

    def for_filter(self, doubt: bool = False) -> FeatureFrame:
        """All of them, those of odd or even names, or none."""
        self.sensor.likelihood = self._likelihoods[doubt]
        config, frame = self.config, self._now
        chosen = np.full(frame.landmarks.size, config.map.used)
        if config.odometry.split != "none":
            chosen &= frame.landmarks % 2 == (1 if config.odometry.split == "apart" else 0)
        chosen &= frame.z[:, 0] > frame.z[:, 2]
        chosen[self._moving] = False
        return FeatureFrame(frame.stamp_ns, frame.landmarks[chosen], frame.z[chosen], frame.cov_z[chosen])

    def seen(self, updated: bool) -> tuple[np.ndarray, np.ndarray]:
        return self._now.z, np.full(self._now.landmarks.size, LANDMARK if updated else FEATURE)

    def note(self, step: int, agree: np.ndarray, updated: bool) -> None:
        """The log has it all but what stands still."""
        self._stood = standing(self._stood, self._matches, agree, self._moving, self._kept.landmarks.size)

    def log(self, name: str, stamps_ns: np.ndarray, truth: CameraTruth | None) -> FeatureLog:
        """The given one, up to the last pair that was filtered."""
        return replace(self._log, frames=self._log.frames[: stamps_ns.size])

    def arrays(self) -> dict[str, np.ndarray]:
        kept = self._kept
        pair = {"pair/names": kept.landmarks, "pair/z": kept.z, "pair/cov": kept.cov_z}
        return pair | {"pair/stood": self._stood}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        names, z, cov = (arrays[f"pair/{name}"].copy() for name in ("names", "z", "cov"))
        self._kept, self._stood = FeatureFrame(0, names, z, cov), arrays["pair/stood"].copy()


def standing(
    before: np.ndarray, matches: np.ndarray, agree: np.ndarray, moving: np.ndarray, count: int
) -> np.ndarray:
    """Of each of so many features whether it stands still: 1, it moves: −1, or that is not known: 0.

    Args:
        before: the same of the earlier pair's features.
        matches: rows (2, M) of both pairs.
        agree: (M,) which agree with the camera's motion; where none does, all stay as they were.
        moving: rows of the features that agree on another motion.
        count: of features.
    """
    now = np.zeros(count, dtype=np.int8)
    first, second = matches
    if agree.any():
        now[second[agree]] = 1
    else:
        now[second] = before[first]
    now[moving] = -1
    return now


def half_of(keys: np.ndarray) -> np.ndarray:
    """A lot (K,) that falls alike whenever a feature is seen: whether the key's first rows outweigh its last ones."""
    side = keys.shape[1] // 3
    return np.asarray(keys[:, :side].sum(axis=1) > keys[:, -side:].sum(axis=1))
