"""Every setting of stereo SLAM, with its default, its unit and what it does."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np

from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_vo import MotionPrior, VoConfig
from rbpf.ranges import Angle, Count, CountOrNone, NotNegative, Positive, Range, Ranged, Ratio, Seed
from rbpf.sensors.descriptors import MatchLimits
from rbpf.sensors.features import SiftConfig
from rbpf.sensors.landmark_management import NewLandmarkConfig
from rbpf.sensors.stereo import PairConfig
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig, ResamplingConfig

OUTLIER_VOLUME_PX3 = 640.0 * 480.0 * 60.0
"""Of the pixels (u_left, v, u_right): an image, and disparities of so many pixels."""


@dataclass(frozen=True)
class OdometryConfig(Ranged):
    """Motion from pair to pair (S05 §III-C), and its noise as the filter takes it.

    Attributes:
        estimate: how a motion is estimated from matches.
        prior: what is expected before anything is seen, and assumed where nothing is.
        limits: of the descriptors of two pairs.
        std_added_rad: injected per update (S05 §V), standard deviation of the turn about each axis.
        std_added_m: likewise of the shift along each axis.
        split: S05 uses each feature twice, for the odometry and for the map ("none"). To measure what that does, the
            features can be divided at random into two halves: one for the odometry and the other for the map
            ("apart"), or one of them for both ("same").
        role: what the filter takes the odometry for. "motion" is S05: it moves the particles, with its own covariance, and
            the map weighs them with the same pixels again. "proposal" uses them once: particles move by `prior`, the
            landmarks weigh, and the odometry says where the proposal is linearised and landmarks are looked for. What
            pairs tell then enters by the map alone: it needs proposal.kind=ekf, map.weigh=all, and landmarks enough.
        independent: whether the errors of consecutive motions are chained as if they were independent, as in S05, though
            both motions come from the pixels of the pair between them.
    """

    RENAMED: ClassVar[dict[str, str]] = {"prediction": "prior"}

    estimate: VoConfig = field(default_factory=VoConfig)
    prior: MotionPrior = field(default_factory=MotionPrior)
    limits: MatchLimits = field(default_factory=MatchLimits)
    std_added_rad: NotNegative = 0.0
    std_added_m: NotNegative = 0.0
    split: Literal["none", "apart", "same"] = "none"
    role: Literal["motion", "proposal"] = "motion"
    independent: bool = False


@dataclass(frozen=True)
class MapConfig(Ranged):
    """Which features of a pair are landmarks of the map.

    Attributes:
        used: whether there is a map; without one the filter is the odometry and its noise.
        weigh: whether candidates, no landmarks yet, weigh the particles, too; in the map they are in any case.
        limits: of the descriptors of a feature and a landmark.
        gate: largest squared Mahalanobis distance from where the particles expect the landmark; 11.3 holds 99 %.
        slack_px: added to that expectation, standard deviation per axis.
        subsample: particles, drawn evenly from the weight, that say where a landmark is expected.
        margin_px: landmarks so far outside the image, as the heaviest particle sees it, may be in it.
        max_turn_deg: a landmark is not looked for once its line of sight has turned by this since it was seen last.
        max_scale_change: nor once it is so many times nearer or farther.
        vague_px: where landmarks are expected with a larger standard deviation than this, the gate lets much pass: the
            matches must then agree on one motion …
        min_agreeing: … and be so many, else none is taken, and the expectation stays as vague.
        depth_fraction: a feature starts a landmark if the standard deviation of its depth is below this fraction of it.
    """

    RENAMED: ClassVar[dict[str, str]] = {
        "depth_share": "depth_fraction",
        "cloud": "subsample",
        "turn_deg": "max_turn_deg",
        "scale": "max_scale_change",
        "doubt_px": "vague_px",
        "agreeing": "min_agreeing",
    }

    used: bool = True
    weigh: Literal["landmarks", "all"] = "landmarks"
    limits: MatchLimits = field(default_factory=MatchLimits)
    gate: Positive = 11.3
    slack_px: NotNegative = 1.0
    subsample: Count = 32
    margin_px: float = 20.0
    max_turn_deg: Angle = 45.0
    max_scale_change: Ratio = 2.0
    vague_px: NotNegative = 15.0
    min_agreeing: Annotated[int, Range(ge=3)] = 6
    depth_fraction: Positive = 0.1


@dataclass(frozen=True)
class TriggerConfig(Ranged):
    """The filter is updated only when the camera has moved enough since the last update (S05 §IV).

    Attributes:
        moved_m: by so much …
        turned_rad: … or turned by so much …
        frames: … or, having moved at all or not, after so many pairs; 0 for never.
    """

    moved_m: NotNegative = 0.02
    turned_rad: NotNegative = 0.02
    frames: CountOrNone = 0

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

    Attributes:
        used: whether anything is done; without, such a motion moves the particles like any other, as in S05.
        patience: pairs after which the map goes on from wherever the camera may be: it may have come to where
            nothing was mapped.
        proposal: of an update after such a motion.
    """

    used: bool = True
    patience: CountOrNone = 60
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig("ekf", iterations=5))


@dataclass(frozen=True)
class StereoConfig(Ranged):
    """A run of stereo SLAM.

    Attributes:
        particles: number of particles.
        seed: of all random generators.
        dof: degrees of freedom of the camera: 6, or 3 for one that moves in its x–z plane and turns about y.
        compiled: run the fused kernels; false runs their NumPy twins.
        lag: updates of the particles' paths that are kept, None keeps all.
        checkpoint_every: pairs between checkpoints.
        sift: keypoints of the images.
        pair: matching of the two images of a pair.
        odometry: motion from pair to pair.
        trigger: when the filter is updated.
        map: which features are landmarks.
        new_landmarks: which features become landmarks, and how long they stay.
        likelihood: of a landmark's innovation, S05 (6) by default.
        proposal: where particles are sampled.
        recovery: what is done after a motion that was only assumed.
        resampling: when and how.
    """

    RENAMED: ClassVar[dict[str, str]] = {"keys": "new_landmarks"}

    particles: Count = 400
    seed: Seed = 0
    dof: Literal[3, 6] = 6
    compiled: bool = True
    lag: Count | None = None
    checkpoint_every: Count = 500
    sift: SiftConfig = field(default_factory=SiftConfig)
    pair: PairConfig = field(default_factory=PairConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    trigger: TriggerConfig = field(default_factory=TriggerConfig)
    map: MapConfig = field(default_factory=MapConfig)
    new_landmarks: NewLandmarkConfig = field(default_factory=NewLandmarkConfig)
    likelihood: LikelihoodConfig = field(
        default_factory=lambda: LikelihoodConfig("truncated", outlier_volume=OUTLIER_VOLUME_PX3)
    )
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig("prior"))
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    resampling: ResamplingConfig = field(default_factory=ResamplingConfig)
