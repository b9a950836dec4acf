"""Small simulated worlds, and filters for them."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rbpf.core.filter import Filter, StepReport
from rbpf.core.likelihoods import ExistenceModel, Gates
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.landmark_sensor import AnonymousLandmarkSensor, NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing

STD_ODOMETRY = np.array([0.01, 0.03, 0.01])
STD_Z = np.array([0.05, 0.01])
MAX_RANGE = 7.0
STEP_NS = 100_000_000


@dataclass(frozen=True)
class World:
    """A recording: one control and one frame per step, where clutter has the name −1; the true poses and landmarks."""

    controls: list[Odometry | None]
    frames: list[FeatureFrame]
    truth: np.ndarray
    landmarks: np.ndarray


def planar_world(steps: int, landmarks: int = 12, seed: int = 0, clutter: float = 0.0) -> World:
    """A robot on a circle of 4 m radius; `clutter` is the mean number of false sightings in a frame."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-7.0, -3.0], [7.0, 11.0], size=(landmarks, 2))
    delta = SE2.exp(np.array([0.1, 0.4, 0.0]))
    pose, poses = SE2.identity(), []
    controls: list[Odometry | None] = []
    frames = []
    for t in range(steps):
        if t:
            pose = SE2.compose(pose, SE2.retract(delta, STD_ODOMETRY * rng.normal(size=3)))
        controls.append(Odometry(delta, np.diag(STD_ODOMETRY**2)) if t else None)
        frames.append(_sightings(pose, points, clutter, rng))
        poses.append(pose)
    return World(controls, frames, np.array(poses), points)


def _sightings(pose: np.ndarray, points: np.ndarray, clutter: float, rng: np.random.Generator) -> FeatureFrame:
    z = RangeBearing(SE2).predict(pose, points)
    names = np.flatnonzero(z[:, 0] < MAX_RANGE)
    z = z[names] + STD_Z * rng.normal(size=(names.size, 2))
    false = rng.uniform([0.5, -np.pi], [MAX_RANGE, np.pi], size=(rng.poisson(clutter), 2))
    order = rng.permutation(names.size + false.shape[0])
    names = np.concatenate([names, np.full(false.shape[0], -1)])[order]
    z = np.concatenate([z, false])[order]
    return FeatureFrame(0, names, z, np.repeat(np.diag(STD_Z**2)[None], names.size, axis=0))


@dataclass(frozen=True)
class Recipe:
    """Builds equal filters."""

    n: int = 40
    seed: int = 1
    known: bool = True
    compiled: bool = True
    options: dict[str, object] = field(default_factory=dict)

    def build(self) -> Filter:
        """A fresh filter."""
        landmark_map = LandmarkMap(SE2, evidence=not self.known, compiled=self.compiled)
        landmark_map.register(Point(2))
        model = RangeBearing(SE2, max_range=MAX_RANGE - 0.5)
        sensor = NamedLandmarkSensor(model, Point(2)) if self.known else anonymous(model)
        rng = np.random.default_rng(self.seed)
        return Filter(OdometryMotion(SE2), sensor, landmark_map, n=self.n, rng=rng, **self.options)  # type: ignore[arg-type]


def anonymous(model: RangeBearing) -> AnonymousLandmarkSensor:
    """Gates at 99.9 % and far beyond; clutter and first sightings are uniform over the field of view."""
    uniform = -float(np.log(MAX_RANGE * 2 * np.pi))
    gates = Gates(accept=13.8, isolate=30.0, log_new=uniform, log_clutter=uniform - 1.0)
    return AnonymousLandmarkSensor(model, Point(2), gates, ExistenceModel())


def drive(
    filter_: Filter,
    world: World,
    start: int = 0,
    stop: int | None = None,
    after: Callable[[int, StepReport], None] | None = None,
) -> list[StepReport]:
    """Steps a filter through a part of a recording."""
    reports = []
    for t in range(start, len(world.frames) if stop is None else stop):
        reports.append(filter_.step(world.frames[t], world.controls[t], t * STEP_NS))
        if after is not None:
            after(t, reports[-1])
    return reports


def content(filter_: Filter) -> dict[str, np.ndarray]:
    """A copy of everything that a filter holds, but its random generator."""
    arrays = {
        "state": filter_.particles.state,
        "log_weights": filter_.particles.log_weights,
        "log_evidence": np.array(filter_.log_evidence),
        "clock": np.array([filter_.steps, -1 if filter_.stamp_ns is None else filter_.stamp_ns]),
        **filter_.lineage.arrays(),
        **filter_.history.arrays(),
        **filter_.marginals.arrays(),
    }
    return {name: array.copy() for name, array in arrays.items()}


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    """Whether two contents are the same bytes."""
    return a.keys() == b.keys() and all(
        (a[name].dtype, a[name].shape, a[name].tobytes()) == (b[name].dtype, b[name].shape, b[name].tobytes())
        for name in a
    )
