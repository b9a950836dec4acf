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
        """Standard deviation (6,) of the velocity's walk in one second, (rad/s, m/s)/√s."""
        return np.repeat([self.walk_rad_s, self.walk_m_s], 3)

    def start_std(self) -> np.ndarray:
        """Standard deviation (6,) of a velocity of which nothing is known, (rad/s, m/s)."""
        return np.repeat([self.start_rad_s, self.start_m_s], 3)


@dataclass(frozen=True)
class InverseDepthConfig(Ranged):
    """Features whose depth is not known yet: rays with an inverse depth, E06 §5."""

    #: how they constrain the pose: by their epipolar line (the paper's); by the 2-D marginal with finite depth
    #: variance from where on depth is measured, and by the line before, if points are seen that hold the scale; or
    #: not at all.
    pose_update: Annotated[Literal["epipolar", "marginal", "off"], Formerly("constrain")] = "marginal"
    #: mean inverse depth of a new feature, 1/m; without known points it sets the scale.
    mean_per_m: Annotated[Positive, Formerly("rho_per_m")] = 0.8
    std_per_m: Annotated[Positive, Formerly("std_rho_per_m")] = 0.6  #: its standard deviation.
    #: a new feature starts at the median inverse depth of the points just seen, with the same relative deviation at
    #: least, where four or more were seen.
    from_scene_depth: Annotated[bool, Formerly("adapt")] = True
    #: a ray becomes a point when the standard deviation of its inverse depth is below this fraction of it.
    promote_std_ratio: Annotated[Positive, Formerly("ready_ratio")] = 0.1
    #: fraction of the particles' weight in which it must be.
    promote_weight: Annotated[Fraction, Formerly("ready_weight")] = 0.95
    #: depth is measured once a change of ρ by its first standard deviation moves the image by this. Before, the
    #: parallax says more of the error of the sampled pose than of depth, and the prior of ρ, which does not change as
    #: long as depth is not measured, would count anew in every frame.
    depth_parallax_px: Annotated[Positive, Formerly("least_px")] = 10.0
    #: likewise, from where on what moves in the image has an epipolar line. Before, the 2-D marginal counts, with a prior
    #: of ρ so wide that it hardly does; with the prior as it is, where known points are seen, of what has not moved.
    epipolar_parallax_px: Annotated[Positive, Formerly("line_px")] = 0.3


@dataclass(frozen=True)
class StartConfig(Ranged):
    """The first frames are adjusted in batch; without known points particles are resampled, or a map begins, there."""

    #: whether they are, without known points; else the particles go on with what the prior of depth has made of them.
    batch_adjust: Annotated[bool, Formerly("redraw")] = True
    first_adjustment: Annotated[int, Range(ge=3), Formerly("first")] = 6  #: the first one comes after so many frames …
    growth: Annotated[float, Range(gt=1.0, le=100.0)] = 1.25  #: … and the next ones after this many times as many each.
    #: that take part in an adjustment at most, evenly chosen.
    max_frames: Annotated[int, Range(ge=3), Formerly("frames")] = 60
    #: the start ends when half of the depths in view have a standard deviation below this fraction of them; or below three
    #: times that, if there are more frames than take part, and depths are known no better than in the adjustment before.
    depth_std_ratio: Annotated[Positive, Formerly("depth_share")] = 0.01

    def is_due(self, count: int) -> bool:
        """Whether an adjustment comes after so many frames."""
        due = self.first_adjustment
        while due < count:
            due = self.next_after(due)
        return due == count

    def next_after(self, count: int) -> int:
        """Frames after which the next adjustment comes, where the last one came after `count`."""
        return max(int(np.ceil(self.growth * count)), count + 1)


