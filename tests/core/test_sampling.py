"""Motion that is drawn and has no Gaussian: modes, heavy tails, and weights from any log-likelihood, against exact answers."""

import zlib
from itertools import pairwise, product

import numpy as np
import pytest

from rbpf.conformance import check_model
from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import LikelihoodSensor, MotionModel, Observations, Part, Transition
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.smoothing import backward_simulation
from rbpf.errors import InputError
from rbpf.lie import SE2, Euclidean, Finite, Product
from tests.core.scripted import Scripted, fails, says
from tests.exactness.models import Curved, LinearObservation, assert_unbiased

STAY = np.array([[0.9, 0.1], [0.2, 0.8]])
DRIFT, NOISE = np.array([0.2, -1.0]), np.array([0.2, 0.6])
Z = np.array([0.3, -0.2, -1.4, -2.0, -1.7])
STD = 0.3
MODES, WITH_STATE = Finite(2), Product(Euclidean(1), Finite(2))


class Jumps(MotionModel):
    """A mode that jumps, and moves a marginalised number: s' = s + drift(mode) + noise(mode)."""

    space = MODES

    def sample(self, state, control, dt, rng):
        return state if dt == 0 else (rng.random(state.shape) > STAY[state[:, 0].astype(int), 0][:, None]).astype(float)

    def transition(self, state, control, dt):
        mode = state[:, 0].astype(int)
        factor = (dt * NOISE[mode])[:, None, None]
        return Transition(state, factor, np.zeros((1, 0, 1)), np.eye(1)[None], (dt * DRIFT[mode])[:, None])


class JumpsSampled(MotionModel):
    """The same with the number in the state: it is refined by what is measured."""

    space = WITH_STATE

    def sample(self, state, control, dt, rng):
        return np.concatenate([state[:, :1], Jumps().sample(state[:, 1:], control, dt, rng)], axis=1)

    def transition(self, state, control, dt):
        mode = state[:, 1].astype(int)
        mean = state + dt * np.stack([DRIFT[mode], 0.0 * mode], axis=1)
        return Transition(mean, (dt * NOISE[mode])[:, None, None])


class Drawn(JumpsSampled):
    """The same, drawn as a whole."""

    transition = MotionModel.transition

    def sample(self, state, control, dt, rng):
        state = super().sample(state, control, dt, rng)
        mode = state[:, 1].astype(int)
        state[:, 0] += dt * (DRIFT[mode] + NOISE[mode] * rng.standard_normal(len(state)))
        return state


class Weights(LikelihoodSensor):
    def log_likelihood(self, frame, state):
        return -0.5 * np.square((frame - state[:, 0]) / STD) - np.log(STD * np.sqrt(2 * np.pi))


def enumerated() -> float:
    """Log-evidence by all sequences of modes; given one, the measurements are Gaussian."""
    total, t = -np.inf, len(Z)
    for modes in product((0, 1), repeat=t):
        chance = np.log(0.5)
        chance += sum(np.log(STAY[a, b]) for a, b in pairwise(modes))
        mean = np.cumsum([0.0, *DRIFT[list(modes[1:])]])
        walk = np.cumsum([1.0, *np.square(NOISE[list(modes[1:])])])
        cov = walk[np.minimum.outer(np.arange(t), np.arange(t))] + STD**2 * np.eye(t)
        nu = Z - mean
        total = np.logaddexp(
            total, chance - 0.5 * (nu @ np.linalg.solve(cov, nu) + np.linalg.slogdet(2 * np.pi * cov)[1])
        )
    return float(total)


N = 60


def marginal(rng, proposal=None):
    start = rng.integers(0, 2, (N, 1)).astype(float)
    substate = KalmanSubstate(MODES, np.zeros(1), np.eye(1))
    return Filter(Jumps(), Scripted(), substate, proposal, n=N, rng=rng, start=start)


def sampled(motion, sensor, rng, proposal=None, n=4 * N):
    start = np.stack([rng.standard_normal(n), rng.integers(0, 2, n)], axis=1)
    return Filter(motion, sensor, (), proposal, n=n, rng=rng, start=start)


READ = LinearObservation(by_substate=np.eye(1))
NUMBER = Curved(lambda state: state[..., :1])


def group(model, z):
    return [Observations(np.array([[z]]), np.array([[[STD**2]]]), model)]


