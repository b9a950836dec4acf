"""What a stereo camera's frames show: features of each pair, and which of two pairs are the same point.

A front end measures a frame, which gives a `Pair`, and matches two pairs. It holds no pair itself: nothing depends on
the order of its calls. Where `odometry.split` is not "none", odometry and map use features of their own: each feature is
always in the same half, whenever it is seen.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, ClassVar, Generic

import numpy as np

from rbpf.core.checkpoint import Schema, grey, integers, numbers, read
from rbpf.core.models import NULL
from rbpf.errors import InputError
from rbpf.motion.stereo_geometry import Matches
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.camera.points import StereoPoint
from rbpf.sensors.descriptors import match_all
from rbpf.sensors.features import FeatureExtractor, Sift
from rbpf.sensors.readers import ImageFrame
from rbpf.sensors.stereo import StereoFeatures, StereoMatcher, aligned
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.landmarks import DescriptorLandmarks, F, FeatureKind, Landmarks, Pair
from rbpf.systems.stereo.motion_segmentation import MOVING, STATIC, UNKNOWN

_STOOD = {"stood": integers("features", least=MOVING, below=STATIC + 1, dtype=np.int8)}
PIXELS = {"z": numbers("features", 3), "cov": numbers("features", 3, 3)}
#: What the rest of `StereoFeatures` follows from.
KEPT = PIXELS | {
    "scale": numbers("features"),
    "orientation": numbers("features"),
    "descriptors": numbers("features", "length", dtype=np.float32),
    "patch": grey("features", "side", "side"),
    "first": numbers("features", 4),
}


class FrontEnd(ABC, Generic[F]):
    """Measures frames and matches pairs."""

    takes: ClassVar[type[Any]]  #: of the frames.
    names_landmarks: ClassVar[bool] = False  #: whether the frames themselves say which landmark each feature is.
    #: attributes of the features of a pair from which `features` makes them again, for checkpoints.
    kept: ClassVar[Schema]
    rig: RectifiedStereo
    config: StereoConfig
    landmarks: Landmarks[F]  #: the map's side: finds landmarks among the features.

    @abstractmethod
    def measure(self, frame: Any) -> tuple[Pair[F], str]:
        """What a frame shows, and in words what is wrong with it; empty where nothing is.

        Raises InputError: the frame shows that the cameras are not what they should be.
        """

    def refusal(self, frame: Any) -> str:
        """In words, why a frame cannot be one of these cameras; empty where it can. `measure` then finds nothing in it."""
        return ""

    def impossible(self) -> tuple[int, int]:
        """Matches within the frame that was measured last which no point in space has, and all of them."""
        return 0, 0

    @property
    def is_tunable(self) -> bool:
        """Whether cameras that calibrate themselves can be measured."""
        return type(self).tune is not FrontEnd.tune and isinstance(self.landmarks.model, StereoPoint)

    def tune(self, about: np.ndarray) -> None:
        """Columns of the right image are too large by `about` (1,) px: from here on they are measured without that."""
        raise InputError(f"{type(self).__name__} has no cameras that calibrate themselves")

    def shifted(self, features: F, by_px: float) -> F:
        """With columns of the right image so much larger: as they are now known to be. It must be overridden with `tune`."""
        raise InputError(f"{type(self).__name__} has no cameras that calibrate themselves")

    @abstractmethod
    def match(self, before: Pair[F], now: Pair[F]) -> tuple[np.ndarray, np.ndarray]:
        """Rows (M,) of the earlier pair and (M,) of the later one that are the same point, as the odometry takes it."""

    def aligned(self, before: Pair[F], now: Pair[F], rows: tuple[np.ndarray, np.ndarray]) -> Pair[F]:
        """The later pair, such rows of it put where the earlier one's points are exactly; by default as they were measured."""
        return now

    def matches(self, before: Pair[F], now: Pair[F], rows: tuple[np.ndarray, np.ndarray]) -> Matches:
        """The pixels of such rows."""
        first, second = before.features.take(rows[0]), now.features.take(rows[1])
        return Matches.checked(self.rig, first.z, second.z, first.cov, second.cov)

    def landmarks_of(self, pair: Pair[F], updated: bool) -> tuple[np.ndarray, np.ndarray]:
        """Landmark (K,) of each feature, NULL where there is none, and `FeatureKind` (K,) of each.

        Of the pair that was measured last; `updated` says whether the filter has taken it.
        """
        if updated:
            return self.landmarks.ids, self.landmarks.kinds()
        return np.full(len(pair), NULL, dtype=np.int64), np.full(len(pair), FeatureKind.FEATURE)

    @abstractmethod
    def features(self, kept: dict[str, np.ndarray]) -> F:
        """Features of which a checkpoint has held these arrays."""

    @abstractmethod
    def half(self, features: F) -> np.ndarray:
        """A random half (K,) bool of the features, in which each is always or never, whenever it is seen."""

    def arrays(self, pair: Pair[F]) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {f"pair/{name}": getattr(pair.features, name) for name in self.kept} | {"pair/stood": pair.labels}

    def pair_of(self, arrays: dict[str, np.ndarray]) -> Pair[F]:
        """The inverse of `arrays`; errors as `rbpf.core.checkpoint.read`."""
        found = read(arrays, {**self.kept, **_STOOD}, "pair/")
        labels = found.pop("stood")
        return replace(self.pair(0, self.features(found)), labels=labels)

    def pair(self, stamp_ns: int, features: F) -> Pair[F]:
        """A pair whose features odometry and map share as the settings say."""
        split, everything, half = self.config.odometry.split, np.ones(len(features), dtype=bool), self.half(features)
        for_map = {"none": everything, "same": half, "apart": ~half}[split]
        # A point at infinity or beyond is no landmark.
        for_map = for_map & (features.z[:, 0] > features.z[:, 2]) & self.config.map.used
        for_odometry = everything if split == "none" else half
        return Pair(stamp_ns, features, for_odometry, for_map, np.full(len(features), UNKNOWN, dtype=np.int8))


