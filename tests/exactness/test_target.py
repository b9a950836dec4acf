"""A target without a map: heading and position sampled, the speed marginalised, against sampling it too."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import MotionModel, ObservationModel, Part, Transition
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import Systematic
from rbpf.lie import Euclidean
from tests.exactness.models import Frame, Scripted, assert_unbiased, deviation, log_ratios, single

pytestmark = pytest.mark.slow

PARTICLES = 100
STEPS = 4
TURN, JITTER = 0.25, 0.15
"""Standard deviations per step of the heading [rad] and of the position [m]."""
DECAY, GUST = 0.9, 0.5
"""Of the speed: s' = 0.9 s + 0.1 + w."""
SPEED = np.array([1.0]), np.array([[0.4]])
R_POSITION, R_SPEED = 0.15 * np.eye(2), np.array([[0.1]])


class Target(MotionModel):
    """(θ, x, y): the heading wanders, the position moves by the speed along it; the speed is the substate."""

    space = Euclidean(3)

    def transition(self, state, control, dt):
        theta = state[:, 0]
        along = np.stack([np.zeros_like(theta), np.cos(theta), np.sin(theta)], axis=-1)[..., None]
        factor = np.diag([TURN, JITTER, JITTER, GUST])
        return Transition(state, factor[None], along, np.full((1, 1, 1), DECAY), np.full((1, 1), 0.1))


class SampledTarget(MotionModel):
    """(θ, x, y, s), all sampled."""

    space = Euclidean(4)

    def transition(self, state, control, dt):
        theta, x, y, s = state.T
        moved = np.stack([theta, x + s * np.cos(theta), y + s * np.sin(theta), DECAY * s + 0.1], axis=-1)
        return Transition(moved, np.diag([TURN, JITTER, JITTER, GUST])[None])


class Position(ObservationModel):
    dim = 2
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state[..., 1:3]


class Speed(ObservationModel):
    """Of the substate, or of the fourth coordinate where it is sampled."""

    dim = 1

    def __init__(self, part: Part):
        self.reads = frozenset({part})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state[..., 3:] if substate is None else substate


def measurements() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(71)
    theta, position, speed, out = 0.0, np.zeros(2), rng.normal(SPEED[0], np.sqrt(SPEED[1][0]))[0], []
    for _ in range(STEPS):
        position = position + speed * np.array([np.cos(theta), np.sin(theta)]) + JITTER * rng.normal(size=2)
        theta, speed = theta + TURN * rng.normal(), DECAY * speed + 0.1 + GUST * rng.normal()
        z = position + rng.multivariate_normal(np.zeros(2), R_POSITION)
        out.append((z, np.array([speed + np.sqrt(R_SPEED[0, 0]) * rng.normal()])))
    positions, speeds = zip(*out, strict=True)
    return np.array(positions), np.array(speeds)


def frames(part: Part) -> list[Frame]:
    return [
        Frame([single(z, R_POSITION, Position()), single(s, R_SPEED, Speed(part))])
        for z, s in zip(*measurements(), strict=True)
    ]


def marginalised(proposal, rng) -> Filter:
    substate = KalmanSubstate(Target.space, *SPEED)
    return Filter(Target(), Scripted(), substate, proposal, Systematic(), PARTICLES, rng)


def sampled(proposal, rng) -> Filter:
    start = np.zeros((PARTICLES, 4))
    start[:, 3] = rng.normal(SPEED[0], np.sqrt(SPEED[1][0]), PARTICLES)
    return Filter(SampledTarget(), Scripted(), (), proposal, Systematic(), PARTICLES, rng, start)


@pytest.fixture(scope="module")
def exact() -> float:
    """Log-evidence of a plain particle filter of many particles, sharing no code with the package."""
    rng, n = np.random.default_rng(72), 400_000
    theta, position, total = np.zeros(n), np.zeros((n, 2)), 0.0
    speed = rng.normal(SPEED[0], np.sqrt(SPEED[1][0]), n)
    for z, s in zip(*measurements(), strict=True):
        position = position + speed[:, None] * np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        position += JITTER * rng.normal(size=(n, 2))
        theta, speed = theta + TURN * rng.normal(size=n), DECAY * speed + 0.1 + GUST * rng.normal(size=n)
        squared = ((z - position) ** 2).sum(axis=1) / 0.15 + (s - speed) ** 2 / 0.1
        weights = np.exp(-0.5 * squared) / (2 * np.pi * 0.15 * np.sqrt(2 * np.pi * 0.1))
        total += float(np.log(weights.mean()))
        chosen = np.searchsorted(np.cumsum(weights) / weights.sum(), (np.arange(n) + rng.random()) / n).clip(max=n - 1)
        theta, position, speed = theta[chosen], position[chosen], speed[chosen]
    return total


@pytest.fixture(scope="module")
def runs(exact) -> dict[str, np.ndarray]:
    """Log-evidence over the exact one; the last also refines its proposal."""
    return {
        "sampled": log_ratios(lambda rng: sampled(PriorProposal(), rng), frames(Part.STATE), exact, 1, 300),
        "marginalised": log_ratios(lambda rng: marginalised(PriorProposal(), rng), frames(Part.SUBSTATE), exact, 2),
        "refined": log_ratios(lambda rng: marginalised(EkfProposal(), rng), frames(Part.SUBSTATE), exact, 3, 300),
    }


def test_all_are_unbiased(runs):
    assert deviation(np.exp(runs["sampled"]), 1.0) <= 3.0
    assert_unbiased(runs["marginalised"])
    assert_unbiased(runs["refined"])


def test_marginalising_lowers_the_variance_of_the_evidence(runs):
    """With the same number of particles."""
    assert np.exp(runs["marginalised"]).var() < 0.6 * np.exp(runs["sampled"]).var()
    assert runs["marginalised"].std() < 0.7 * runs["sampled"].std()


def test_a_proposal_that_looks_at_the_measurements_lowers_it_further(runs):
    assert runs["refined"].std() < 0.7 * runs["marginalised"].std()
