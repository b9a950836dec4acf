"""Every setting of monocular SLAM, with its default, its unit and what it does."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from rbpf.ranges import Angle, Count, CountOrNone, Formerly, Fraction, NotNegative, Positive, Range, Ranged, Ratio
from rbpf.systems.filtering import ProposalConfig, RunConfig


@dataclass(frozen=True)
class VelocityConfig(Ranged):
    """Constant velocity, E06 §3.1."""

    #: the velocity as a Kalman substate, sampled with the pose, or the paper's conditional mean.
    mode: Literal["marginal", "joint", "paper"] = "marginal"
    #: σ of E06 (4) for rotation: random walk of the angular velocity in one second, (rad/s)/√s.
    walk_rad_s: NotNegative = 3.0
    walk_m_s: NotNegative = 1.5  #: likewise of the linear velocity, (m/s)/√s.
    start_rad_s: NotNegative = 0.5  #: standard deviation of the angular velocity at the start.
    start_m_s: NotNegative = 0.5  #: likewise of the linear velocity.

    def walk_std(self) -> np.ndarray:
        """Standard deviation (6,) of the velocity's random walk in one second, (rad/s, m/s)/√s."""
        return np.repeat([self.walk_rad_s, self.walk_m_s], 3)

    def start_std(self) -> np.ndarray:
        """Standard deviation (6,) of an unknown velocity, (rad/s, m/s)."""
        return np.repeat([self.start_rad_s, self.start_m_s], 3)


@dataclass(frozen=True)
class InverseDepthConfig(Ranged):
    """Features of unknown depth: rays with an inverse depth, E06 §5."""

    #: how they constrain the pose. epipolar: by their epipolar line, as in the paper. marginal: by the 2-D marginal with its
    #: depth variance; but by the line until depth is measured, if points that fix the scale are observed. off: not at all.
    pose_update: Annotated[Literal["epipolar", "marginal", "off"], Formerly("constrain")] = "marginal"
    #: mean inverse depth of a new feature, 1/m; without known points it sets the scale.
    mean_per_m: Annotated[Positive, Formerly("rho_per_m")] = 0.8
    std_per_m: Annotated[Positive, Formerly("std_rho_per_m")] = 0.6  #: its standard deviation.
    #: if at least four points are observed, a new feature starts at their median inverse depth, with at least the same
    #: relative standard deviation.
    from_scene_depth: Annotated[bool, Formerly("adapt")] = True
    #: a ray is promoted to a point once the standard deviation of its inverse depth is below this fraction of it.
    promote_std_ratio: Annotated[Positive, Formerly("ready_ratio")] = 0.1
    #: fraction of the particles' weight in which this must hold.
    promote_weight: Annotated[Fraction, Formerly("ready_weight")] = 0.95
    #: depth counts as measured once a change of ρ by its initial standard deviation moves the image by this. Before, the
    #: parallax depends more on the error of the sampled pose than on depth. The prior of ρ, unchanged until depth is measured,
    #: would be counted again in every frame.
    depth_parallax_px: Annotated[Positive, Formerly("least_px")] = 10.0
    #: the same threshold from which a feature that moves in the image has an epipolar line. Before, the 2-D marginal is used,
    #: with a prior of ρ wide enough to hardly matter; or with the original prior, if known points are observed and the
    #: feature has not moved.
    epipolar_parallax_px: Annotated[Positive, Formerly("line_px")] = 0.3


@dataclass(frozen=True)
class StartConfig(Ranged):
    """Batch adjustment of the first frames: without known points it resamples particles or initialises the joint map."""

    #: whether it is done without known points; if not, the particles continue with the depth prior.
    batch_adjust: Annotated[bool, Formerly("redraw")] = True
    first_adjustment: Annotated[int, Range(ge=3), Formerly("first")] = 6  #: frames before the first adjustment …
    growth: Annotated[float, Range(gt=1.0, le=100.0)] = 1.25  #: … and their factor from each adjustment to the next.
    #: maximum number of frames in an adjustment, evenly chosen.
    max_frames: Annotated[int, Range(ge=3), Formerly("frames")] = 60
    #: initialisation ends once half of the depths in view have a relative standard deviation below this; or below three times
    #: this, if there are more frames than `max_frames`, and depths are no better than in the previous adjustment.
    depth_std_ratio: Annotated[Positive, Formerly("depth_share")] = 0.01

    def is_due(self, count: int) -> bool:
        """Whether an adjustment is due after this many frames."""
        due = self.first_adjustment
        while due < count:
            due = self.next_after(due)
        return due == count

    def next_after(self, count: int) -> int:
        """Number of frames of the next adjustment after one at `count` frames."""
        return max(int(np.ceil(self.growth * count)), count + 1)


