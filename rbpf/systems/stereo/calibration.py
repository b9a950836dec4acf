"""Self-calibration of a stereo pair: a common disparity offset as a constant of the joint map.

Model selection decides whether there is one (`calibrate=auto`): the constant is nearly fixed at 0 until all pairs so far are
far more probable with an offset than without. The map's regression on the constant gives the change of the evidence, and of
all poses once it is estimated.
"""

from typing import Any, ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, integers, numbers, poses, truths
from rbpf.core.filter import Filter
from rbpf.core.models import Part
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.joint.solution import Constants
from rbpf.maps.joint_map import JointMap
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.front_end import FrontEnd
from rbpf.systems.stereo.landmarks import F
from rbpf.systems.system import Revision

DECISIVE = 18.0
"""Log-evidence ratio (nats) that decides between the two models: as much as six sigma."""
AS_GOOD_AS_KNOWN = 1e-3
"""Standard deviation of the constant before the decision, as a fraction of that after it."""
KNOWN = 0.25
"""Largest posterior standard deviation, relative to the prior, for a decision: a weak estimate may be other errors."""
REVISED = 1000
"""Maximum number of earlier poses that are revised at the decision."""


@final
class SelfCalibration(Kept):
    """The offset by which all disparities are too small, px; exactly 0 if it is not estimated.

    Raises InputError: it is requested explicitly, but the map cannot hold it.
    """

    kept: ClassVar = {
        "is_estimated": truths(),
        "_slope": numbers(6),
        "stamps_ns": integers("pairs"),
        "poses": poses("pairs"),
        "covs": numbers("pairs", 6, 6),
        "slopes": numbers("pairs", 6),
    }
    prefix = "calibration/"

    def __init__(self, config: StereoConfig, front_end: FrontEnd[Any]) -> None:
        self.front_end, self.is_estimated = front_end, config.calibrate == "online"
        is_possible = config.map.kind == "joint" and config.map.used and front_end.is_tunable
        if self.is_estimated and not is_possible:
            raise InputError(
                "calibrate=online holds the error of all disparities in a joint map of points: leave out map.kind=particles, "
                "and a model of your own"
            )
        #: Whether map and front end support it, and it is not switched off.
        self.is_held = is_possible and config.calibrate != "off"
        self._free = Constants(np.zeros(1), np.full((1, 1), config.self_calibration.disparity_px**2))
        scale = 1.0 if self.is_estimated else AS_GOOD_AS_KNOWN
        #: Prior mean (1,) and covariance (1, 1) for the joint map; None if it is not supported.
        self.prior = (np.zeros(1), scale**2 * self._free.cov) if self.is_held else None
        # Regression of the last update's pose on it; and of the poses before the decision, with these and their covariances.
        self._slope, self.slopes = np.zeros(6), np.zeros((0, 6))
        self.stamps_ns, self.poses, self.covs = np.zeros(0, dtype=np.int64), np.zeros((0, 7)), np.zeros((0, 6, 6))

    def watch(self, filter_: Filter) -> str:
        """To be called after an update; returns a message if its estimation starts here."""
        if self.is_estimated or not self.is_held:
            return ""
        joint, particles = self._joint(filter_), filter_.particles
        self._slope = joint.pose_by_constants(particles)[:, 0]
        found, gain = joint.presumed(particles, self._free)
        if gain <= DECISIVE or found.cov[0, 0] > KNOWN**2 * self._free.cov[0, 0]:
            return ""
        self.is_estimated = True
        filter_.consolidate()
        joint.presume(self._free)
        offset_px, std_px = self.estimate(filter_)
        size = f"{abs(offset_px):.2f} ± {std_px:.2f} px too {'small' if offset_px > 0.0 else 'large'}"
        return f"all disparities are {size}: the pair calibrates itself from here on"

    def told(
        self, filter_: Filter, stamp_ns: int, pose: np.ndarray, cov: np.ndarray, since_update: np.ndarray
    ) -> Revision | None:
        """The revision of all poses if this pair was decisive; `since_update` (7,) is the motion since the last update."""
        if not self.is_held or (self.is_estimated and not self.stamps_ns.size):
            return None
        if self.is_estimated:
            # The current pose includes the estimate, the earlier ones do not.
            offset_px, std_px = self.estimate(filter_)
            self.poses = SE3.retract(self.poses, offset_px * self.slopes)
            self.covs = self.covs + std_px**2 * self.slopes[:, :, None] * self.slopes[:, None, :]
        slope = SE3.adjoint(SE3.inverse(since_update)) @ self._slope
        self.stamps_ns = np.append(self.stamps_ns, stamp_ns)[-REVISED:]
        self.poses = np.append(self.poses, pose[None], axis=0)[-REVISED:]
        self.covs = np.append(self.covs, cov[None], axis=0)[-REVISED:]
        self.slopes = np.append(self.slopes, slope[None], axis=0)[-REVISED:]
        if not self.is_estimated:
            return None
        revision = Revision(self.stamps_ns, self.poses, self.covs)
        self.stamps_ns, self.poses = self.stamps_ns[:0], self.poses[:0]
        self.covs, self.slopes = self.covs[:0], self.slopes[:0]
        return revision

    def estimate(self, filter_: Filter) -> tuple[float, float]:
        """The current estimate with its standard deviation, px."""
        if not self.is_estimated:
            return 0.0, 0.0
        mean, cov = self._joint(filter_).moments(filter_.particles, Part.SUBSTATE)
        return float(mean[0]), float(np.sqrt(cov[0, 0]))

    def tune(self, filter_: Filter) -> float:
        """Sets the front end to the current estimate for the next pair; returns it, px."""
        offset_px, _ = self.estimate(filter_)
        if self.is_held:
            self.front_end.tune(np.array([offset_px]))
        return offset_px

    def retuned(self, filter_: Filter, features: F, then_px: float) -> F:
        """Features of a pair, measured with the offset `then_px`, corrected to the estimate after the filter's update.

        The next pair is matched with them under the same calibration; otherwise a change of the estimate would look like
        motion in depth.
        """
        return self.front_end.shifted(features, then_px - self.estimate(filter_)[0]) if self.is_estimated else features

    def entries(self, filter_: Filter) -> dict[str, Any]:
        """For summary.json."""
        names = "disparity_offset_px", "std_disparity_offset_px"
        return {"calibration": dict(zip(names, self.estimate(filter_), strict=True))} if self.is_estimated else {}

    def _joint(self, filter_: Filter) -> JointMap:
        joint = filter_.marginals.parts[Part.LANDMARK]
        assert isinstance(joint, JointMap)
        return joint