@dataclass(frozen=True)
class SearchConfig(Ranged):
    """Active search in images, E06 §4.1."""

    measurements: Count = 25  #: features looked for in a frame at most.
    noise_px: Positive = 1.0  #: standard deviation of a found place, per axis.
    template_px: Annotated[int, Range(ge=3, le=21, odd=True)] = 11  #: side of the patch that is compared, odd.
    #: how a patch lies in space: it faces the camera that saw it first; or whatever its looks in later views say (learnt).
    planes: Literal["facing", "learnt"] = "facing"
    #: least normalised cross-correlation of a match.
    min_correlation: Annotated[float, Range(ge=-1.0, le=1.0), Formerly("accept")] = 0.8
    #: size of the ellipse that is searched, in standard deviations.
    ellipse_sigmas: Annotated[Positive, Formerly("sigmas")] = 3.0
    #: an ellipse is not searched further than this from its centre.
    max_radius_px: Annotated[float, Range(gt=0.0, le=10000.0), Formerly("largest_px")] = 40.0
    #: features are started while fewer than this are in view.
    min_in_view: Annotated[CountOrNone, Formerly("in_view")] = 35
    new_per_frame: CountOrNone = 3  #: features started in a frame at most; in the first one, as many as are measured.
    #: squared Mahalanobis distance from the motion that most matches agree on, beyond which one is dropped.
    gate_chi2: Annotated[Positive, Formerly("gate")] = 9.2
    spacing_px: NotNegative = 20.0  #: new features keep this distance from others.
    border_px: Annotated[NotNegative, Formerly("margin_px")] = 8.0  #: features this near to the border are left alone.
    #: a feature is not looked for once its line of sight has turned by this.
    max_turn_deg: Annotated[Angle, Formerly("turn_deg")] = 50.0
    #: nor once it is this many times nearer or farther than at first.
    max_scale_change: Annotated[Ratio, Formerly("scale")] = 2.0
    #: a feature's last appearance is renewed when its line of sight has turned by this since …
    appearance_turn_deg: Annotated[Angle, Formerly("look_deg")] = 10.0
    #: … or it is this many times nearer or farther.
    appearance_scale_change: Annotated[Ratio, Formerly("look_scale")] = 1.15
    #: a feature is judged after having been looked for this often.
    min_attempts: Annotated[Count, Formerly("trial")] = 10
    #: it is dropped from all particles when it was not found in more than this fraction.
    max_failure_ratio: Annotated[Fraction, Formerly("failure_ratio")] = 0.5
    #: a feature says where the camera is only while it has been found in this fraction of the attempts, (1 + found) /
    #: (2 + attempts): what moves by itself is soon not where a thing at rest would be. One that was only begun so far
    #: is used, but other matches are not judged by it.
    trusted_fraction: Annotated[Fraction, Formerly("trusted_share")] = 0.6
    #: the camera is lost when fewer than this fraction of what was looked for is found …
    lost_fraction: Annotated[Fraction, Formerly("lost_share")] = 0.25
    lost_frames: Count = 3  #: … in this many frames in a row.
    #: it is not lost any more when at least this fraction is found …
    recovered_fraction: Annotated[Fraction, Formerly("regained_share")] = 0.5
    recovered_features: Annotated[CountOrNone, Formerly("regained")] = 6  #: … and so many features.


@dataclass(frozen=True)
class RelocalisationConfig(Ranged):
    """Tracking loss: the pose prior while the camera is lost, and how it is found in the map again."""

    #: while lost it stays at its last trusted pose, with a standard deviation that grows by this.
    drift_rad_s: NotNegative = 0.25
    drift_m_s: NotNegative = 0.25  #: likewise of its position.
    #: around the trusted pose features are looked for with this standard deviation; further away the camera is found
    #: by matching descriptors.
    search_std_rad: Annotated[NotNegative, Formerly("reach_rad")] = 0.05
    search_std_m: Annotated[NotNegative, Formerly("reach_m")] = 0.05  #: likewise of its position.
    #: corners of a lost image that are compared with the map's features at most.
    max_corners: Annotated[Count, Formerly("corners")] = 500
    spacing_px: NotNegative = 6.0  #: their least distance.
    #: of the descriptor distances of a feature from its best and its next match, at most (D. Lowe).
    descriptor_ratio: Annotated[Fraction, Formerly("ratio")] = 0.9
    #: features take part whose depth has a standard deviation below this fraction of it.
    depth_std_ratio: Annotated[Positive, Formerly("depth_share")] = 0.3
    #: around a candidate pose, features are matched this near to their projections.
    match_radius_px: Annotated[Positive, Formerly("around_px")] = 15.0
    #: a match agrees with a pose when it is as near to its projection.
    inlier_px: Annotated[Positive, Formerly("within_px")] = 4.0
    #: triples of matches from which poses are computed.
    p3p_samples: Annotated[int, Range(ge=1, le=100000), Formerly("triples")] = 300
    min_inliers: Annotated[int, Range(ge=4), Formerly("inliers")] = 8  #: features that must agree with a pose.
    #: so many are enough if the last image before the loss shows the same motion.
    min_inliers_with_last_view: Annotated[int, Range(ge=4), Formerly("few")] = 5
    #: when so many agree, less has to be found of what should then be seen.
    certain_inliers: Annotated[int, Range(ge=4), Formerly("sure")] = 12
    #: fraction of the matches that must agree.
    min_inlier_fraction: Annotated[Fraction, Formerly("inlier_share")] = 0.25
    #: standard deviation of the inliers' places in their narrowest direction, in widths of the image.
    min_spread: Annotated[NotNegative, Formerly("spread")] = 0.03
    #: of the pose's standard deviations: the map's errors are common to neighbours.
    std_inflation: Annotated[Positive, Formerly("inflation")] = 3.0
    #: of a joint map: frames between two questions where a tracked camera has been that is unsure of its place.
    ask_every: Count = 10