@dataclass(frozen=True)
class SearchConfig(Ranged):
    """Active search in images, E06 §4.1."""

    measurements: Count = 25  #: maximum number of features searched in a frame.
    noise_px: Positive = 1.0  #: standard deviation of a match, per axis.
    template_px: Annotated[int, Range(ge=3, le=21, odd=True)] = 11  #: side of the compared patch, odd.
    #: orientation of a patch in space: facing the first camera, or learnt from later views (learnt).
    planes: Literal["facing", "learnt"] = "facing"
    #: least normalised cross-correlation of a match.
    min_correlation: Annotated[float, Range(ge=-1.0, le=1.0), Formerly("accept")] = 0.8
    #: size of the searched ellipse, in standard deviations.
    ellipse_sigmas: Annotated[Positive, Formerly("sigmas")] = 3.0
    #: maximum search radius in an ellipse.
    max_radius_px: Annotated[float, Range(gt=0.0, le=10000.0), Formerly("largest_px")] = 40.0
    #: features are initialised while fewer than this are in view.
    min_in_view: Annotated[CountOrNone, Formerly("in_view")] = 35
    new_per_frame: CountOrNone = 3  #: maximum features initialised in a frame; in the first one `measurements`.
    #: gate: squared Mahalanobis distance from the consensus motion beyond which a match is an outlier.
    gate_chi2: Annotated[Positive, Formerly("gate")] = 9.2
    spacing_px: NotNegative = 20.0  #: least distance of new features from others.
    border_px: Annotated[NotNegative, Formerly("margin_px")] = 8.0  #: features this close to the border are not used.
    #: a feature is not searched once its viewing direction has changed by this.
    max_turn_deg: Annotated[Angle, Formerly("turn_deg")] = 50.0
    #: a feature is not searched once its distance has changed by this factor.
    max_scale_change: Annotated[Ratio, Formerly("scale")] = 2.0
    #: a feature's patch is renewed once its viewing direction has changed by this …
    appearance_turn_deg: Annotated[Angle, Formerly("look_deg")] = 10.0
    #: … or its distance by this factor.
    appearance_scale_change: Annotated[Ratio, Formerly("look_scale")] = 1.15
    #: least number of searches before a feature may be dropped.
    min_attempts: Annotated[Count, Formerly("trial")] = 10
    #: a feature is dropped from all particles once more than this fraction of its searches failed.
    max_failure_ratio: Annotated[Fraction, Formerly("failure_ratio")] = 0.5
    #: a feature localises the camera only while its success rate, (1 + found) / (2 + attempts), is at least this: features
    #: on moving objects soon fall below it. A feature that has not been searched before is used, but not to test other
    #: matches.
    trusted_fraction: Annotated[Fraction, Formerly("trusted_share")] = 0.6
    #: the camera is lost if fewer than this fraction of the searched features is matched …
    lost_fraction: Annotated[Fraction, Formerly("lost_share")] = 0.25
    lost_frames: Count = 3  #: … in this many consecutive frames.
    #: tracking has recovered once at least this fraction is matched …
    recovered_fraction: Annotated[Fraction, Formerly("regained_share")] = 0.5
    recovered_features: Annotated[CountOrNone, Formerly("regained")] = 6  #: … and at least this many features.


@dataclass(frozen=True)
class RelocalisationConfig(Ranged):
    """Tracking loss: the pose prior while the camera is lost, and relocalisation in the map."""

    #: pose prior while lost: the last trusted pose, with a standard deviation of the rotation that grows by this.
    drift_rad_s: NotNegative = 0.25
    drift_m_s: NotNegative = 0.25  #: likewise of the position.
    #: standard deviation of the rotation for active search around the trusted pose; farther away the camera is relocalised
    #: by matching descriptors.
    search_std_rad: Annotated[NotNegative, Formerly("reach_rad")] = 0.05
    search_std_m: Annotated[NotNegative, Formerly("reach_m")] = 0.05  #: likewise of the position.
    #: maximum number of corners matched with the map's features, in an image without tracking.
    max_corners: Annotated[Count, Formerly("corners")] = 500
    spacing_px: NotNegative = 6.0  #: their least distance.
    #: ratio test: largest ratio of descriptor distances of the best and the second match (D. Lowe).
    descriptor_ratio: Annotated[Fraction, Formerly("ratio")] = 0.9
    #: largest relative standard deviation of depth of the features used.
    depth_std_ratio: Annotated[Positive, Formerly("depth_share")] = 0.3
    #: radius around projections within which features are matched, given a candidate pose.
    match_radius_px: Annotated[Positive, Formerly("around_px")] = 15.0
    #: inlier radius around a projection.
    inlier_px: Annotated[Positive, Formerly("within_px")] = 4.0
    #: number of RANSAC samples: triples of matches from which poses are computed.
    p3p_samples: Annotated[int, Range(ge=1, le=100000), Formerly("triples")] = 300
    min_inliers: Annotated[int, Range(ge=4), Formerly("inliers")] = 8  #: least number of inliers of a pose.
    #: least number of inliers if the last image before the loss confirms the motion.
    min_inliers_with_last_view: Annotated[int, Range(ge=4), Formerly("few")] = 5
    #: number of inliers from which on fewer features in view need to be matched afterwards.
    certain_inliers: Annotated[int, Range(ge=4), Formerly("sure")] = 12
    #: least inlier fraction of the matches.
    min_inlier_fraction: Annotated[Fraction, Formerly("inlier_share")] = 0.25
    #: least spread (standard deviation) of the inliers in their narrowest direction, in image widths.
    min_spread: Annotated[NotNegative, Formerly("spread")] = 0.03
    #: inflation of the pose's standard deviations, as errors of neighbouring landmarks are correlated.
    std_inflation: Annotated[Positive, Formerly("inflation")] = 3.0
    #: for a joint map: frames between attempts at place recognition while the camera is tracked with an uncertain pose.
    ask_every: Count = 10


