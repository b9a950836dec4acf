"""The exact ratio keeps the evidence of nonlinear sampled models unbiased; the linearised weight does not."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.likelihoods import GaussianWithOutliers
from rbpf.core.models import Likelihood, MotionModel, ObservationModel, Part, Proposal, Transition
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.lie import Euclidean
from tests.exactness.models import Frame, Scripted, assert_unbiased, deviation, log_ratios, single

pytestmark = pytest.mark.slow

Function = Callable[[np.ndarray], np.ndarray]
PROPOSALS = [PriorProposal(), EkfProposal(), EkfProposal(iterations=3)]


class Moving(MotionModel):
    """x' = f(x) + w on the line."""

    def __init__(self, f: Function, std: float):
        self.f, self.std = f, std
        self.space = Euclidean(1)

    def transition(self, state, control, dt):
        return Transition(self.f(state), np.full((1, 1, 1), self.std))


class Curved(ObservationModel):
    """z = h(x) + v."""

    dim = 1
    reads = frozenset({Part.STATE})

    def __init__(self, h: Function):
        self.h = h

    def predict(self, state, landmark=None, const=None, substate=None):
        return self.h(state)


@dataclass(frozen=True)
class Scalar:
    """A model on the line, five measurements drawn from it, and their log-evidence on a grid."""

    f: Function
    std: float
    h: Function
    variance: float
    start: float
    likelihood: Likelihood | None = None

    def measurements(self, seed: int, outlier: float = 0.0) -> np.ndarray:
        rng = np.random.default_rng(seed)
        x, z = np.array(self.start), []
        for step in range(5):
            x = self.f(x) + self.std * rng.normal()
            z.append(self.h(x) + np.sqrt(self.variance) * rng.normal() + outlier * (step == 2))
        return np.array(z)

    def log_evidence(self, zs: np.ndarray, points: int = 3001) -> float:
        x, dx = np.linspace(-15.0, 15.0, points, retstep=True)
        forward = _normal(x - self.f(x)[:, None], self.std**2) * dx
        density, total = _normal(x - self.f(np.array(self.start)), self.std**2), 0.0
        for step, z in enumerate(zs):
            density = density @ forward if step else density
            density = density * self._density(z - self.h(x))
            mass = density.sum() * dx
            density, total = density / mass, total + float(np.log(mass))
        return total

    def log_ratios(self, zs: np.ndarray, proposal: Proposal, stream: int, seeds: int) -> np.ndarray:
        model, cov = Curved(self.h), np.array([[self.variance]])
        frames = [Frame([single(z, cov, model, likelihood=self.likelihood)]) for z in zs]

        def build(rng: np.random.Generator) -> Filter:
            trigger, start = EssTriggered(Systematic()), np.array([self.start])
            return Filter(Moving(self.f, self.std), Scripted(), (), proposal, trigger, 100, rng, start)

        return log_ratios(build, frames, self.log_evidence(zs), stream, seeds)

    def _density(self, nu: np.ndarray) -> np.ndarray:
        inlier = _normal(nu, self.variance)
        if self.likelihood is None:
            return inlier
        log_inlier, log_outlier = self.likelihood.params
        return np.exp(log_inlier) * inlier + np.exp(log_outlier)


def _normal(x: np.ndarray, variance: float) -> np.ndarray:
    return np.exp(-0.5 * x * x / variance) / np.sqrt(2.0 * np.pi * variance)


WORLDS = {
    "square": Scalar(lambda x: 0.8 * x + 1.5 * np.sin(x) + 0.3, 0.8, lambda x: x * x / 5.0, 0.5, 1.0),
    "arctan": Scalar(lambda x: 0.9 * x + 0.3 * np.cos(x), 0.8, lambda x: 2.0 * np.arctan(x), 1.5, 0.5),
}
every_world = pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)


@every_world
def test_the_grid_is_fine_enough(world):
    zs = world.measurements(2)
    assert world.log_evidence(zs) == pytest.approx(world.log_evidence(zs, 1001), abs=1e-9)


@pytest.mark.parametrize(("name", "proposal"), [("arctan", 0), ("square", 1), ("arctan", 1), ("square", 2)])
def test_evidence_is_unbiased(name, proposal, stream):
    world, proposal = WORLDS[name], PROPOSALS[proposal]
    assert_unbiased(world.log_ratios(world.measurements(2), proposal, stream, 300))


@pytest.mark.parametrize(("name", "iterations"), [("square", 1), ("arctan", 3)])
def test_the_linearised_weight_is_biased(name, iterations, stream):
    """E06's w₂ := 1 fails the same test by far."""
    world = WORLDS[name]
    proposal = EkfProposal(exact=False, iterations=iterations)
    log_ratio = world.log_ratios(world.measurements(2), proposal, stream, 200)
    assert log_ratio.std() <= 0.5
    assert deviation(np.exp(log_ratio), 1.0) > 5.0 + 10.0 * (iterations == 1)


@pytest.mark.parametrize("proposal", PROPOSALS[:2], ids=["prior", "ekf"])
def test_evidence_with_outliers_is_unbiased(proposal, stream):
    """The gate decides who moves the proposal, the density of both decides the weight."""
    world = Scalar(lambda x: 0.9 * x, 0.6, lambda x: x, 0.6, 0.5, GaussianWithOutliers(0.1, 20.0))
    zs = world.measurements(4, outlier=5.0)
    assert_unbiased(world.log_ratios(zs, proposal, stream, 300))