@dataclass(frozen=True)
class CalibrationConfig(Ranged):
    """A camera that calibrates itself: how far its calibration may be from what is given, as standard deviations."""

    focal: Positive = 0.1  #: of both focal lengths together, as a fraction.
    aspect: Positive = 0.01  #: of one by the other, as a fraction.
    distortion: Positive = 0.1  #: of k1 and of k2.

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
    #: how far from its resected place the camera may be at the start, before the known points count.
    start_std_m: NotNegative = 1.0
    start_std_rad: NotNegative = 0.5  #: likewise its rotation.
    #: the known points as one rigid group whose frame is marginalised, or as separate landmarks in a world whose
    #: place each particle samples in the first frame (E06).
    known: Literal["frame", "points"] = "frame"
    #: as soon as depths are known, one Gaussian of all landmarks, velocity and frame, given the last few frames (joint): an
    #: uncertainty that stays true; or every particle's own landmarks, each of them a Gaussian given the whole sampled
    #: path (particles, E06). By default (auto) joint, but particles where a lag is set, the velocity is sampled, or
    #: features of unknown depth are of a kind of one's own. A known map that the camera is found in is never joint.
    map: Literal["auto", "joint", "particles"] = "auto"
    #: of a joint map: frames sampled, at most, before they are taken into it; fewer where the effective sample size falls
    #: below the threshold of resampling, which does not take place.
    window: Count = 2
    #: of a joint map: it begins as soon as an adjustment of the first frames knows depths, and is begun anew once half of
    #: those in view were known in so many frames in a row; until it begins particles have maps of their own.
    settled_frames: Count = 30
    #: of a joint map: landmarks beyond which a sub-map ends; those in view, and others up to half of these, go over into the
    #: next one, and old ones come back when they are in view. No point is dropped; rays that are left behind are.
    submap: Annotated[Count, Formerly("active")] = 300
    #: of a joint map: the noise of what is measured is the one that is stated, unless what the map makes of it says that it
    #: is larger by a tenth or more, and then that (at_least); or whatever that says (learnt); a feature that is worse than
    #: most has more, in both. Or as stated (stated). Of a camera that calibrates itself, learnt is at_least, and of features
    #: that are worse alone.
    noise: Literal["at_least", "learnt", "stated"] = "at_least"
    #: of a joint map: the camera calibrates itself, its focal lengths, k1 and k2 being estimated with everything else.
    calibrate: Literal["off", "online"] = "off"
    #: landmarks started in one frame at most.
    max_new_per_frame: Annotated[CountOrNone, Formerly("births_per_frame")] = 1000
    velocity: VelocityConfig = field(default_factory=VelocityConfig)  #: how the camera moves.
    #: features whose depth is not known yet.
    inverse_depth: Annotated[InverseDepthConfig, Formerly("ray")] = field(default_factory=InverseDepthConfig)
    start: StartConfig = field(default_factory=StartConfig)  #: without known points.
    search: SearchConfig = field(default_factory=SearchConfig)  #: of features in images.
    #: what is known of a camera that calibrates itself.
    self_calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    #: when the camera is lost.
    relocalisation: Annotated[RelocalisationConfig, Formerly("recovery")] = field(default_factory=RelocalisationConfig)
    #: where particles are sampled.
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig(iterations=1))

    def start_cov(self) -> np.ndarray:
        """Covariance (6, 6) of where the camera may be at the start, [ω, v]."""
        return np.diag(np.repeat([self.start_std_rad, self.start_std_m], 3) ** 2)