@dataclass(frozen=True)
class CalibrationConfig(Ranged):
    """Priors of a camera's self-calibration, as standard deviations from the given calibration."""

    focal: Positive = 0.1  #: relative error of both focal lengths together.
    aspect: Positive = 0.01  #: relative error of each focal length on its own.
    distortion: Positive = 0.1  #: error of k1 and of k2.

    def cov(self) -> np.ndarray:
        """Covariance (4, 4) of log fx, log fy, k1 and k2."""
        cov = np.diag(np.square([self.aspect, self.aspect, self.distortion, self.distortion]))
        cov[:2, :2] += self.focal**2
        return cov


@dataclass(frozen=True)
class MonoConfig(RunConfig):
    """Monocular SLAM."""

    particles: Count = 50  #: number of particles.
    compiled: bool = True  #: run the fused kernels; false runs their NumPy twins.
    #: prior standard deviation of the start position around the one from resection, before the update by the known points.
    start_std_m: NotNegative = 1.0
    start_std_rad: NotNegative = 0.5  #: likewise of the rotation.
    #: frame: the known points are one rigid group whose frame is marginalised. points: they are separate landmarks, and each
    #: particle samples its pose among them in the first frame (E06).
    known: Literal["frame", "points"] = "frame"
    #: joint: once depths are known, one Gaussian of all landmarks, velocity and frame, given the last few frames, which stays
    #: consistent. particles: per-particle landmarks, Gaussians given the whole sampled path (E06). auto: joint, but particles
    #: if a lag is set, the velocity is sampled, or a user-defined `UnknownDepth` is given. A run localised in a known map is
    #: never joint.
    map: Literal["auto", "joint", "particles"] = "auto"
    #: for a joint map: number of frames sampled before they are merged into it. Below the effective sample size of the
    #: resampling threshold they are merged earlier, instead of resampling.
    window: Count = 2
    #: for a joint map: it starts once an adjustment of the first frames determines depths, and restarts once half of those
    #: in view were known in this many consecutive frames; until then particles have their own maps.
    settled_frames: Count = 30
    #: for a joint map: maximum number of landmarks of a sub-map. Those in view, and others up to half of this number, are
    #: passed on to the next sub-map; old ones return when they are in view. Points are never dropped; rays left behind are.
    submap: Annotated[Count, Formerly("active")] = 300
    #: for a joint map: the measurement noise. stated: as stated. learnt: as the residuals show. at_least: as stated, or larger
    #: if the residuals show that it is larger by a tenth or more. With learnt and at_least, features worse than most have more
    #: noise. With self-calibration, learnt is at_least, and only for features worse than most.
    noise: Literal["at_least", "learnt", "stated"] = "at_least"
    #: for a joint map: self-calibration, which estimates focal lengths, k1 and k2 together with the map.
    calibrate: Literal["off", "online"] = "off"
    #: maximum number of landmarks initialised in one frame.
    max_new_per_frame: Annotated[CountOrNone, Formerly("births_per_frame")] = 1000
    velocity: VelocityConfig = field(default_factory=VelocityConfig)  #: motion model.
    #: features of unknown depth.
    inverse_depth: Annotated[InverseDepthConfig, Formerly("ray")] = field(default_factory=InverseDepthConfig)
    start: StartConfig = field(default_factory=StartConfig)  #: initialisation without known points.
    search: SearchConfig = field(default_factory=SearchConfig)  #: active search of features in images.
    #: priors of the self-calibration.
    self_calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    #: tracking loss and relocalisation.
    relocalisation: Annotated[RelocalisationConfig, Formerly("recovery")] = field(default_factory=RelocalisationConfig)
    #: the proposal distribution.
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig(iterations=1))

    def start_cov(self) -> np.ndarray:
        """Covariance (6, 6) of the camera's start pose, [ω, v]."""
        return np.diag(np.repeat([self.start_std_rad, self.start_std_m], 3) ** 2)
