"""A pair that calibrates itself: an error common to all disparities is a constant of the joint map, learnt with all else.

Whether there is one is decided by evidence (`calibrate=auto`): a *trial*, which learns it, takes the same pairs beside a run
that takes the calibration as it is given. By how many standard deviations what it learns differs from 0 does not decide: where
pixels err alike for other reasons, an offset explains a little of that.
"""

from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, integers, numbers, poses
from rbpf.core.filter import Filter
from rbpf.core.models import Part
from rbpf.errors import InputError
from rbpf.maps.joint_map import JointMap
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.front_end import FrontEnd
from rbpf.systems.stereo.landmarks import F
from rbpf.systems.system import Revision, Tracked

DECISIVE = 18.0
"""Nats by which one of the two explains the pairs better when that is no chance any more: as much as six sigma."""
UPDATES = 100
"""After which the calibration is taken as it is given, if nothing is decided."""
REVISED = 1000
"""Pairs before the decision whose poses are told anew, at most."""


@final
class Comparison(Kept):
    """By how much a trial explains the pairs better than a run that takes the calibration as it is given."""

    kept: ClassVar = {
        "sums": numbers(2),
        "stamps_ns": integers("pairs"),
        "poses": poses("pairs"),
        "covs": numbers("pairs", 6, 6),
    }
    prefix = "trial/compared/"

    def __init__(self) -> None:
        self.sums = np.zeros(2)  #: Nats, and updates of the run that takes it as given.
        #: The trial's path: (T,), (T, 7) and (T, 6, 6).
        self.stamps_ns, self.poses = np.zeros(0, dtype=np.int64), np.zeros((0, 7))
        self.covs = np.zeros((0, 6, 6))

    def add(self, given: Tracked, trial: Tracked) -> bool | None:
        """What both say of a pair. Whether the trial is right, None as long as that is not decided."""
        gained = trial.values["log_evidence"] - given.values["log_evidence"]
        self._before = float(self.sums[0])
        if given.values["updated"]:
            comparable = trial.values["updated"] and np.isfinite(gained)
            self.sums += gained if comparable else 0.0, 1.0
        self.stamps_ns = np.append(self.stamps_ns, trial.stamp_ns)[-REVISED:]
        self.poses = np.append(self.poses, trial.pose[None], axis=0)[-REVISED:]
        self.covs = np.append(self.covs, trial.cov[None], axis=0)[-REVISED:]
        gain, updates = self.sums
        return bool(gain > DECISIVE) if abs(gain) > DECISIVE or updates >= UPDATES else None

    def told(self, given: Tracked, trial: Tracked, message: str) -> Tracked:
        """What the trial, which is right, says of the last pair, with its path; the evidence of all pairs is then its own.

        Odometry alone goes on from where it was told to be, without a jump.
        """
        evidence = trial.values["log_evidence"] + self._before
        values = {**trial.values, "log_evidence": evidence, "odometry": given.values["odometry"]}
        revision = Revision(self.stamps_ns, self.poses, self.covs)
        return replace(trial, values=values, messages=(*trial.messages, message), revision=revision)


@final
class SelfCalibration:
    """By how many px all disparities are too small; nothing, and certain, where that is not learnt.

    Raises InputError: it is asked for, and has no place in the map.
    """

    def __init__(self, config: StereoConfig, front_end: FrontEnd[Any]) -> None:
        self.front_end, self.is_online = front_end, config.calibrate == "online"
        #: Whether the map and the front end have a place for it.
        self.is_possible = config.map.kind == "joint" and config.map.used and front_end.is_tunable
        if self.is_online and not self.is_possible:
            raise InputError(
                "calibrate=online holds the error of all disparities in a joint map of points: leave out map.kind=particles, "
                "and a model of your own"
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
