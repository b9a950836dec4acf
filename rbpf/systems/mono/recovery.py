"""What the filter is told about the pose when the camera is lost, and when it is found again."""

from dataclasses import replace
from typing import final

import numpy as np

from rbpf.core.estimate import mixture_estimate
from rbpf.core.filter import Filter
from rbpf.core.particles import Particles
from rbpf.core.proposals import Prior
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import PosePrior
from rbpf.sensors.readers.images import ImageFrame
from rbpf.systems.mono.config import RelocalisationConfig
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.last_view import LastView
from rbpf.systems.mono.relocalise import BORDER_PX, Relocaliser

LEAST_CONTRAST = 10
"""Grey levels that are all nearer to each other are those of a lens cap."""

VIEWS_PER_FRAME = 2
"""Views of an earlier map from which a lost camera is looked for in a frame, in turn."""

FROZEN = 5
"""Times that an image has to come again: drivers repeat single images when the camera is late."""


@final
class Recovery:
    """Watches a run: `law` before each step of the filter, `note` after it.

    Args:
        sensor: of the run; it says whether the camera is lost.
        config: settings.
        std_velocity: (6,) standard deviation of the velocity of a camera that is found again, rad/s, m/s.
        views: (V, 7) poses to look from as well, where the map was made before this run; none for other runs.
        size_m: of such a map: how far from where it is told the camera may be as long as it was never found.
    """

    def __init__(
        self,
        sensor: ImageSensor,
        config: RelocalisationConfig,
        std_velocity: np.ndarray,
        views: np.ndarray | None = None,
        size_m: float = 0.0,
    ) -> None:
        self.sensor = sensor
        self.config = config
        self.std_velocity = std_velocity
        self.relocaliser = Relocaliser(sensor, config)
        self.stamp_ns = 0
        """When the pose was trusted last."""
        self.views = np.zeros((0, 7)) if views is None else views
        self.never_found = self.views.shape[0] > 0
        """Whether the camera has not been found yet in a map that was made before."""
        self._size_m = size_m
        start = self.views[0] if self.never_found else SE3.identity()
        self._trusted = start, np.zeros((6, 6))
        self._cloud: Particles | None = None
        self._image: np.ndarray | None = None
        self._mode = SE3.identity()
        self._view: LastView | None = None
        self._last: np.ndarray | None = None
        self._repeats = 0
        self._blank = False

    def checked(self, frame: ImageFrame) -> ImageFrame:
        """The frame, without its image if that shows nothing, or the same as the one before: it tells nothing new.

        The first of such frames in a row has the reason as its problem.
        """
        if frame.image is None:
            return frame
        last, self._last = self._last, frame.image
        self._repeats = self._repeats + 1 if last is not None and np.array_equal(frame.image, last) else 0
        problem = None
        if int(frame.image.max()) - int(frame.image.min()) < LEAST_CONTRAST:
            problem = "the image shows nothing, its grey levels are all alike: it is not used"
        elif self._repeats >= FROZEN:
            problem = (
                f"the image is the same for the {FROZEN + 1}th time, the camera may be frozen: it is not used"
            )
        was_blank, self._blank = self._blank, problem is not None
        if problem is None:
            return frame
        return replace(frame, image=None, problem=None if was_blank else problem)

    def law(self, frame: ImageFrame, filter_: Filter) -> PosePrior | None:
        """Nothing while the camera is tracked; where it was seen; else near the last trusted pose.

        A camera that moved on with its last velocity for a second would be further off than one that stayed: hands
        turn back.
        """
        self.sensor.recognised = False
        if not self.sensor.lost:
            return None
        pose, cov = self.trusted
        if frame.image is not None:
            found = self._found(filter_, frame.image, pose)
            if found is not None:
                self.sensor.recognised = self.relocaliser.sure
                return PosePrior(found.mean, found.cov + cov, self.std_velocity)
        reach = np.repeat([self.config.search_std_rad, self.config.search_std_m], 3)
        return PosePrior(pose, cov + np.diag(reach**2), self.std_velocity)

    def _found(self, filter_: Filter, image: np.ndarray, trusted: np.ndarray) -> PosePrior | None:
        """Where the camera is recognised, looking from the last trusted pose; then from views of the map.

        In the first frame from all of them, later from some in turn.
        """
        belief, count = filter_.belief(), self.views.shape[0]
        tried = min(count, VIEWS_PER_FRAME if filter_.steps else count)
        chosen = (filter_.steps * tried + np.arange(tried)) % max(count, 1)
        for near in [trusted, *self.views[chosen]]:
            last = self._last_view() if near is trusted else None
            found = self.relocaliser.find(belief, image, near, last)
            if found is not None:
                return found
        return None

    def drift(self, frame: ImageFrame) -> np.ndarray:
        """Covariance (6, 6) of how far the camera may have gone while it was lost, [ω, v]."""
        if not self.sensor.lost:
            return np.zeros((6, 6))
        if self.never_found:
            return np.diag(np.repeat([np.pi, self._size_m], 3) ** 2)
        seconds = (frame.stamp_ns - self.stamp_ns) * 1e-9
        return np.diag((np.repeat([self.config.drift_rad_s, self.config.drift_m_s], 3) * seconds) ** 2)

    def note(self, frame: ImageFrame, filter_: Filter) -> None:
        """Remembers the particles after a step, if they can be trusted."""
        if not self.sensor.bad_frames:
            self._cloud, self.stamp_ns = filter_.particles, frame.stamp_ns
            self._image, self._view = frame.image, None
            self.never_found = False

    @property
    def trusted(self) -> tuple[np.ndarray, np.ndarray]:
        """The last trusted pose world_from_camera (7,) in the particles' world, and its covariance (6, 6)."""
        if self._cloud is not None:
            # Averaged only when it is needed: tracking has no time for it.
            poses, log_weights = self._cloud.state[:, :7], self._cloud.log_weights
            estimate = mixture_estimate(Prior.exactly(SE3, poses), None, log_weights)
            self._trusted, self._cloud = (estimate.mean, estimate.cov), None
            self._mode = poses[log_weights.argmax()].copy()
        return self._trusted

    def _last_view(self) -> LastView | None:
        """The last image with a trusted pose, from where the heaviest particle was then."""
        if self._view is None and self._image is not None:
            self._view = LastView(
                self.sensor.camera,
                self._image,
                self._mode,
                self.sensor.detector,
                self.sensor.descriptor,
                self.config.max_corners,
                self.config.spacing_px,
                BORDER_PX,
            )
        return self._view

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        pose, cov = self.trusted
        last = np.zeros((0, 0), dtype=np.uint8) if self._last is None else self._last
        return {
            "recovery/pose": pose,
            "recovery/cov": cov,
            "recovery/stamp_ns": np.array(self.stamp_ns),
            "recovery/last": last,
            "recovery/image": np.zeros((0, 0), dtype=np.uint8) if self._image is None else self._image,
            "recovery/mode": self._mode,
            "recovery/repeats": np.array(self._repeats),
            "recovery/blank": np.array(self._blank),
            "recovery/never_found": np.array(self.never_found),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self._trusted, self._cloud = (arrays["recovery/pose"], arrays["recovery/cov"]), None
        self.stamp_ns = int(arrays["recovery/stamp_ns"])
        last = arrays["recovery/last"]
        self._last = last if last.size else None
        image = arrays["recovery/image"]
        self._image, self._view = image if image.size else None, None
        self._mode = arrays["recovery/mode"]
        self.never_found = bool(arrays["recovery/never_found"])
        self._repeats, self._blank = int(arrays["recovery/repeats"]), bool(arrays["recovery/blank"])