OF_SUBSTATE, OF_STATE = ([group(model, z) for z in Z] for model in (READ, NUMBER))
CASES = {
    "marginal": lambda rng: [marginal(rng), OF_SUBSTATE],
    "marginal, prior": lambda rng: [marginal(rng, PriorProposal()), OF_SUBSTATE],
    "refined": lambda rng: [sampled(JumpsSampled(), Scripted(), rng), OF_STATE],
    "drawn": lambda rng: [sampled(Drawn(), Scripted(), rng), OF_STATE],
    "drawn, prior": lambda rng: [sampled(Drawn(), Scripted(), rng, PriorProposal()), OF_STATE],
    "weighed": lambda rng: [sampled(Drawn(), Weights(), rng), list(Z)],
    "weighed, refined": lambda rng: [sampled(JumpsSampled(), Weights(), rng), list(Z)],
    "weighed, w1 alone": lambda rng: [sampled(Drawn(), Weights(), rng, EkfProposal(exact=False)), list(Z)],
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_evidence_is_unbiased(case):
    exact, logs = enumerated(), []
    for seed in range(150):
        filter_, frames = CASES[case](np.random.default_rng([zlib.crc32(case.encode()), seed]))
        for frame in frames:
            filter_.step(frame)
        logs.append(filter_.log_evidence - exact)
    assert_unbiased(np.array(logs))
    assert np.std(logs) < 0.5


def test_the_estimate_of_a_mode_is_the_most_probable_one(rng):
    states = np.stack([np.arange(6.0), [2, 0, 0, 1, 1, 0]], axis=1)
    weights = np.array([0.35, 0.05, 0.1, 0.2, 0.21, 0.09])
    mean = Product(Euclidean(1), Finite(3)).mean(states, weights)
    assert mean[1] == 1.0 and mean[0] == pytest.approx(weights @ states[:, 0])
    np.testing.assert_allclose(Finite(3).probabilities(states[:, 1:], weights), [0.24, 0.41, 0.35])
    filter_ = marginal(rng)
    assert filter_.step(group(READ, 0.1)).estimate.mean[0] in (0.0, 1.0)


def test_looking_ahead_draws_what_the_step_will(rng):
    one = sampled(Drawn(), Weights(), rng)
    one.step(Z[0])
    state = one.expect().state
    assert np.array_equal(state, one.expect().state)
    before = one.lineage.generation
    one.step(Z[0])
    if one.lineage.generation == before:
        assert np.array_equal(one.particles.state, state)


def test_a_failing_step_leaves_the_generator(rng):
    fails(sampled(Drawn(), Weights(), rng), "a log-likelihood of states must be", np.zeros(240).reshape(-1, 1))


def test_what_a_sampled_motion_cannot(rng):
    with pytest.raises(InputError, match="follow needs Gaussian increments, but Drawn draws"):
        sampled(Drawn(), Weights(), rng).follow(np.zeros(2), Z[0])

    class Idle(MotionModel):
        space = SE2

    with pytest.raises(InputError, match="Idle does not move: override transition, sample, or both"):
        Filter(Idle(), Scripted())

    class Wrong(Drawn):
        def sample(self, state, control, dt, rng):
            return state[:, :1]

    fails(sampled(Wrong(), Weights(), rng), r"Wrong.sample must return \(240, 2\) finite numbers", 0.3)


def test_checks_of_what_draws():
    assert check_model(Jumps()) == [] and check_model(Drawn()) == []

    class Own(Drawn):
        rng = np.random.default_rng(0)

        def sample(self, state, control, dt, rng):
            return super().sample(state, control, dt, self.rng)

    says(check_model(Own()), "Own.sample draws from something else than the generator that it is given")


class Laplace(MotionModel):
    """Heavy tails, with their density."""

    space = Euclidean(1)

    def sample(self, state, control, dt, rng):
        return state + rng.laplace(size=state.shape)

    def log_density(self, before, after, control, dt):
        return -np.abs(after - before.T) - np.log(2.0)


def test_backward_simulation_with_a_density_and_without(rng):
    """Two states on a grid: the mean of the first one given both measurements."""
    filter_ = Filter(Laplace(), Weights(), n=3000, rng=rng, clouds=True)
    for z in (0.8, -0.5):
        filter_.step(z)
    found = backward_simulation(filter_.motion, filter_.history, 400, rng)
    grid = np.linspace(-8.0, 8.0, 801)
    first = np.exp(-np.abs(grid) - 0.5 * np.square((0.8 - grid) / STD))
    second = np.exp(-np.abs(grid[:, None] - grid) - 0.5 * np.square((-0.5 - grid) / STD)).sum(axis=1)
    expected = (grid * first * second).sum() / (first * second).sum()
    assert found.mean[0, 0] == pytest.approx(expected, abs=0.06)

    class Mute(Laplace):
        log_density = MotionModel.log_density

    with pytest.raises(InputError, match=r"needs a density of Mute\.sample: override log_density"):
        backward_simulation(Mute(), filter_.history, 4, rng)


def test_a_motion_that_is_not_linear_in_its_substate(rng):
    """The mean of the substate is given: with x' = s² it is linearised there."""
    seen = []

    class Square(MotionModel):
        space = Euclidean(1)

        def transition_given(self, state, substate, control, dt):
            seen.append(substate.copy())
            offset = state - substate**2
            return Transition(
                offset, np.array([[[0.1], [0.0]]]), 2 * substate[:, :, None], np.eye(1)[None], np.zeros((1, 1))
            )

        def transition(self, state, control, dt):
            raise AssertionError

    filter_ = Filter(
        Square(), Scripted(), KalmanSubstate(Euclidean(1), np.array([3.0]), 1e-4 * np.eye(1)), n=5, rng=rng
    )
    filter_.step([])
    assert np.array_equal(seen[0], np.full((5, 1), 3.0))
    assert filter_.particles.state.mean() == pytest.approx(9.0, abs=0.5)
    assert Part.SUBSTATE in filter_.marginals.parts
