"""Every setting of monocular SLAM on features, with its default, its unit and what it does."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from rbpf.errors import InputError
from rbpf.systems.filtering import ProposalConfig, ResamplingConfig


@dataclass(frozen=True)
class VelocityConfig:
    """Constant velocity, E06 §3.1.

    Attributes:
        mode: the velocity as a Kalman substate, sampled with the pose, or the paper's conditional mean.
        walk_rad_s: σ of E06 (4) for rotation: random walk of the angular velocity in one second, (rad/s)/√s.
        walk_m_s: likewise of the linear velocity, (m/s)/√s.
        start_rad_s: standard deviation of the angular velocity at the start.
        start_m_s: likewise of the linear velocity.
    """

    mode: Literal["marginal", "joint", "paper"] = "marginal"
    walk_rad_s: float = 3.0
    walk_m_s: float = 1.5
    start_rad_s: float = 0.5
    start_m_s: float = 0.5


@dataclass(frozen=True)
class RayConfig:
    """Landmarks whose depth is not known yet, E06 §5.

    Attributes:
        constrain: how they constrain the pose: by their epipolar line (the paper's); by the 2-D marginal with finite
            depth variance from where on depth is measured, and by the line before, if points are seen that hold the
            scale; or not at all.
        rho_per_m: mean inverse depth of a new landmark, 1/m; without known points it sets the scale.
        std_rho_per_m: its standard deviation.
        adapt: a new ray starts at the median inverse depth of the points just seen, with the same relative deviation at
            least, where four or more were seen.
        ready_ratio: a ray becomes a point when the standard deviation of its inverse depth is below this fraction of it.
        ready_weight: fraction of the particles' weight in which it must be.
        least_px: depth is measured once a change of ρ by its first standard deviation moves the image by this. Before,
            the parallax tells more of the error of the sampled pose than of depth, and the prior of ρ, which does not
            change as long as depth is not measured, would count anew in every frame.
        line_px: likewise, from where on there is an epipolar line; well below the noise of a measurement, since
            what depth moves below it is not modelled and stays the same from frame to frame.
    """

    constrain: Literal["epipolar", "marginal", "off"] = "marginal"
    rho_per_m: float = 0.8
    std_rho_per_m: float = 0.6
    adapt: bool = True
    ready_ratio: float = 0.1
    ready_weight: float = 0.95
    least_px: float = 10.0
    line_px: float = 0.3


@dataclass(frozen=True)
class StartConfig:
    """A start without known points: the first frames are adjusted in one piece, and the particles drawn anew from that.

    Attributes:
        redraw: whether they are; else the particles go on with what the prior of depth has made of the first frames.
        first: the first adjustment comes after so many frames …
        growth: … and the next ones after this many times as many each.
        frames: that take part in an adjustment at most, evenly chosen.
        depth_fraction: it ends when the depth of half of the features in view is known to this fraction of it.
    """

    RENAMED: ClassVar[dict[str, str]] = {
        "depth_share": "depth_fraction",
    }

    redraw: bool = True
    first: int = 6
    growth: float = 1.25
    frames: int = 60
    depth_fraction: float = 0.03

    def __post_init__(self) -> None:
        """Checks what would never end, or never begin."""
        if self.first < 3 or self.frames < 3:
            raise InputError(
                f"start.first and start.frames must be at least 3, got {self.first}, {self.frames}"
            )
        if not 1.0 < self.growth < float("inf"):
            raise InputError(f"start.growth must be above 1 and finite, got {self.growth}")


@dataclass(frozen=True)
class SearchConfig:
    """Active search in images, E06 §4.1.

    Attributes:
        measurements: landmarks looked for in a frame at most.
        noise_px: standard deviation of a found place, per axis.
        template_px: side of the patch that is compared, odd.
        accept: least normalised cross-correlation of a match.
        sigmas: size of the ellipse that is searched, in standard deviations.
        largest_px: an ellipse is not searched further than this from its centre.
        in_view: features are started while fewer than this are in view.
        new_per_frame: features started in a frame at most; in the first one, as many as are measured.
        gate: squared Mahalanobis distance from the motion that most matches agree on, beyond which one is dropped.
        spacing_px: new features keep this distance from others.
        margin_px: features this near to the border are left alone.
        turn_deg: a feature is not looked for once its line of sight has turned by this.
        scale: nor once it is this many times nearer or farther than at first.
        look_deg: a feature's look is kept anew when its line of sight has turned by this since it was kept last …
        look_scale: … or it is this many times nearer or farther.
        trial: a feature is judged after having been looked for this often.
        failure_ratio: it is dropped from all particles when it was not found in more than this fraction.
        trusted_fraction: a feature tells where the camera is only while it has been found in this fraction of the looks,
            (1 + found) / (2 + looks): what moves by itself is soon not where a thing at rest would be.
        lost_fraction: the camera is lost when fewer than this fraction of what was looked for is found …
        lost_frames: … in this many frames in a row.
        regained_fraction: it is not lost any more when at least this fraction is found …
        regained: … and so many features.
    """

    RENAMED: ClassVar[dict[str, str]] = {
        "trusted_share": "trusted_fraction",
        "lost_share": "lost_fraction",
        "regained_share": "regained_fraction",
    }

    measurements: int = 25
    noise_px: float = 1.0
    template_px: int = 11
    accept: float = 0.8
    sigmas: float = 3.0
    largest_px: float = 40.0
    in_view: int = 35
    new_per_frame: int = 3
    gate: float = 9.2
    spacing_px: float = 20.0
    margin_px: float = 8.0
    turn_deg: float = 50.0
    scale: float = 2.0
    look_deg: float = 10.0
    look_scale: float = 1.15
    trial: int = 10
    failure_ratio: float = 0.5
    trusted_fraction: float = 0.6
    lost_fraction: float = 0.25
    lost_frames: int = 3
    regained_fraction: float = 0.5
    regained: int = 6


@dataclass(frozen=True)
class RecoveryConfig:
    """What happens when the camera is lost.

    Attributes:
        drift_rad_s: while lost it stays at its last trusted pose, with a standard deviation that grows by this.
        drift_m_s: likewise of its position.
        reach_rad: around the trusted pose landmarks are looked for with this standard deviation; further away the
            camera is found by what landmarks look like.
        reach_m: likewise of its position.
        corners: places of a lost image that are compared with the map's features at most.
        spacing_px: their least distance.
        ratio: a feature's distance from the place most like it is below this fraction of that from the next.
        depth_fraction: features take part whose depth is known to this fraction of it.
        around_px: the features are looked for this near to where a pose says that they are.
        within_px: a feature agrees with a pose when it is seen as near to its projection.
        triples: of features from which poses are computed.
        inliers: features that must agree with a pose.
        few: it is enough that so many agree if the last view before the loss shows the same motion.
        sure: when so many agree, less has to be found of what should then be seen.
        inlier_fraction: fraction of the matches that must agree.
        spread: standard deviation of the inliers' places in their narrowest direction, in widths of the image.
        inflation: of the pose's standard deviations: the map's errors are common to neighbours.
    """

    RENAMED: ClassVar[dict[str, str]] = {
        "depth_share": "depth_fraction",
        "inlier_share": "inlier_fraction",
    }

    drift_rad_s: float = 0.25
    drift_m_s: float = 0.25
    reach_rad: float = 0.05
    reach_m: float = 0.05
    corners: int = 500
    spacing_px: float = 6.0
    ratio: float = 0.9
    depth_fraction: float = 0.3
    around_px: float = 15.0
    within_px: float = 4.0
    triples: int = 300
    inliers: int = 8
    few: int = 5
    sure: int = 12
    inlier_fraction: float = 0.25
    spread: float = 0.03
    inflation: float = 3.0


@dataclass(frozen=True)
class MonoConfig:
    """A run of monocular SLAM on features.

    Attributes:
        particles: number of particles.
        seed: of the only random generator.
        compiled: run the fused kernels; false runs their NumPy twins.
        start_std_m: how far from its resected place the camera may be at the start, before the known points count.
        start_std_rad: likewise its rotation.
        known: the known points as one rigid group whose frame is marginalised, or as separate landmarks in a world
            whose place each particle samples in the first frame (E06).
        max_new_per_frame: landmarks started in one frame at most.
        lag: frames of the particles' paths that are kept, None keeps all.
        checkpoint_every: frames between checkpoints.
        velocity: how the camera moves.
        ray: landmarks of unknown depth.
        start: without known points.
        search: of landmarks in images.
        recovery: when the camera is lost.
        proposal: where particles are sampled.
        resampling: when and how.
    """

    RENAMED: ClassVar[dict[str, str]] = {
        "births_per_frame": "max_new_per_frame",
    }

    particles: int = 50
    seed: int = 0
    compiled: bool = True
    start_std_m: float = 1.0
    start_std_rad: float = 0.5
    known: Literal["frame", "points"] = "frame"
    max_new_per_frame: int = 1000
    lag: int | None = None
    checkpoint_every: int = 500
    velocity: VelocityConfig = field(default_factory=VelocityConfig)
    ray: RayConfig = field(default_factory=RayConfig)
    start: StartConfig = field(default_factory=StartConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig(iterations=1))
    resampling: ResamplingConfig = field(default_factory=ResamplingConfig)

    def __post_init__(self) -> None:
        """Checks what no part checks itself."""
        if self.particles < 1:
            raise InputError(f"particles must be at least 1, got {self.particles}")
        if self.checkpoint_every < 1:
            raise InputError(f"checkpoint_every must be at least 1, got {self.checkpoint_every}")
