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
    """Motion from pair to pair (S05 §III-C), and its noise in the filter."""

    estimate: VoConfig = field(default_factory=VoConfig)  #: how a motion is estimated from matches.
    #: the motion prior, assumed if the estimate fails.
    prior: Annotated[MotionPrior, Formerly("prediction")] = field(default_factory=MotionPrior)
    limits: MatchLimits = field(default_factory=MatchLimits)  #: for descriptors of two pairs.
    std_added_rad: NotNegative = 0.0  #: standard deviation added per update (S05 §V) to the rotation, per axis.
    std_added_m: NotNegative = 0.0  #: likewise to the translation.
    #: none: each feature is used twice, for the odometry and for the map, as in S05. To measure the effect, features can be
    #: split at random into two halves. apart: one half is for the odometry, the other for the map. same: one half is for
    #: both, the other unused.
    split: Literal["none", "apart", "same"] = "none"
    #: role of the odometry in the filter. motion: as in S05 it moves the particles with its covariance, and the map weighs
    #: them with the same pixels again. proposal: pixels are used once; particles move by `prior`, landmarks weigh them, and
    #: the odometry is the linearisation point of the proposal and the search. Motion is then observed only through the map,
    #: which needs proposal.kind=ekf, map.weigh=all, and enough landmarks.
    role: Literal["motion", "proposal"] = "motion"
    #: whether errors of consecutive motions are treated as independent, as in S05, although both motions use the pixels of
    #: the pair between them.
    independent: bool = False


@dataclass(frozen=True)
class MapConfig(Ranged):
    """Which features of a pair are landmarks of the map."""

    used: bool = True  #: whether there is a map; without one the filter is odometry with noise.
    #: joint: one Gaussian of all landmarks and the frame, given the last few updates, which stays consistent. particles:
    #: per-particle landmarks, Gaussians given the whole sampled path, as in S05. With a joint map the odometry is the
    #: proposal, linearised once, and all candidates weigh, regardless of odometry.role, proposal and map.weigh, and the
    #: likelihood must be normalised. particles also changes other defaults, see `StereoConfig.s05`.
    kind: Literal["particles", "joint"] = "joint"
    #: for a joint map: number of updates sampled before they are merged into it. Below the effective sample size of the
    #: resampling threshold they are merged earlier, instead of resampling.
    window: Count = 1
    #: for a joint map: maximum number of landmarks of a sub-map. Those in the pair, and the most recently observed others up
    #: to half of this number, are passed on to the next sub-map; old ones return when re-observed. No landmark is dropped.
    submap: Annotated[Count, Formerly("active")] = 300
    #: whether only confirmed landmarks weigh the particles, or also candidates (all); both are in the map.
    weigh: Literal["landmarks", "all"] = "landmarks"
    limits: MatchLimits = field(default_factory=MatchLimits)  #: for descriptors of a feature and a landmark.
    #: gate: largest squared Mahalanobis distance from a landmark's prediction; 11.3 is the 99 % quantile.
    gate: Positive = 11.3
    slack_px: NotNegative = 1.0  #: standard deviation added to the prediction, per axis.
    #: number of particles, drawn by weight, used to predict landmarks.
    subsample: Annotated[Count, Formerly("cloud")] = 32
    margin_px: float = 20.0  #: margin around the heaviest particle's image within which landmarks may be in view.
    #: a landmark is not searched once its viewing direction has changed by this since its last observation.
    max_turn_deg: Annotated[Angle, Formerly("turn_deg")] = 45.0
    max_scale_change: Annotated[Ratio, Formerly("scale")] = 2.0  #: likewise its distance, by this factor.
    #: if predictions have a larger standard deviation than this, the gate accepts many matches, which must then agree on one
    #: motion …
    vague_px: Annotated[NotNegative, Formerly("doubt_px")] = 15.0
    #: … and number at least this many, else none is used.
    min_agreeing: Annotated[int, Range(ge=3), Formerly("agreeing")] = 6
    #: largest relative standard deviation of depth of a feature that initialises a landmark.
    depth_fraction: Annotated[Positive, Formerly("depth_share")] = 0.1


@dataclass(frozen=True)
class TriggerConfig(Ranged):
    """The filter is updated only once the camera has moved enough since the last update (S05 §IV)."""

    moved_m: NotNegative = 0.02  #: least translation …
    turned_rad: NotNegative = 0.02  #: … or rotation …
    frames: CountOrNone = 0  #: … or number of pairs, whatever the motion; 0 for never.

    def reached(self, motion: Odometry, frames: int) -> bool:
        """Whether the camera has moved enough since the last update, `frames` pairs ago.

        Compares the root mean square motion, so that uncertainty counts as motion.
        """
        variance = np.diagonal(motion.cov)
        turned, moved = SE3.log(motion.delta)[:3], SE3.translation(motion.delta)
        far = float(moved @ moved + variance[3:].sum()) >= self.moved_m**2
        turned_far = float(turned @ turned + variance[:3].sum()) >= self.turned_rad**2
        return far or turned_far or (self.frames > 0 and frames >= self.frames)


@dataclass(frozen=True)
class RecoveryConfig(Ranged):
    """Recovery if the motion since the last update was only assumed, at least in part.

    The distribution of an assumed motion is far wider than the posterior given the map's landmarks: no particle drawn from it
    lies where they are observed.
    """

    #: whether recovery is used; if not, such a motion moves the particles like any other, as in S05.
    used: bool = True
    #: pairs after which mapping continues from the assumed pose, as the camera may be in unmapped surroundings.
    patience: CountOrNone = 60
    #: proposal of an update after such a motion.
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig("ekf", iterations=5))


@dataclass(frozen=True)
class CalibrationConfig(Ranged):
    """Prior of a pair's self-calibration, as standard deviation from the given calibration."""

    #: of the common disparity offset, px: 0.1 corresponds to a relative yaw of a hundredth of a degree.
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
    #: for a joint map: self-calibration. online: a common disparity offset is estimated together with the map. auto: only once
    #: it explains all pairs so far much better.
    calibrate: Literal["auto", "off", "online"] = "auto"
    #: prior of the self-calibration.
    self_calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    #: likelihood of a landmark's innovation: heavy-tailed, or S05 (6) with per-particle maps.
    likelihood: LikelihoodConfig = field(
        default_factory=lambda: LikelihoodConfig("student", outlier_volume=OUTLIER_VOLUME_PX3)
    )
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig("prior"))  #: the proposal distribution.
    #: recovery after an assumed motion.
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)

    @classmethod
    def s05(cls) -> Self:
        """The defaults for per-particle maps: 400 particles, S05's truncated likelihood, keypoints without alignment."""
        return cls(
            particles=400,
            pair=PairConfig(align=False),
            map=MapConfig(kind="particles"),
            likelihood=LikelihoodConfig("truncated", outlier_volume=OUTLIER_VOLUME_PX3),
        )

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> Self:
        """The defaults given other settings by name."""
        group = given.get("map")
        if isinstance(group, dict) and group.get("kind") == "particles":
            return cls.s05()
        # Visual odometry alone needs no joint map, and its points may be aligned as well.
        is_used = not isinstance(group, dict) or group.get("used") is not False
        return cls() if is_used else replace(cls.s05(), pair=PairConfig())