class ImageFrontEnd(FrontEnd[StereoFeatures]):
    """Features of images, matched by their descriptors.

    Args:
        rig: the cameras.
        config: all settings.
        extractor: see `rbpf.systems.stereo.slam.StereoSlam`.
        landmarks: finds landmarks among the features; None for `DescriptorLandmarks`.
    """

    takes = ImageFrame
    kept = KEPT

    def __init__(
        self,
        rig: RectifiedStereo,
        config: StereoConfig,
        extractor: FeatureExtractor | None = None,
        landmarks: Landmarks[StereoFeatures] | None = None,
    ) -> None:
        self.rig, self.config = rig, config
        extractor = extractor or Sift(config.sift)
        self.matcher = StereoMatcher(rig, extractor, config.pair)
        self.landmarks = landmarks or DescriptorLandmarks(rig, config, extractor.length)

    def measure(self, frame: Any) -> tuple[Pair[StereoFeatures], str]:
        features, problem = self.features_of(frame)
        if features is None:
            nothing = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0)
            descriptors = np.zeros((0, self.matcher.extractor.length), dtype=np.float32)
            features = StereoFeatures.measured(self.rig, *nothing, descriptors)
        pair = self.pair(frame.stamp_ns, features)
        return replace(pair, images=self.matcher.images, offset_px=self.matcher.offset_px), problem

    def features_of(self, frame: Any) -> tuple[StereoFeatures | None, str]:
        """Features of both images, matched along the rows, None where there are none; and what is wrong, in words.

        Raises InputError: left and right image are swapped.
        """
        if frame.image is None or frame.right is None:
            return None, frame.problem or "an image is missing"
        refusal = self.refusal(frame)
        return (None, refusal) if refusal else (self.matcher.measure(frame.image, frame.right), self.matcher.remark)

    def refusal(self, frame: Any) -> str:
        if frame.image is None or frame.right is None:
            return ""
        try:
            self.matcher.check(frame.image, frame.right)
        except InputError as error:
            return str(error)
        return ""

    def impossible(self) -> tuple[int, int]:
        return self.matcher.impossible

    def tune(self, about: np.ndarray) -> None:
        self.matcher.offset_px = float(about[0])
        self.landmarks.model = StereoPoint(self.rig, about=about)

    def shifted(self, features: StereoFeatures, by_px: float) -> StereoFeatures:
        return features.at(self.rig, features.z + np.array([0.0, 0.0, by_px]), features.cov)

    def match(self, before: Pair[StereoFeatures], now: Pair[StereoFeatures]) -> tuple[np.ndarray, np.ndarray]:
        one, other = before.features.descriptors, now.features.descriptors
        found = match_all(one, other, self.config.odometry.limits)
        used = before.for_odometry[found.first] & now.for_odometry[found.second]
        return found.first[used], found.second[used]

    def aligned(
        self, before: Pair[StereoFeatures], now: Pair[StereoFeatures], rows: tuple[np.ndarray, np.ndarray]
    ) -> Pair[StereoFeatures]:
        if now.images is None:
            return now
        which = rows[1], before.features.patch[rows[0]], before.features.first[rows[0]]
        features = aligned(self.rig, self.config.pair, now.images, now.offset_px, now.features, *which)
        return replace(now, features=features)

    def features(self, kept: dict[str, np.ndarray]) -> StereoFeatures:
        length = self.matcher.extractor.length
        if kept["descriptors"].shape[1] != length:
            raise InputError(f"the array pair/descriptors must hold descriptors of {length} numbers")
        return StereoFeatures.measured(self.rig, *kept.values())

    def half(self, features: StereoFeatures) -> np.ndarray:
        """Whose descriptor's first numbers outweigh its last ones."""
        side = features.descriptors.shape[1] // 3
        return features.descriptors[:, :side].sum(axis=1) > features.descriptors[:, -side:].sum(axis=1)
