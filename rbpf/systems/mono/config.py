"""Every setting of monocular SLAM on features, with its default, its unit and what it does."""

from dataclasses import dataclass, field
from typing import Literal

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
        constrain: how they constrain the pose: by their epipolar line (the paper's), by the 2-D marginal with finite
            depth variance, or not at all.
        rho_per_m: mean inverse depth of a new landmark, 1/m; without known points it sets the scale.
        std_rho_per_m: its standard deviation.
        ready_ratio: a ray becomes a point when the standard deviation of its inverse depth is below this share of it.
        ready_weight: share of the particles' weight in which it must be.
        least_px: depth is measured once a change of ρ by its first standard deviation moves the image by this.
    """

    constrain: Literal["epipolar", "marginal", "off"] = "marginal"
    rho_per_m: float = 0.8
    std_rho_per_m: float = 0.4
    ready_ratio: float = 0.1
    ready_weight: float = 0.95
    least_px: float = 1.0


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
        births_per_frame: landmarks started in one frame at most.
        velocity: how the camera moves.
        ray: landmarks of unknown depth.
        proposal: where particles are sampled.
        resampling: when and how.
    """

    particles: int = 50
    seed: int = 0
    compiled: bool = True
    start_std_m: float = 1.0
    start_std_rad: float = 0.5
    known: Literal["frame", "points"] = "frame"
    births_per_frame: int = 1000
    velocity: VelocityConfig = field(default_factory=VelocityConfig)
    ray: RayConfig = field(default_factory=RayConfig)
    proposal: ProposalConfig = field(default_factory=lambda: ProposalConfig(iterations=1))
    resampling: ResamplingConfig = field(default_factory=ResamplingConfig)

    def __post_init__(self) -> None:
        """Checks what no part checks itself."""
        if self.particles < 1:
            raise InputError(f"particles must be at least 1, got {self.particles}")
