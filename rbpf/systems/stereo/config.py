"""Every setting of stereo SLAM, with its default, its unit and what it does."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Self

import numpy as np

from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_vo import MotionPrior, VoConfig
from rbpf.ranges import Angle, Count, CountOrNone, Formerly, NotNegative, Positive, Range, Ranged, Ratio
from rbpf.sensors.descriptors import MatchLimits
from rbpf.sensors.features import SiftConfig
from rbpf.sensors.landmark_management import NewLandmarkConfig
from rbpf.sensors.stereo import PairConfig
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig, RunConfig

#: Of the pixels (u_left, v, u_right): an image, and disparities of so many pixels.
OUTLIER_VOLUME_PX3 = 640.0 * 480.0 * 60.0


@dataclass(frozen=True)
class OdometryConfig(Ranged):
    """Motion from pair to pair (S05 §III-C), and its noise as the filter takes it."""

    estimate: VoConfig = field(default_factory=VoConfig)  #: how a motion is estimated from matches.
    #: what is expected before anything is seen, and assumed where nothing is.
    prior: Annotated[MotionPrior, Formerly("prediction")] = field(default_factory=MotionPrior)
    limits: MatchLimits = field(default_factory=MatchLimits)  #: of the descriptors of two pairs.
    std_added_rad: NotNegative = 0.0  #: injected per update (S05 §V), standard deviation of the turn about each axis.
    std_added_m: NotNegative = 0.0  #: likewise of the shift along each axis.
    #: S05 uses each feature twice, for the odometry and for the map ("none"). To measure what that does, the features
    #: can be divided at random into two halves: one for the odometry and the other for the map ("apart"), or one of
    #: them for both ("same").
    split: Literal["none", "apart", "same"] = "none"
    #: what the filter takes the odometry for. "motion" is S05: it moves the particles, with its own covariance, and the
    #: map weighs them with the same pixels again. "proposal" uses them once: particles move by `prior`, the landmarks
    #: weigh, and the odometry says where the proposal is linearised and landmarks are looked for. What pairs tell then
    #: enters by the map alone: it needs proposal.kind=ekf, map.weigh=all, and landmarks enough.
    role: Literal["motion", "proposal"] = "motion"
    #: whether the errors of consecutive motions are chained as if they were independent, as in S05, though both motions
    #: come from the pixels of the pair between them.
    independent: bool = False


@dataclass(frozen=True)
class MapConfig(Ranged):
    """Which features of a pair are landmarks of the map."""

    used: bool = True  #: whether there is a map; without one the filter is the odometry and its noise.
    #: one Gaussian of all landmarks and the frame, given the last few updates (joint): an uncertainty that stays true; or
    #: every particle's own landmarks, each of them a Gaussian given the whole sampled path (particles), as in S05. With a
    #: joint map the odometry is the proposal, linearised once, and all candidates weigh, whatever odometry.role, proposal and
    #: map.weigh say, and the likelihood must be a density. `StereoConfig.s05` has the defaults that go with particles, as
    #: do the settings of a run that asks for them.
    kind: Literal["particles", "joint"] = "joint"
    #: of a joint map: updates sampled, at most, before they are taken into it; fewer where the effective sample size
    #: falls below the threshold of resampling, which does not take place.
    window: Count = 1
    #: of a joint map: landmarks beyond which a sub-map ends; those in the pair, and of the others those seen last up to half
    #: of these, go over into the next one, and old ones come back when they are seen again. No landmark is dropped.
    submap: Annotated[Count, Formerly("active")] = 300
    #: whether candidates, no landmarks yet, weigh the particles, too; in the map they are in any case.
    weigh: Literal["landmarks", "all"] = "landmarks"
    limits: MatchLimits = field(default_factory=MatchLimits)  #: of the descriptors of a feature and a landmark.
    #: largest squared Mahalanobis distance from where the particles expect the landmark; 11.3 holds 99 %.
    gate: Positive = 11.3
    slack_px: NotNegative = 1.0  #: added to that expectation, standard deviation per axis.
    #: particles, drawn evenly from the weight, that say where a landmark is expected.
    subsample: Annotated[Count, Formerly("cloud")] = 32
    margin_px: float = 20.0  #: landmarks so far outside the image, as the heaviest particle sees it, may be in it.
    #: a landmark is not looked for once its line of sight has turned by this since it was seen last.
    max_turn_deg: Annotated[Angle, Formerly("turn_deg")] = 45.0
    max_scale_change: Annotated[Ratio, Formerly("scale")] = 2.0  #: nor once it is so many times nearer or farther.
    #: where landmarks are expected with a larger standard deviation than this, the gate lets much pass: the matches
    #: must then agree on one motion …
    vague_px: Annotated[NotNegative, Formerly("doubt_px")] = 15.0
    #: … and be so many, else none is taken, and the expectation stays as vague.
    min_agreeing: Annotated[int, Range(ge=3), Formerly("agreeing")] = 6
    #: a feature starts a landmark if the standard deviation of its depth is below this fraction of it.
    depth_fraction: Annotated[Positive, Formerly("depth_share")] = 0.1


@dataclass(frozen=True)
class TriggerConfig(Ranged):
    """The filter is updated only when the camera has moved enough since the last update (S05 §IV)."""

    moved_m: NotNegative = 0.02  #: by so much …
    turned_rad: NotNegative = 0.02  #: … or turned by so much …
    frames: CountOrNone = 0  #: … or, having moved at all or not, after so many pairs; 0 for never.

    def reached(self, motion: Odometry, frames: int) -> bool:
        """Whether the camera has moved enough since the last update, so many pairs ago.

        By the root mean square, so that uncertainty counts as motion.
        """
        variance = np.diagonal(motion.cov)
        turned, moved = SE3.log(motion.delta)[:3], SE3.translation(motion.delta)
        far = float(moved @ moved + variance[3:].sum()) >= self.moved_m**2
        turned_far = float(turned @ turned + variance[:3].sum()) >= self.turned_rad**2
        return far or turned_far or (self.frames > 0 and frames >= self.frames)


@dataclass(frozen=True)
class RecoveryConfig(Ranged):
    """What is done where the motion since the last update was only assumed, for all or part of the way.

    The distribution of an assumed motion is far wider than what the map's landmarks leave open: no particle that is
    drawn from it comes to lie where they are seen.
    """

    #: whether anything is done; without, such a motion moves the particles like any other, as in S05.
    used: bool = True
    #: pairs after which the map goes on from wherever the camera may be: it may have come to where nothing was mapped.
    patience: CountOrNone = 60
    #: of an update after such a motion.
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig("ekf", iterations=5))


@dataclass(frozen=True)
class CalibrationConfig(Ranged):
    """A pair that calibrates itself: how far its calibration may be from what is given, as a standard deviation."""

    #: of all disparities together, px: 0.1 are cameras that are turned against each other by a hundredth of a degree.
    disparity_px: Positive = 0.1


@dataclass(frozen=True)
class StereoConfig(RunConfig):
    """A run of stereo SLAM."""

    particles: Count = 50  #: number of particles.
    #: degrees of freedom of the camera: 6, or 3 for one that moves in its x–z plane and turns about y.
    dof: Literal[3, 6] = 6
    compiled: bool = True  #: run the fused kernels; false runs their NumPy twins.
    sift: SiftConfig = field(default_factory=SiftConfig)  #: keypoints of the images.
    pair: PairConfig = field(default_factory=PairConfig)  #: matching of the two images of a pair.
    odometry: OdometryConfig = field(default_factory=OdometryConfig)  #: motion from pair to pair.
    trigger: TriggerConfig = field(default_factory=TriggerConfig)  #: when the filter is updated.
    map: MapConfig = field(default_factory=MapConfig)  #: which features are landmarks.
    #: which features become landmarks, and how long they stay.
    new_landmarks: Annotated[NewLandmarkConfig, Formerly("keys")] = field(default_factory=NewLandmarkConfig)
    #: of a joint map: the pair calibrates itself, an error common to all disparities being estimated with everything else
    #: (online); by default from when on that explains all pairs so far far better (auto).
    calibrate: Literal["auto", "off", "online"] = "auto"
    #: what is known of a pair that calibrates itself.
    self_calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    #: of a landmark's innovation: with heavy tails, or S05 (6) with maps of the particles' own.
    likelihood: LikelihoodConfig = field(
        default_factory=lambda: LikelihoodConfig("student", outlier_volume=OUTLIER_VOLUME_PX3)
    )
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig("prior"))  #: where particles are sampled.
    #: what is done after a motion that was only assumed.
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)

    @classmethod
    def s05(cls) -> Self:
        """The defaults that go with maps of the particles' own: 400 of them, S05's truncated likelihood, keypoints' places."""
        return cls(
            particles=400,
            pair=PairConfig(align=False),
            map=MapConfig(kind="particles"),
            likelihood=LikelihoodConfig("truncated", outlier_volume=OUTLIER_VOLUME_PX3),
        )

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> Self:
        """The defaults that go with settings that are given, by name."""
        group = given.get("map")
        if isinstance(group, dict) and group.get("kind") == "particles":
            return cls.s05()
        # Visual odometry alone has no use for a joint map, and its points may be aligned as well.
        is_used = not isinstance(group, dict) or group.get("used") is not False
        return cls() if is_used else replace(cls.s05(), pair=PairConfig())
