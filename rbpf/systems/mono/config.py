"""Every setting of monocular SLAM, with its default, its unit and what it does."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np

from rbpf.ranges import Angle, Count, CountOrNone, Fraction, NotNegative, Positive, Range, Ranged, Ratio, Seed
from rbpf.systems.filtering import ProposalConfig, ResamplingConfig


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

    RENAMED: ClassVar[dict[str, str]] = {
        "constrain": "pose_update",
        "rho_per_m": "mean_per_m",
        "std_rho_per_m": "std_per_m",
        "adapt": "from_scene_depth",
        "ready_ratio": "promote_std_ratio",
        "ready_weight": "promote_weight",
        "least_px": "depth_parallax_px",
        "line_px": "epipolar_parallax_px",
    }

    #: how they constrain the pose: by their epipolar line (the paper's); by the 2-D marginal with finite depth
    #: variance from where on depth is measured, and by the line before, if points are seen that hold the scale; or
    #: not at all.
    pose_update: Literal["epipolar", "marginal", "off"] = "marginal"
    mean_per_m: Positive = 0.8  #: mean inverse depth of a new feature, 1/m; without known points it sets the scale.
    std_per_m: Positive = 0.6  #: its standard deviation.
    #: a new feature starts at the median inverse depth of the points just seen, with the same relative deviation at
    #: least, where four or more were seen.
    from_scene_depth: bool = True
    #: a ray becomes a point when the standard deviation of its inverse depth is below this fraction of it.
    promote_std_ratio: Positive = 0.1
    promote_weight: Fraction = 0.95  #: fraction of the particles' weight in which it must be.
    #: depth is measured once a change of ρ by its first standard deviation moves the image by this. Before, the
    #: parallax says more of the error of the sampled pose than of depth, and the prior of ρ, which does not change as
    #: long as depth is not measured, would count anew in every frame.
    depth_parallax_px: Positive = 10.0
    #: likewise, from where on there is an epipolar line. Before, the 2-D marginal counts, with a prior of ρ so wide
    #: that it hardly does. More holds a camera at rest better, and follows what moves by itself.
    epipolar_parallax_px: Positive = 0.3


@dataclass(frozen=True)
class StartConfig(Ranged):
    """A start without known points: the first frames are adjusted in batch, and the particles resampled from the result."""

    RENAMED: ClassVar[dict[str, str]] = {
        "redraw": "batch_adjust",
        "first": "first_adjustment",
        "frames": "max_frames",
        "depth_share": "depth_std_ratio",
        "depth_fraction": "depth_std_ratio",
    }

    #: whether they are; else the particles go on with what the prior of depth has made of the first frames.
    batch_adjust: bool = True
    first_adjustment: Annotated[int, Range(ge=3)] = 6  #: the first one comes after so many frames …
    growth: Annotated[float, Range(gt=1.0, le=100.0)] = 1.25  #: … and the next ones after this many times as many each.
    max_frames: Annotated[int, Range(ge=3)] = 60  #: that take part in an adjustment at most, evenly chosen.
    #: the start ends when half of the depths in view have a standard deviation below this fraction of them.
    depth_std_ratio: Positive = 0.03


@dataclass(frozen=True)
class SearchConfig(Ranged):
    """Active search in images, E06 §4.1."""

    RENAMED: ClassVar[dict[str, str]] = {
        "accept": "min_correlation",
        "sigmas": "ellipse_sigmas",
        "largest_px": "max_radius_px",
        "in_view": "min_in_view",
        "gate": "gate_chi2",
        "margin_px": "border_px",
        "turn_deg": "max_turn_deg",
        "scale": "max_scale_change",
        "look_deg": "appearance_turn_deg",
        "look_scale": "appearance_scale_change",
        "trial": "min_attempts",
        "failure_ratio": "max_failure_ratio",
        "trusted_share": "trusted_fraction",
        "lost_share": "lost_fraction",
        "regained_share": "recovered_fraction",
        "regained_fraction": "recovered_fraction",
        "regained": "recovered_features",
    }

    measurements: Count = 25  #: features looked for in a frame at most.
    noise_px: Positive = 1.0  #: standard deviation of a found place, per axis.
    template_px: Annotated[int, Range(ge=3, le=21, odd=True)] = 11  #: side of the patch that is compared, odd.
    min_correlation: Annotated[float, Range(ge=-1.0, le=1.0)] = 0.8  #: least normalised cross-correlation of a match.
    ellipse_sigmas: Positive = 3.0  #: size of the ellipse that is searched, in standard deviations.
    #: an ellipse is not searched further than this from its centre.
    max_radius_px: Annotated[float, Range(gt=0.0, le=10000.0)] = 40.0
    min_in_view: CountOrNone = 35  #: features are started while fewer than this are in view.
    new_per_frame: CountOrNone = 3  #: features started in a frame at most; in the first one, as many as are measured.
    #: squared Mahalanobis distance from the motion that most matches agree on, beyond which one is dropped.
    gate_chi2: Positive = 9.2
    spacing_px: NotNegative = 20.0  #: new features keep this distance from others.
    border_px: NotNegative = 8.0  #: features this near to the border are left alone.
    max_turn_deg: Angle = 50.0  #: a feature is not looked for once its line of sight has turned by this.
    max_scale_change: Ratio = 2.0  #: nor once it is this many times nearer or farther than at first.
    #: a feature's last appearance is renewed when its line of sight has turned by this since …
    appearance_turn_deg: Angle = 10.0
    appearance_scale_change: Ratio = 1.15  #: … or it is this many times nearer or farther.
    min_attempts: Count = 10  #: a feature is judged after having been looked for this often.
    #: it is dropped from all particles when it was not found in more than this fraction.
    max_failure_ratio: Fraction = 0.5
    #: a feature says where the camera is only while it has been found in this fraction of the attempts, (1 + found) /
    #: (2 + attempts): what moves by itself is soon not where a thing at rest would be.
    trusted_fraction: Fraction = 0.6
    #: the camera is lost when fewer than this fraction of what was looked for is found …
    lost_fraction: Fraction = 0.25
    lost_frames: Count = 3  #: … in this many frames in a row.
    recovered_fraction: Fraction = 0.5  #: it is not lost any more when at least this fraction is found …
    recovered_features: CountOrNone = 6  #: … and so many features.


@dataclass(frozen=True)
class RelocalisationConfig(Ranged):
    """Tracking loss: the pose prior while the camera is lost, and how it is found in the map again."""

    RENAMED: ClassVar[dict[str, str]] = {
        "reach_rad": "search_std_rad",
        "reach_m": "search_std_m",
        "corners": "max_corners",
        "ratio": "descriptor_ratio",
        "depth_share": "depth_std_ratio",
        "depth_fraction": "depth_std_ratio",
        "around_px": "match_radius_px",
        "within_px": "inlier_px",
        "triples": "p3p_samples",
        "inliers": "min_inliers",
        "few": "min_inliers_with_last_view",
        "sure": "certain_inliers",
        "inlier_share": "min_inlier_fraction",
        "inlier_fraction": "min_inlier_fraction",
        "spread": "min_spread",
        "inflation": "std_inflation",
    }

    #: while lost it stays at its last trusted pose, with a standard deviation that grows by this.
    drift_rad_s: NotNegative = 0.25
    drift_m_s: NotNegative = 0.25  #: likewise of its position.
    #: around the trusted pose features are looked for with this standard deviation; further away the camera is found
    #: by matching descriptors.
    search_std_rad: NotNegative = 0.05
    search_std_m: NotNegative = 0.05  #: likewise of its position.
    max_corners: Count = 500  #: corners of a lost image that are compared with the map's features at most.
    spacing_px: NotNegative = 6.0  #: their least distance.
    #: of the descriptor distances of a feature from its best and its next match, at most (D. Lowe).
    descriptor_ratio: Fraction = 0.9
    #: features take part whose depth has a standard deviation below this fraction of it.
    depth_std_ratio: Positive = 0.3
    match_radius_px: Positive = 15.0  #: around a candidate pose, features are matched this near to their projections.
    inlier_px: Positive = 4.0  #: a match agrees with a pose when it is as near to its projection.
    p3p_samples: Annotated[int, Range(ge=1, le=100000)] = 300  #: triples of matches from which poses are computed.
    min_inliers: Annotated[int, Range(ge=4)] = 8  #: features that must agree with a pose.
    #: so many are enough if the last image before the loss shows the same motion.
    min_inliers_with_last_view: Annotated[int, Range(ge=4)] = 5
    #: when so many agree, less has to be found of what should then be seen.
    certain_inliers: Annotated[int, Range(ge=4)] = 12
    min_inlier_fraction: Fraction = 0.25  #: fraction of the matches that must agree.
    #: standard deviation of the inliers' places in their narrowest direction, in widths of the image.
    min_spread: NotNegative = 0.03
    std_inflation: Positive = 3.0  #: of the pose's standard deviations: the map's errors are common to neighbours.


@dataclass(frozen=True)
class MonoConfig(Ranged):
    """Monocular SLAM."""

    RENAMED: ClassVar[dict[str, str]] = {
        "births_per_frame": "max_new_per_frame",
        "ray": "inverse_depth",
        "recovery": "relocalisation",
    }

    particles: Count = 50  #: number of particles.
    seed: Seed = 0  #: of the only random generator.
    compiled: bool = True  #: run the fused kernels; false runs their NumPy twins.
    #: how far from its resected place the camera may be at the start, before the known points count.
    start_std_m: NotNegative = 1.0
    start_std_rad: NotNegative = 0.5  #: likewise its rotation.
    #: the known points as one rigid group whose frame is marginalised, or as separate landmarks in a world whose
    #: place each particle samples in the first frame (E06).
    known: Literal["frame", "points"] = "frame"
    max_new_per_frame: CountOrNone = 1000  #: landmarks started in one frame at most.
    #: frames of the particles' paths that are kept; None keeps all of a recording, and the last 150 where no end is known.
    lag: Count | None = None
    checkpoint_every: Count = 500  #: frames between checkpoints.
    velocity: VelocityConfig = field(default_factory=VelocityConfig)  #: how the camera moves.
    #: features whose depth is not known yet.
    inverse_depth: InverseDepthConfig = field(default_factory=InverseDepthConfig)
    start: StartConfig = field(default_factory=StartConfig)  #: without known points.
    search: SearchConfig = field(default_factory=SearchConfig)  #: of features in images.
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)  #: when the camera is lost.
    #: where particles are sampled.
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig(iterations=1))
    resampling: ResamplingConfig = field(default_factory=ResamplingConfig)  #: when and how.
