"""A pair that calibrates itself: an error common to all disparities is a constant of the joint map, learnt with all else."""

from typing import Any, final

import numpy as np

from rbpf.core.filter import Filter
from rbpf.core.models import Part
from rbpf.errors import InputError
from rbpf.maps.joint_map import JointMap
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.front_end import FrontEnd
from rbpf.systems.stereo.landmarks import F


@final
class SelfCalibration:
    """By how many px all disparities are too small; nothing, and certain, where `calibrate` is off.

    `own_model` is whether landmarks are measured by a model of the user's, which cannot be tuned. Raises InputError: what is
    to be learnt has no place in the map that is asked for.
    """

    def __init__(self, config: StereoConfig, front_end: FrontEnd[Any], own_model: bool) -> None:
        self.front_end, self.is_online = front_end, config.calibrate == "online"
        if self.is_online and (config.map.kind != "joint" or own_model):
            raise InputError(
                "calibrate=online holds the error of all disparities in a joint map of points: set map.kind=joint, and leave "
                "out a model of your own"
            )
        variance = config.self_calibration.disparity_px**2
        #: Mean (1,) and covariance (1, 1) before anything is seen, for the joint map; None where it is not learnt.
        self.prior = (np.zeros(1), np.full((1, 1), variance)) if self.is_online else None

    def estimate(self, filter_: Filter) -> tuple[float, float]:
        """As it is known by now, with its standard deviation, px."""
        if not self.is_online:
            return 0.0, 0.0
        joint = filter_.marginals.parts[Part.LANDMARK]
        assert isinstance(joint, JointMap)
        mean, cov = joint.moments(filter_.particles, Part.SUBSTATE)
        return float(mean[0]), float(np.sqrt(cov[0, 0]))

    def tune(self, filter_: Filter) -> float:
        """As it is known by now the next pair is measured; px."""
        offset_px, _ = self.estimate(filter_)
        if self.is_online:
            self.front_end.tune(np.array([offset_px]))
        return offset_px

    def retuned(self, filter_: Filter, features: F, then_px: float) -> F:
        """Features of a pair, which was measured by `then_px`, as they are known after the filter has taken it.

        The next pair is matched with them and measured by the same calibration: else what was learnt looks like a motion in
        depth.
        """
        return self.front_end.shifted(features, then_px - self.estimate(filter_)[0]) if self.is_online else features

    def entries(self, filter_: Filter) -> dict[str, Any]:
        """For summary.json."""
        names = "disparity_offset_px", "std_disparity_offset_px"
        return {"calibration": dict(zip(names, self.estimate(filter_), strict=True))} if self.is_online else {}
