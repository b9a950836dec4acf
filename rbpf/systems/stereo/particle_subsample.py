"""Where the particles expect landmarks in a pair of images: of a few of them, each for an equal fraction of the weight."""

from dataclasses import dataclass, fields
from typing import final

import numpy as np

from rbpf.core.models import Belief
from rbpf.core.particles import Prior
from rbpf.gaussian import symmetrise
from rbpf.lie import SE3
from rbpf.sensors.camera.points import StereoPoint


@dataclass(frozen=True)
class Expected:
    """K landmarks in (u_left, v, u_right), px.

    Attributes:
        mean: (K, 3) of the particles.
        cov: (K, 3, 3) within and between particles, without the noise of a measurement.
        within: (K, 3, 3) of the landmark in the heaviest particle, its pose given.
        by_heaviest: (K, 3) as that particle sees them.
    """

    mean: np.ndarray
    cov: np.ndarray
    within: np.ndarray
    by_heaviest: np.ndarray

    @property
    def deviation(self) -> np.ndarray:
        """(K,) largest standard deviation along an axis."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2).max(axis=1))

    def take(self, rows: np.ndarray) -> "Expected":
        """Some of them."""
        return Expected(*(getattr(self, item.name)[rows] for item in fields(self)))


@final
@dataclass(frozen=True)
class ParticleSubsample:
    """A few particles, the heaviest one last.

    Attributes:
        rows: (n + 1,) which ones.
        prior: their law before the observations.
        middle: (7,) world_from_camera in their middle.
        doubt_rad: standard deviation of the camera's direction about that.
    """

    rows: np.ndarray
    prior: Prior
    middle: np.ndarray
    doubt_rad: float

    @classmethod
    def of(cls, belief: Belief, count: int) -> "ParticleSubsample":
        """So many at most."""
        weights = belief.weights
        steps = (np.arange(min(count, weights.size)) + 0.5) / min(count, weights.size)
        rows = np.minimum(np.searchsorted(np.cumsum(weights), steps), weights.size - 1)
        rows = np.append(rows, belief.mode)
        prior = belief.prior.take(rows)
        state = prior.predicted()
        middle = SE3.mean(state[:-1], np.full(rows.size - 1, 1.0 / (rows.size - 1)))
        turns = SE3.local(middle, state[:-1])[:, :3]
        spread = prior.spread(prior.mean)[-1, :3]
        doubt = np.square(turns).mean(axis=0) + np.square(spread).sum(axis=1)
        return cls(rows, prior, middle, float(np.sqrt(doubt.max())))

    def expected(self, belief: Belief, model: StereoPoint, ids: np.ndarray) -> Expected:
        """Landmarks (K,) of the map.

        What is uncertain within a particle, given its path, hardly differs between them: the heaviest one's is taken.
        """
        records, state = belief.read(ids, self.rows), self.prior.predicted()
        px = model.predict(state[:, None], records.mean)
        jac = model.jacobians(state[-1], records.mean[-1])
        assert jac.state is not None and jac.landmark is not None
        moved = jac.state @ self.prior.spread(self.prior.mean)[-1]
        within = symmetrise(jac.landmark @ records.cov[-1] @ jac.landmark.mT)
        mean = px[:-1].mean(axis=0)
        off = px[:-1] - mean
        between = np.einsum("nka,nkb->kab", off, off) / off.shape[0]
        return Expected(mean, symmetrise(within + moved @ moved.mT + between), within, px[-1])
