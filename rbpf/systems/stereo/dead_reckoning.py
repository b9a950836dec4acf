"""Where the camera has come since the filter was updated, and by odometry alone: pair after pair, over missing ones."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple, final

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import checked
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_motions import Known
from rbpf.motion.stereo_odometer import StereoOdometer
from rbpf.motion.stereo_odometry import StereoOdometry


class Pixels(NamedTuple):
    """Matches of two pairs: z (K, 3) and cov (K, 3, 3) in the earlier one, and in the later one."""

    z_prev: np.ndarray
    z_now: np.ndarray
    cov_prev: np.ndarray
    cov_now: np.ndarray


@dataclass(frozen=True)
class Reckoned:
    """What is known of a pair's pose before the filter sees it.

    Attributes:
        since_update: motion since the filter's last update.
        world_from_camera: (7,) by odometry alone; the first camera is the world.
        agree: (K,) which matches agree with the motion; none where nothing was matched.
        moving: (K,) which agree on another one: they are of things that move.
        note: what had to be assumed, in words; empty where nothing had.
        assumed: pairs since the filter's last update over which the motion was only assumed.
        waiting: pairs since the first of these.
        hidden: whether nothing in the pair stood still.
    """

    since_update: Odometry
    world_from_camera: np.ndarray
    agree: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    moving: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    note: str = ""
    assumed: int = 0
    waiting: int = 0
    hidden: bool = False

    @property
    def agreeing(self) -> int:
        """How many matches agree with the motion."""
        return int(self.agree.sum())


@final
class DeadReckoning:
    """Chains the increments of visual odometry from the last pair that could be measured.

    Args:
        odometer: estimates increments.
        dof: 3 keeps the camera in its x–z plane.
    """

    def __init__(self, odometer: StereoOdometer, dof: int) -> None:
        self.odometer = odometer
        self._plane = StereoOdometry(3 if dof == 3 else 6)
        self._stamp_ns: int | None = None
        self._at = Reckoned(standstill(), SE3.identity())
        self._passed = 0

    @property
    def begun(self) -> bool:
        """Whether there is a pair to measure from."""
        return self._stamp_ns is not None

    @property
    def in_doubt(self) -> bool:
        """Whether the motion since the filter's last update was only assumed, for all or part of the way."""
        return self._at.assumed > 0

    def begin(self, stamp_ns: int) -> Reckoned:
        """The first pair that can be measured from."""
        self._stamp_ns = stamp_ns
        return self._at

    def measured(
        self, stamp_ns: int, matches: Pixels, rng: np.random.Generator, known: Known | None = None
    ) -> Reckoned:
        """A pair that is matched with the last measured one; the next one is measured from it.

        Args:
            stamp_ns: its time.
            matches: of the two.
            rng: for the consensus.
            known: besides the matches, its density that of a motion since the filter's last update.
        """
        self.odometer.rng, before, known = rng, self._at, known or Known()
        density = known.log_density

        def after(increment: Odometry) -> float:
            return density(chained(before.since_update, self._plane.law(increment)))

        step = self.odometer.step(
            *matches, self._seconds(stamp_ns), replace(known, log_density=after, hidden=before.hidden)
        )
        missed = 0 if step.estimate.found else 1 + self._passed
        self._stamp_ns, self._passed = stamp_ns, 0
        self._at = replace(
            self._moved(step.odometry, step.estimate.inliers, step.note),
            moving=step.moving,
            assumed=before.assumed + missed,
            waiting=before.waiting + 1 if missed or before.assumed else 0,
            hidden=bool(step.moving.any() and not step.estimate.found),
        )
        return self._at

    def assumed(self, stamp_ns: int) -> Reckoned:
        """A pair that cannot be measured: the last velocity is expected to go on."""
        if not self.begun:
            return self._at
        self._passed += 1
        expected = self.odometer.prediction.law(self.odometer.velocity, self._seconds(stamp_ns))
        moved = self._moved(expected, np.zeros(0, dtype=bool), "")
        return replace(moved, assumed=self._at.assumed + self._passed)

    def is_later(self, stamp_ns: int) -> bool:
        """Whether time has passed since the last measured pair: without it there is no velocity."""
        return self._stamp_ns is None or stamp_ns > self._stamp_ns

    def updated(self) -> None:
        """The filter has taken the motion up to the last measured pair."""
        self._at = Reckoned(standstill(), self._at.world_from_camera)

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        at = self._at
        return {
            "reckoning/stamp_ns": np.array(
                [] if self._stamp_ns is None else [self._stamp_ns], dtype=np.int64
            ),
            "reckoning/velocity": self.odometer.velocity,
            "reckoning/delta": at.since_update.delta,
            "reckoning/cov": at.since_update.cov,
            "reckoning/world_from_camera": at.world_from_camera,
            "reckoning/missed": np.array([at.assumed, at.waiting, at.hidden, self._passed]),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`.

        Raises:
            InputError: they are not what they should be.
        """
        stamps = checked(arrays, "reckoning/stamp_ns", (None,), "i")
        self._stamp_ns = int(stamps[0]) if stamps.size else None
        self.odometer.velocity = checked(arrays, "reckoning/velocity", (6,), "f").copy()
        delta, cov, world = (
            checked(arrays, f"reckoning/{name}", shape, "f").copy()
            for name, shape in (("delta", (7,)), ("cov", (6, 6)), ("world_from_camera", (7,)))
        )
        motion, missed = Odometry(delta, cov), checked(arrays, "reckoning/missed", (4,), "i")
        assumed, waiting, hidden, self._passed = missed.tolist()
        self._at = Reckoned(motion, world, assumed=assumed, waiting=waiting, hidden=bool(hidden))

    def _seconds(self, stamp_ns: int) -> float:
        assert self._stamp_ns is not None
        return 1e-9 * (stamp_ns - self._stamp_ns)

    def _moved(self, step: Odometry, agree: np.ndarray, note: str) -> Reckoned:
        step = self._plane.law(step)
        world = SE3.compose(self._at.world_from_camera, step.delta)
        return Reckoned(chained(self._at.since_update, step), world, agree, note=note)


def standstill() -> Odometry:
    """No motion, for certain."""
    return Odometry(SE3.identity(), np.zeros((6, 6)))


def chained(first: Odometry, second: Odometry) -> Odometry:
    """One motion after another, with independent errors: C = Ad⁻¹ C₁ Ad⁻ᵀ + C₂ with Ad of the second.

    Mathematics (chain).
    """
    back = SE3.adjoint(SE3.inverse(second.delta))
    cov = gaussian.symmetrise(back @ first.cov @ back.T + second.cov)
    return Odometry(SE3.compose(first.delta, second.delta), cov)
