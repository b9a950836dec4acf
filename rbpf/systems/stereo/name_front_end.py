"""What a log of named pixels shows, frame by frame: known association, for stereo SLAM without images."""

from dataclasses import replace
from typing import final

import numpy as np

from rbpf.core.models import Belief
from rbpf.errors import InputError
from rbpf.maps.point import Point
from rbpf.motion.stereo_odometer import match_names
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.camera.points import StereoPoint
from rbpf.sensors.feature_log import CameraTruth, FeatureFrame, FeatureLog
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.dead_reckoning import Pixels
from rbpf.systems.stereo.front_ends import FrontEnd
from rbpf.systems.stereo.motion_segmentation import MotionSegmentation
from rbpf.systems.stereo.seen import FEATURE, LANDMARK
from rbpf.systems.stereo.sensor import log_support


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
        self.model = StereoPoint(log.camera)
        self.sensor: NamedLandmarkSensor = NamedLandmarkSensor(
            self.model, Point(3), config.likelihood.build()
        )
        self._now = self._kept = FeatureFrame(
            0, np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))
        )
        self.segmentation = MotionSegmentation()
        self._filtered = self._proven = np.zeros(0, dtype=np.int64)

    def look(self, frame: FeatureFrame) -> tuple[int, str]:
        """Nothing is to be done."""
        self._now = frame
        self.segmentation.look()
        return frame.landmarks.size, ""

    def matches(self) -> Pixels:
        """By their names."""
        before, now = match_names(self._kept.landmarks, self._now.landmarks)
        if self.config.odometry.split != "none":
            even = self._kept.landmarks[before] % 2 == 0
            before, now = before[even], now[even]
        self.segmentation.match(before, now)
        kept, seen = self._kept, self._now
        return Pixels(kept.z[before], seen.z[now], kept.cov_z[before], seen.cov_z[now])

    def keep(self) -> None:
        self._kept = self._now

    @property
    def proven(self) -> int:
        """Those that the filter has taken more than once."""
        return self._proven.size

    def recognised(self, belief: Belief) -> int:
        """By their names, those that the filter has taken more than once."""
        return int(np.isin(self.for_filter().landmarks, self._proven).sum())

    def log_support(self, belief: Belief, doubt: bool) -> float:
        frame = self.for_filter()
        rows = np.flatnonzero(np.isin(frame.landmarks, self._proven))
        if not rows.size:
            return 0.0
        mean, cov = belief.project(self.model, frame.landmarks[rows])
        return log_support(frame.z[rows] - mean, frame.cov_z[rows] + cov, frame.z, self.rig)

    def relocalise_globally(self, belief: Belief) -> tuple[np.ndarray, int] | None:
        """A name is looked for everywhere as it is."""
        return None

    def for_filter(self, doubt: bool = False) -> FeatureFrame:
        """All of them, those of odd or even names, or none."""
        config, frame = self.config, self._now
        chosen = np.full(frame.landmarks.size, config.map.used)
        if config.odometry.split != "none":
            chosen &= frame.landmarks % 2 == (1 if config.odometry.split == "apart" else 0)
        chosen &= frame.z[:, 0] > frame.z[:, 2]
        chosen[self.segmentation.moving] = False
        return FeatureFrame(frame.stamp_ns, frame.landmarks[chosen], frame.z[chosen], frame.cov_z[chosen])

    def seen(self, updated: bool) -> tuple[np.ndarray, np.ndarray]:
        return self._now.z, np.full(self._now.landmarks.size, LANDMARK if updated else FEATURE)

    def note(self, step: int, agree: np.ndarray, updated: bool) -> None:
        """The log has it all but what stands still, and which names the filter has taken again."""
        if updated:
            taken = self.for_filter().landmarks
            self._proven = np.union1d(self._proven, np.intersect1d(self._filtered, taken))
            self._filtered = np.union1d(self._filtered, taken)
        self.segmentation.note(self._kept.landmarks.size, agree, np.zeros(0, dtype=np.intp))

    def log(self, name: str, stamps_ns: np.ndarray, truth: CameraTruth | None) -> FeatureLog:
        """The given one, up to the last pair that was filtered."""
        return replace(self._log, frames=self._log.frames[: stamps_ns.size])

    def arrays(self) -> dict[str, np.ndarray]:
        kept = self._kept
        pair = {"pair/names": kept.landmarks, "pair/z": kept.z, "pair/cov": kept.cov_z}
        names = {"names/filtered": self._filtered, "names/proven": self._proven}
        return pair | names | self.segmentation.arrays()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        names, z, cov = (arrays[f"pair/{name}"].copy() for name in ("names", "z", "cov"))
        self._kept = FeatureFrame(0, names, z, cov)
        self._filtered, self._proven = arrays["names/filtered"].copy(), arrays["names/proven"].copy()
        self.segmentation.restore(arrays, names.size)
