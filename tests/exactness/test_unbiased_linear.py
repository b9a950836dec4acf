"""The evidence of partly sampled linear models is unbiased, whatever the proposal, resampler and trigger."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import Conditional, Resampler
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Multinomial, Residual, Stratified, Systematic
from tests.exactness.models import (
    SEEDS,
    Frame,
    Kalman,
    LinearMotion,
    LinearObservation,
    Scripted,
    assert_unbiased,
    log_ratios,
    single,
)

pytestmark = pytest.mark.slow

PROPOSALS = {"prior": PriorProposal(), "ekf": EkfProposal(), "iterated": EkfProposal(iterations=3)}
RESAMPLERS = {
    "systematic": Systematic(),
    "stratified": Stratified(),
    "residual": Residual(),
    "multinomial": Multinomial(),
}
TRIGGERS: dict[str, Callable[[Resampler], Resampler]] = {
    "always": lambda scheme: scheme,
    "triggered": lambda scheme: EssTriggered(scheme, 0.5),
    "never": lambda scheme: EssTriggered(scheme, 0.0),
}
SCHEDULES = [(t, r) for t in TRIGGERS for r in RESAMPLERS if t != "never" or r == "systematic"]
every_schedule = pytest.mark.parametrize(("trigger", "scheme"), SCHEDULES)
some_schedules = pytest.mark.parametrize(
    ("trigger", "scheme"), [("always", "stratified"), ("triggered", "residual"), ("never", "systematic")]
)


@dataclass(frozen=True)
class World:
    """A linear-Gaussian model with measurements drawn from it, and their exact log-evidence."""

    motion: LinearMotion
    frames: list[Frame]
    marginalised: Callable[[], list[Conditional]]
    log_evidence: float

    def build(self, proposal: str, trigger: str, scheme: str, rng: np.random.Generator) -> Filter:
        resampler = TRIGGERS[trigger](RESAMPLERS[scheme])
        return Filter(self.motion, Scripted(), self.marginalised(), PROPOSALS[proposal], resampler, 80, rng)

    def log_ratios(self, proposal: str, trigger: str, scheme: str, stream: int, seeds: int = SEEDS) -> np.ndarray:
        build = partial(self.build, proposal, trigger, scheme)
        return log_ratios(build, self.frames, self.log_evidence, stream, seeds)


def simulate(
    motion: LinearMotion, model: LinearObservation, R: np.ndarray, kalman: Kalman, steps: int, seed: int
) -> list[Frame]:
    """Measurements of a draw from the model, told to a Kalman filter of the full state as well."""
    rng = np.random.default_rng(seed)
    F, Q, drift = motion.joint()
    H = model.joint_matrix(motion)
    truth = rng.multivariate_normal(kalman.mean, kalman.cov)
    frames = []
    for _ in range(steps):
        truth = F @ truth + drift + rng.multivariate_normal(np.zeros(len(truth)), Q)
        z = H @ truth + rng.multivariate_normal(np.zeros(len(R)), R)
        kalman.predict(F, Q, drift)
        kalman.update(z, H, R)
        frames.append(Frame([single(z, R, model)]))
    return frames


@pytest.fixture(scope="module")
def position_alone() -> World:
    """A sampled position and velocity; the position is measured."""
    motion = LinearMotion(np.array([[1.0, 1.0], [0.0, 1.0]]), np.diag([0.2, 0.8]))
    kalman = Kalman(np.zeros(2), np.zeros((2, 2)))
    frames = simulate(motion, LinearObservation([[1.0, 0.0]]), np.array([[0.25]]), kalman, steps=4, seed=2)
    return World(motion, frames, list, kalman.log_evidence)


@pytest.fixture(scope="module")
def driven_by_acceleration() -> World:
    """The same with a marginalised acceleration whose noise is correlated; it is measured too."""
    factor = np.array([[0.2, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.1, 0.2]])
    F, B, A = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]]), np.array([[0.9]])
    motion = LinearMotion(F, factor, B, A, np.array([0.1]))
    model = LinearObservation([[1.0, 0.0], [0.0, 0.0]], [[0.0], [0.5]])
    law = np.array([0.2]), np.array([[0.16]])
    kalman = Kalman(np.array([0.0, 0.0, 0.2]), np.diag([0.0, 0.0, 0.16]))
    frames = simulate(motion, model, np.diag([0.4, 0.4]), kalman, steps=4, seed=1)
    return World(motion, frames, lambda: [KalmanSubstate(motion.space, *law)], kalman.log_evidence)


@every_schedule
@pytest.mark.parametrize("proposal", ["prior", "ekf"])
def test_state_only_evidence_is_unbiased(position_alone, proposal, trigger, scheme, stream):
    assert_unbiased(position_alone.log_ratios(proposal, trigger, scheme, stream))


@some_schedules
@pytest.mark.parametrize("proposal", ["prior", "ekf"])
def test_evidence_with_a_kalman_substate_is_unbiased(driven_by_acceleration, proposal, trigger, scheme, stream):
    assert_unbiased(driven_by_acceleration.log_ratios(proposal, trigger, scheme, stream))


@some_schedules
def test_evidence_is_unbiased_under_iteration(position_alone, driven_by_acceleration, trigger, scheme, stream):
    world = driven_by_acceleration if trigger == "triggered" else position_alone
    assert_unbiased(world.log_ratios("iterated", trigger, scheme, stream))


@every_schedule
def test_in_a_linear_model_iterating_changes_nothing(position_alone, driven_by_acceleration, trigger, scheme, stream):
    for world in (position_alone, driven_by_acceleration):
        once, often = (world.log_ratios(proposal, trigger, scheme, stream, 4) for proposal in ("ekf", "iterated"))
        np.testing.assert_allclose(often, once, atol=1e-9)


@pytest.mark.parametrize("proposal", ["prior", "ekf"])
def test_the_trigger_resamples_now_and_then(position_alone, driven_by_acceleration, proposal):
    """Else the tests above would not tell it from always or never."""
    for world in (position_alone, driven_by_acceleration):
        filters = [world.build(proposal, "triggered", "systematic", np.random.default_rng(seed)) for seed in range(20)]
        reports = [[filter_.step(frame).resampled for frame in world.frames] for filter_ in filters]
        assert 0.1 < np.mean(reports) < 0.9


def test_the_refined_proposal_spreads_less_than_the_prior(driven_by_acceleration):
    """Both are unbiased; what the refinement buys is the spread."""
    prior, refined = (
        driven_by_acceleration.log_ratios(name, "always", "systematic", 0, 100) for name in ("prior", "ekf")
    )
    assert refined.std() < 0.8 * prior.std()


def test_in_a_linear_model_the_linearised_weight_is_the_exact_one(driven_by_acceleration):
    """The correction w₂ is one there: E06's weight and the exact ratio give the same numbers."""
    runs = []
    for exact in (True, False):
        filter_ = driven_by_acceleration.build("ekf", "always", "systematic", np.random.default_rng(5))
        filter_.proposal = EkfProposal(exact)
        runs.append([filter_.step(frame).log_evidence for frame in driven_by_acceleration.frames])
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-9)


def test_weights_that_were_not_reset_stay_in_the_next_step(position_alone):
    """Never resampled, the bootstrap filter's evidence is the mean of each path's whole likelihood."""
    filter_ = position_alone.build("prior", "never", "systematic", np.random.default_rng(6))
    log_likelihood = np.zeros(filter_.n)
    for frame in position_alone.frames:
        filter_.step(frame)
        nu = frame.groups[0].z[0, 0] - filter_.particles.state[:, 0]
        log_likelihood -= 0.5 * (nu**2 / 0.25 + np.log(2 * np.pi * 0.25))
    assert filter_.log_evidence == pytest.approx(np.log(np.exp(log_likelihood).mean()), abs=1e-12)
    np.testing.assert_allclose(
        filter_.particles.weights, np.exp(log_likelihood) / np.exp(log_likelihood).sum(), rtol=1e-9
    )
