"""A pair that calibrates itself: an error common to all disparities is a constant of the joint map, learnt with all else.

Whether there is one is decided by evidence (`calibrate=auto`): until all pairs so far are far more probable with it than
without, the constant is as good as known to be 0. How the map hangs on it tells by how much more probable they are, and how
all poses move once it is learnt.
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
"""Nats by which one of the two explains the pairs better when that is no chance any more: as much as six sigma."""
AS_GOOD_AS_KNOWN = 1e-3
"""How uncertain the constant is before, as a fraction of what it is then."""
KNOWN = 0.25
"""To which fraction of that it must be known to be decided: where little tells it, what else disparities err by is as much."""
REVISED = 1000
"""Pairs before the decision whose poses are told anew, at most."""


@final
class SelfCalibration(Kept):
    """By how many px all disparities are too small; nothing, and certain, where that is not learnt.

    Raises InputError: it is asked for, and has no place in the map.
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
        #: Whether the map and the front end have a place for it, and it is not refused.
        self.is_held = is_possible and config.calibrate != "off"
        self._free = Constants(np.zeros(1), np.full((1, 1), config.self_calibration.disparity_px**2))
        scale = 1.0 if self.is_estimated else AS_GOOD_AS_KNOWN
        #: Mean (1,) and covariance (1, 1) before anything is seen, for the joint map; None where it has no place.
        self.prior = (np.zeros(1), scale**2 * self._free.cov) if self.is_held else None
        # How the last update's pose moves with it; and, told before it was decided, poses, covariances and how they move.
        self._slope, self.slopes = np.zeros(6), np.zeros((0, 6))
        self.stamps_ns, self.poses, self.covs = np.zeros(0, dtype=np.int64), np.zeros((0, 7)), np.zeros((0, 6, 6))

    def watch(self, filter_: Filter) -> str:
        """After an update: in words, that from here on it is estimated, and was not before."""
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
        """All poses so far, anew, where it was decided by this pair, which has moved so since the last update."""
        if not self.is_held or (self.is_estimated and not self.stamps_ns.size):
            return None
        if self.is_estimated:
            # This pose knows what is learnt, the others do not.
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
        """As it is known by now, with its standard deviation, px."""
        if not self.is_estimated:
            return 0.0, 0.0
        mean, cov = self._joint(filter_).moments(filter_.particles, Part.SUBSTATE)
        return float(mean[0]), float(np.sqrt(cov[0, 0]))

    def tune(self, filter_: Filter) -> float:
        """As it is known by now the next pair is measured; px."""
        offset_px, _ = self.estimate(filter_)
        if self.is_held:
            self.front_end.tune(np.array([offset_px]))
        return offset_px

    def retuned(self, filter_: Filter, features: F, then_px: float) -> F:
        """Features of a pair, which was measured by `then_px`, as they are known after the filter has taken it.

        The next pair is matched with them and measured by the same calibration: else what was learnt looks like a motion in
        depth.
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
