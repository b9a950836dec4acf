"""Filters of N particles that observe K of M landmarks per step: a robot on a circle inside a ring of landmarks."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from benchmarks.rows import Diversity
from rbpf.core.filter import Filter
from rbpf.core.models import Belief, ObservationModel, Observations, Records, Sensor
from rbpf.core.proposals import EkfProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.lie import SE2, SE3, SE2Group, SE3Group
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.range_bearing import RangeBearing

CIRCLE = 3.0
RING = (8.0, 12.0)
STD_Z = np.array([0.02, 0.005, 0.005])
STD_MOTION = 0.01
STD_LANDMARK = 0.01
STRIDE = 0.05
BORN_TOGETHER = 100
SETTLING = 4
MANY = 2_000


@dataclass(frozen=True)
class Frame:
    """Measurements z (K, p) with covariances (K, p, p) of landmarks ids (K,), and the odometry before them."""

    ids: np.ndarray
    z: np.ndarray
    cov: np.ndarray
    control: Odometry


class KnownLandmarks(Sensor):
    """Passes on a frame's measurements."""

    def __init__(self, model: ObservationModel) -> None:
        self.model = model

    def observe(self, frame: Frame, belief: Belief) -> list[Observations]:
        return [Observations(frame.z, frame.cov, self.model, ids=frame.ids)]


class World:
    """True landmarks and the robot's drive; the same seed gives the same frames to every contestant.

    Args:
        space: SE2 or SE3.
        k: landmarks observed per step;  m: landmarks of the map.
        dwell: number of steps after which a landmark leaves the view and another one enters.
    """

    def __init__(self, space: SE2Group | SE3Group, k: int, m: int, dwell: int = 1, seed: int = 0) -> None:
        self.space, self.k, self.m, self.dwell = space, k, m, dwell
        self.sight = RangeBearing(space)
        self.rng = np.random.default_rng(seed)
        dim = self.sight.dim
        direction = self.rng.normal(size=(m, dim))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        self.landmarks = direction * self.rng.uniform(*RING, (m, 1))
        self.guesses = self.landmarks + STD_LANDMARK * self.rng.normal(size=(m, dim))
        forward = np.zeros(space.dim)
        forward[0 if space is SE2 else 2] = STRIDE / CIRCLE
        forward[1 if space is SE2 else 3] = STRIDE
        self.stride = space.exp(forward)
        self.cov_z = np.repeat(np.diag(STD_Z[:dim] ** 2)[None], k, axis=0)

    def start(self) -> np.ndarray:
        """The robot's first pose (E,)."""
        pose = self.space.identity()
        pose[-2 if self.space is SE2 else -3] = 0.0
        pose[-1 if self.space is SE2 else -2] = -CIRCLE
        return pose

    def frames(self) -> Iterator[Frame]:
        """Frames without end."""
        pose, t, dim = self.start(), 0, self.sight.dim
        cov = STD_MOTION**2 * np.eye(self.space.dim)
        while True:
            pose = self.space.compose(pose, self.stride)
            delta = self.space.retract(self.stride, STD_MOTION * self.rng.normal(size=self.space.dim))
            ids = (np.arange(self.k) + t // self.dwell) % self.m
            z = self.sight.predict(pose, self.landmarks[ids])
            z = z + STD_Z[:dim] * self.rng.normal(size=z.shape)
            yield Frame(ids, z, self.cov_z, Odometry(delta, cov))
            t += 1


class Run:
    """A filter on a world, stepped frame by frame; the frames are simulated beforehand.

    Args:
        world: its world, which only this run consumes.
        n: number of particles.
        steps: number of steps.
        model: of the observations; by default the built-in one.
        compiled: use the fused kernels.
    """

    def __init__(
        self, world: World, n: int, steps: int, model: ObservationModel | None = None, compiled: bool = True
    ) -> None:
        self.filter = Filter(
            OdometryMotion(world.space),
            KnownLandmarks(model or world.sight),
            LandmarkMap(world.space, compiled=compiled),
            EkfProposal(exact=True),
            EssTriggered(Systematic(), 0.5),
            n,
            np.random.default_rng(0),
            start=world.start(),
        )
        grow_map(self.filter, world.guesses, np.random.default_rng(1))
        self.frames = list(islice(world.frames(), steps))[::-1]
        self.diversity = Diversity(self.filter)

    def step(self) -> None:
        """Processes the next frame."""
        frame = self.frames.pop()
        self.diversity.after(self.filter.step(frame, frame.control).resampled)


def grow_map(filter_: Filter, points: np.ndarray, rng: np.random.Generator) -> None:
    """Adds landmarks (M, D), a hundred per generation, so that their ages and sharing match a grown map.

    Few particles then resample `SETTLING` N times more, like a robot that has left these landmarks behind; many do
    not, as none of their figures depends on it.
    """
    n, dim = filter_.n, points.shape[1]
    landmark_map = filter_.belief().map
    for first in range(0, points.shape[0], BORN_TOGETHER):
        chunk = points[first : first + BORN_TOGETHER]
        mean = np.broadcast_to(chunk, (n, *chunk.shape))
        cov = np.broadcast_to(STD_LANDMARK**2 * np.eye(dim), (n, chunk.shape[0], dim, dim))
        landmark_map.add_records(Records(mean, cov), Point(dim))
        if first + BORN_TOGETHER < points.shape[0]:
            shuffle(filter_, rng)
    for _ in range(SETTLING * n if n < MANY else 0):
        shuffle(filter_, rng)


def shuffle(filter_: Filter, rng: np.random.Generator) -> None:
    """A resampling by exponential weights, whose effective sample size is N/2."""
    weights = rng.exponential(size=filter_.n)
    ancestors = Systematic().ancestors(weights / weights.sum(), rng)
    filter_.lineage.advance(ancestors)
    filter_.marginals.resample(ancestors)


def planar(k: int, m: int, dwell: int = 1) -> World:
    """A world in the plane."""
    return World(SE2, k, m, dwell)


def spatial(k: int, m: int, dwell: int = 1) -> World:
    """A world in space."""
    return World(SE3, k, m, dwell)
