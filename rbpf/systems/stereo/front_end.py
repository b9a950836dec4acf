"""Front end of stereo SLAM: features of each pair, and matches between two pairs.

A front end measures a frame, giving a `Pair`, and matches two pairs. It stores no pair itself: results do not depend on the
order of calls. If `odometry.split` is not "none", odometry and map use disjoint features: each feature is always in the same
half.
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
#: The fields of `StereoFeatures` from which the others are computed.
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
    names_landmarks: ClassVar[bool] = False  #: whether the frames have known association.
    #: attributes of a pair's features from which `features` restores them, for checkpoints.
    kept: ClassVar[Schema]
    rig: RectifiedStereo
    config: StereoConfig
    landmarks: Landmarks[F]  #: associates features with the map's landmarks.

    @abstractmethod
    def measure(self, frame: Any) -> tuple[Pair[F], str]:
        """The features of a frame, and a warning; empty if there is none.

        Raises InputError: the frame contradicts the camera model.
        """

    def refusal(self, frame: Any) -> str:
        """The reason why a frame cannot be from these cameras, else empty. `measure` then returns no features."""
        return ""

    def impossible(self) -> tuple[int, int]:
        """Numbers of negative-disparity matches and of all matches in the frame measured last."""
        return 0, 0

    @property
    def is_tunable(self) -> bool:
        """Whether self-calibration is supported."""
        return type(self).tune is not FrontEnd.tune and isinstance(self.landmarks.model, StereoPoint)

    def tune(self, about: np.ndarray) -> None:
        """Sets the offset `about` (1,) px of the right image's columns, which is subtracted from later measurements."""
        raise InputError(f"{type(self).__name__} has no cameras that calibrate themselves")

    def shifted(self, features: F, by_px: float) -> F:
        """The features with the right image's columns increased by `by_px`. It must be overridden with `tune`."""
        raise InputError(f"{type(self).__name__} has no cameras that calibrate themselves")

    @abstractmethod
    def match(self, before: Pair[F], now: Pair[F]) -> tuple[np.ndarray, np.ndarray]:
        """Rows (M,) of the earlier pair and (M,) of the later one that match, for the odometry."""

    def aligned(self, before: Pair[F], now: Pair[F], rows: tuple[np.ndarray, np.ndarray]) -> Pair[F]:
        """The later pair, with the matched rows aligned to the earlier one's patches; by default unchanged."""
        return now

    def matches(self, before: Pair[F], now: Pair[F], rows: tuple[np.ndarray, np.ndarray]) -> Matches:
        """The pixels of matched rows."""
        first, second = before.features.take(rows[0]), now.features.take(rows[1])
        return Matches.checked(self.rig, first.z, second.z, first.cov, second.cov)

    def landmarks_of(self, pair: Pair[F], updated: bool) -> tuple[np.ndarray, np.ndarray]:
        """Landmark (K,) of each feature, or NULL, and `FeatureKind` (K,) of each.

        For the pair measured last; `updated` tells whether it was in a filter update.
        """
        if updated:
            return self.landmarks.ids, self.landmarks.kinds()
        return np.full(len(pair), NULL, dtype=np.int64), np.full(len(pair), FeatureKind.FEATURE)

    @abstractmethod
    def features(self, kept: dict[str, np.ndarray]) -> F:
        """Features from the arrays of a checkpoint."""

    @abstractmethod
    def half(self, features: F) -> np.ndarray:
        """Mask (K,) of a random half of the features, the same for all observations of a feature."""

    def arrays(self, pair: Pair[F]) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint."""
        return {f"pair/{name}": getattr(pair.features, name) for name in self.kept} | {"pair/stood": pair.labels}

    def pair_of(self, arrays: dict[str, np.ndarray]) -> Pair[F]:
        """The inverse of `arrays`; errors as `rbpf.core.checkpoint.read`."""
        found = read(arrays, {**self.kept, **_STOOD}, "pair/")
        labels = found.pop("stood")
        return replace(self.pair(0, self.features(found)), labels=labels)

    def pair(self, stamp_ns: int, features: F) -> Pair[F]:
        """A pair with its features assigned to odometry and map by the settings."""
        split, everything, half = self.config.odometry.split, np.ones(len(features), dtype=bool), self.half(features)
        for_map = {"none": everything, "same": half, "apart": ~half}[split]
        # Points with no positive finite depth cannot be landmarks.
        for_map = for_map & (features.z[:, 0] > features.z[:, 2]) & self.config.map.used
        for_odometry = everything if split == "none" else half
        return Pair(stamp_ns, features, for_odometry, for_map, np.full(len(features), UNKNOWN, dtype=np.int8))


class ImageFrontEnd(FrontEnd[StereoFeatures]):
    """Features of images, matched by their descriptors.

    Args:
        rig: the cameras.
        config: all settings.
        extractor: see `rbpf.systems.stereo.slam.StereoSlam`.
        landmarks: associates features with landmarks; None for `DescriptorLandmarks`.
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
            return self.pair(frame.stamp_ns, StereoFeatures.measured(self.rig, *nothing, descriptors)), problem
        pair = self.pair(frame.stamp_ns, features)
        return replace(pair, images=self.matcher.images, offset_px=self.matcher.offset_px), problem

    def features_of(self, frame: Any) -> tuple[StereoFeatures | None, str]:
        """Features of both images, matched along the rows, or None; and a warning, if any.

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
        """By whether the descriptor's first entries outweigh its last ones."""
        side = features.descriptors.shape[1] // 3
        return features.descriptors[:, :side].sum(axis=1) > features.descriptors[:, -side:].sum(axis=1)
