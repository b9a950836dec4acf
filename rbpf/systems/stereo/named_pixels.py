"""Stereo front end and landmarks with known association, by the names in a recording."""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, Schema, integers
from rbpf.core.models import NULL, Belief, NewLandmarks, Observations
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.camera.points import StereoPoint
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.front_end import PIXELS, FrontEnd
from rbpf.systems.stereo.landmarks import SEEN_AGAIN, FeatureKind, Landmarks, Pair
from rbpf.systems.stereo.places import make_room
from rbpf.systems.system import MAP_IDS


@final
class NamedLandmarks(Kept, Landmarks[FeatureFrame]):
    """Landmarks with known association."""

    # (M,) landmarks of the map, ascending, number of observations of each, and pairs since the last one.
    kept: ClassVar = {
        "_held": integers("landmarks", least=0, ascending=True, refers=MAP_IDS),
        "_observations": integers("landmarks", least=1),
        "_unseen_for": integers("landmarks", least=0),
    }
    prefix = "names/"

    def __init__(self, rig: RectifiedStereo, config: StereoConfig) -> None:
        self.rig, self.config, self.model, self.landmark = rig, config.map, StereoPoint(rig), Point(3)
        self.ids = np.zeros(0, dtype=np.int64)
        self._sensor = NamedLandmarkSensor(self.model, self.landmark, config.likelihood.build())
        self._held = np.zeros(0, dtype=np.int64)
        self._observations, self._unseen_for = np.zeros((2, 0), dtype=np.int64)

    def observe(self, frame: Pair[FeatureFrame], belief: Belief) -> Sequence[Observations]:
        self._sensor.model = self.model
        self.ids = np.where(frame.for_map, frame.features.landmarks, NULL)
        return self._sensor.observe(frame.features.take(frame.for_map), belief)

    def new_landmarks(
        self, frame: Pair[FeatureFrame], belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        shown = frame.features.take(frame.for_map)
        started = self._sensor.new_landmarks(shown, belief, observed)
        held = np.union1d(self._held, shown.landmarks)
        before, seen = np.searchsorted(held, self._held), np.isin(held, shown.landmarks)
        observations, unseen_for = np.zeros((2, held.size), dtype=np.int64)
        observations[before], unseen_for[before] = self._observations, self._unseen_for + 1
        self._held, self._observations = held, observations + seen
        self._unseen_for = np.where(seen, 0, unseen_for)
        make_room(belief.map, held, self._unseen_for)
        return started

    def associate(self, pair: Pair[FeatureFrame], belief: Belief) -> np.ndarray:
        """By name; for an uncertain view only those that were observed more than once."""
        known, names = self.seen_again() if pair.uncertain else self._held, pair.features.landmarks
        return np.where(pair.for_map & np.isin(names, known) & belief.map.holds(names), names, NULL)

    def put_away(self, pair: Pair[FeatureFrame], belief: Belief, joint: JointMap, free: np.ndarray) -> np.ndarray:
        names = pair.features.landmarks
        return np.where(pair.for_map & free & np.isin(names, joint.old.ids) & ~joint.holds(names), names, NULL)

    def seen_again(self) -> np.ndarray:
        return self._held[self._observations >= SEEN_AGAIN]


@final
class NamedFrontEnd(FrontEnd[FeatureFrame]):
    """Pixels of named landmarks.

    One unit of the frames' stamps is `ns_per_stamp` nanoseconds: 10⁹ if they count frames of unknown time.
    """

    takes = FeatureFrame
    kept: ClassVar[Schema] = {"landmarks": integers("features", least=0), **PIXELS}
    names_landmarks = True

    def __init__(self, rig: RectifiedStereo, config: StereoConfig, ns_per_stamp: int = 1) -> None:
        self.rig, self.config, self.ns_per_stamp = rig, config, ns_per_stamp
        self.landmarks: NamedLandmarks = NamedLandmarks(rig, config)
        self._offset_px = 0.0

    def measure(self, frame: FeatureFrame) -> tuple[Pair[FeatureFrame], str]:
        frame.check(self.rig.dim)
        calibrated = replace(frame, z=frame.z - [0.0, 0.0, self._offset_px])
        return self.pair(self.ns_per_stamp * frame.stamp_ns, calibrated), ""

    def tune(self, about: np.ndarray) -> None:
        self._offset_px = float(about[0])
        self.landmarks.model = StereoPoint(self.rig, about=about)

    def shifted(self, features: FeatureFrame, by_px: float) -> FeatureFrame:
        return replace(features, z=features.z + np.array([0.0, 0.0, by_px]))

    def match(self, before: Pair[FeatureFrame], now: Pair[FeatureFrame]) -> tuple[np.ndarray, np.ndarray]:
        names = before.features.landmarks, now.features.landmarks
        _, first, second = np.intersect1d(*names, assume_unique=True, return_indices=True)
        used = before.for_odometry[first]
        return first[used], second[used]

    def landmarks_of(self, pair: Pair[FeatureFrame], updated: bool) -> tuple[np.ndarray, np.ndarray]:
        """Their names, whether the filter has used them or not."""
        kind = FeatureKind.LANDMARK if updated else FeatureKind.FEATURE
        return pair.features.landmarks, np.full(len(pair), kind)

    def features(self, kept: dict[str, np.ndarray]) -> FeatureFrame:
        return FeatureFrame(0, *kept.values())

    def half(self, features: FeatureFrame) -> np.ndarray:
        return features.landmarks % 2 == 0
