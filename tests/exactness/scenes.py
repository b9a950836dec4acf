"""Random particles with a map of landmarks each, seen by mounted sensors."""

from dataclasses import dataclass

import numpy as np

from rbpf.core.genealogy import Lineage
from rbpf.core.models import ObservationModel, Observations, Records
from rbpf.core.particles import Prior
from rbpf.lie import SE2, SE2Group, SE3Group
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition


def random_covs(rng: np.random.Generator, shape: tuple[int, ...], n: int, scale: float) -> np.ndarray:
    half = rng.normal(scale=scale, size=(*shape, n, n + 1))
    return half @ np.swapaxes(half, -1, -2) + 0.1 * scale**2 * np.eye(n)


def sensors(space: SE2Group | SE3Group, rng: np.random.Generator) -> list[RangeBearing | RelativePosition]:
    """Range-bearing and position, each with a mounting of its own; in space, one pitch points down."""
    mountings = space.exp(rng.normal(scale=0.7, size=(2, space.dim)))
    return [RangeBearing(space, mountings[0], pitch_sign=-1.0), RelativePosition(space, mountings[1])]


@dataclass(frozen=True)
class Scene:
    """N particles near one another, and what each believes of K landmarks."""

    space: SE2Group | SE3Group
    state: np.ndarray
    records: Records
    rng: np.random.Generator

    @classmethod
    def random(cls, space: SE2Group | SE3Group, rng: np.random.Generator, n: int = 6, k: int = 4) -> "Scene":
        dim = 2 if space is SE2 else 3
        state = space.retract(space.exp(rng.normal(size=space.dim)), rng.normal(scale=0.1, size=(n, space.dim)))
        landmarks = rng.normal(scale=5.0, size=(k, dim)) + 3.0
        mean = landmarks + rng.normal(scale=0.2, size=(n, k, dim))
        return cls(space, state, Records(mean, random_covs(rng, (n, k), dim, 0.2)), rng)

    @property
    def n(self) -> int:
        return self.state.shape[0]

    def map(self, compiled: bool = True, evidence: bool = False) -> LandmarkMap:
        held = LandmarkMap(self.space, evidence, compiled)
        held.begin(self.n, Lineage(self.n))
        held.add_records(self.records, Point(self.records.mean.shape[-1]))
        return held

    def observe(self, model: ObservationModel, ids: np.ndarray, noise: float = 0.1, **options) -> Observations:
        """Measurements of landmarks (K,) or (N, K) as the first particle believes them, with noise."""
        rows = ids if ids.ndim == 1 else np.abs(ids).max(axis=0)
        z = model.predict(self.state[0], self.records.mean[0, rows])
        z = z + self.rng.normal(scale=noise, size=z.shape)
        return Observations(z, random_covs(self.rng, (len(rows),), model.dim, noise), model, ids=ids, **options)

    def prior(self, rank: int, shared: bool) -> Prior:
        """Centred at the particles, with noise of a rank that may fall short of the dimension."""
        factor = self.rng.normal(scale=0.1, size=(1 if shared else self.n, self.space.dim, rank))
        return Prior(self.space, self.state, np.zeros((1, self.space.dim)), factor)
