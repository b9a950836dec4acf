"""Dead reckoning of a stereo camera by visual odometry, between the filter's updates."""

from dataclasses import dataclass, field
from typing import final

import numpy as np

from rbpf.core.checkpoint import integers, numbers, poses, read
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry

_KEPT = {
    "stamp_ns": integers("stamps"),
    "velocity": numbers(6),
    "delta": poses(),
    "cov": numbers(6, 6),
    "world_from_camera": poses(),
    "missed": integers(4, least=0),
    "velocity_at_update": numbers(6),
    "noise": numbers("noisy", 6, 3),
    "left_over": numbers("followed", 3, 4),
}


@final
@dataclass(frozen=True, eq=False)
class DeadReckoning:
    """Composed visual odometry, pair by pair, also over pairs that could not be used.

    The state at a pair, before the filter's update.
    """

    stamp_ns: int | None = None  #: time of the last measured pair, the reference of the next one; or None.
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(6))  #: (6,) [ω, v] of the camera then, rad/s, m/s.
    since_update: Odometry = field(default_factory=Odometry.at_rest)  #: motion since the filter's last update.
    #: (7,) world_from_camera by odometry alone; the first camera is the world.
    world_from_camera: np.ndarray = field(default_factory=SE3.identity)
    assumed: int = 0  #: pairs since the filter's last update with an assumed motion.
    waiting: int = 0  #: pairs since the first of these.
    hidden: bool = False  #: whether nothing in the pair was static.
    passed_over: int = 0  #: pairs since the last measured one that could not be measured.
    velocity_at_update: np.ndarray = field(default_factory=lambda: np.zeros(6))
    #: (K, 6, 3) covariances of the last step's error, in the right chart there, with the pixel noise of each feature of the
    #: last measured pair, which the next step shares; empty if the step was not chained or not measured.
    noise: np.ndarray = field(default_factory=lambda: np.zeros((0, 6, 3)))
    #: (K, 3, 4) pixels and their covariance, at the filter's last update, of those features of the last measured pair that
    #: were tracked since then and not used by a joint map; zeros for others, and empty with other maps.
    left_over: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 4)))

    def seconds(self, stamp_ns: int) -> float:
        """Time since the last measured pair; infinite before the first."""
        return np.inf if self.stamp_ns is None else 1e-9 * (stamp_ns - self.stamp_ns)

    def moved(
        self,
        stamp_ns: int,
        step: Odometry,
        velocity: np.ndarray,
        is_assumed: bool = False,
        hidden: bool = False,
        cross: np.ndarray | None = None,
        noise: np.ndarray | None = None,
        left_over: np.ndarray | None = None,
    ) -> "DeadReckoning":
        """The state at the next pair, which was matched with the last measured one, or is passed over.

        `step` is the motion since the last measured pair, the prior's if it `is_assumed`; `cross` (6, 6) is the covariance
        between the last step's error and this one's, None for independent ones; `noise` and `left_over` are the attributes
        after this step.
        """
        missed = 1 + self.passed_over if is_assumed else 0
        return DeadReckoning(
            stamp_ns,
            velocity,
            self.since_update.then(step, cross=cross),
            SE3.compose(self.world_from_camera, step.delta),
            assumed=self.assumed + missed,
            waiting=self.waiting + 1 if missed or self.assumed else 0,
            hidden=hidden,
            velocity_at_update=self.velocity_at_update,
            noise=np.zeros((0, 6, 3)) if noise is None else noise,
            left_over=np.zeros((0, 3, 4)) if left_over is None else left_over,
        )

    def updated(self) -> "DeadReckoning":
        """The state after the filter's update with the motion up to the last measured pair."""
        world = self.world_from_camera
        return DeadReckoning(self.stamp_ns, self.velocity, world_from_camera=world, velocity_at_update=self.velocity)

    def arrays(self) -> dict[str, np.ndarray]:
        stamps = np.array([] if self.stamp_ns is None else [self.stamp_ns], dtype=np.int64)
        missed = np.array([self.assumed, self.waiting, self.hidden, self.passed_over])
        motion = self.since_update.delta, self.since_update.cov, self.world_from_camera
        parts = stamps, self.velocity, *motion, missed, self.velocity_at_update, self.noise, self.left_over
        return {f"reckoning/{name}": part for name, part in zip(_KEPT, parts, strict=True)}

    @classmethod
    def restored(cls, arrays: dict[str, np.ndarray]) -> "DeadReckoning":
        """The inverse of `arrays`; errors as `rbpf.core.checkpoint.read`."""
        stamps, velocity, delta, cov, world, missed, *rest = read(arrays, _KEPT, "reckoning/").values()
        assumed, waiting, hidden, passed_over = missed.tolist()
        stamp_ns = int(stamps[0]) if stamps.size else None
        motion = Odometry(delta, cov)
        return cls(stamp_ns, velocity, motion, world, assumed, waiting, bool(hidden), passed_over, *rest)
