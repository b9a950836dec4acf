"""The evidence of partly sampled linear models is unbiased, whatever the proposal, resampler and trigger."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import Conditional, Resampler
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Residual, Stratified, Systematic
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
SCHEDULES: dict[str, Resampler] = {
    "always": Stratified(),
    "triggered": EssTriggered(Residual(), 0.5),
    "never": EssTriggered(Systematic(), 0.0),
}
"""That each scheme is unbiased by itself is tested in `tests/core/test_resampling.py`."""
every_schedule = pytest.mark.parametrize("schedule", SCHEDULES)


@dataclass(frozen=True)
class World:
    """A linear-Gaussian model with measurements drawn from it, and their exact log-evidence."""

    motion: LinearMotion
    frames: list[Frame]
    marginalised: Callable[[], list[Conditional]]
    log_evidence: float

    def build(self, proposal: str, schedule: str, rng: np.random.Generator) -> Filter:
        parts, resampler = self.marginalised(), SCHEDULES[schedule]
        return Filter(self.motion, Scripted(), parts, PROPOSALS[proposal], resampler, 80, rng)

    def log_ratios(self, proposal: str, schedule: str, stream: int, seeds: int = SEEDS) -> np.ndarray:
        return log_ratios(partial(self.build, proposal, schedule), self.frames, self.log_evidence, stream, seeds)


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
    return accelerated(0.4)


def accelerated(variance: float) -> World:
    """The same with a marginalised acceleration whose noise is correlated; it is measured too, with such a variance."""
    factor = np.array([[0.2, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.1, 0.2]])
    F, B, A = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]]), np.array([[0.9]])
    motion = LinearMotion(F, factor, B, A, np.array([0.1]))
    model = LinearObservation([[1.0, 0.0], [0.0, 0.0]], [[0.0], [0.5]])
    law = np.array([0.2]), np.array([[0.16]])
    kalman = Kalman(np.array([0.0, 0.0, 0.2]), np.diag([0.0, 0.0, 0.16]))
    frames = simulate(motion, model, np.diag([0.4, variance]), kalman, steps=4, seed=1)
    return World(motion, frames, lambda: [KalmanSubstate(motion.space, *law)], kalman.log_evidence)


@pytest.mark.parametrize(("proposal", "schedule"), [("prior", "always"), ("ekf", "triggered"), ("prior", "never")])
def test_state_only_evidence_is_unbiased(position_alone, proposal, schedule, stream):
    assert_unbiased(position_alone.log_ratios(proposal, schedule, stream))


@pytest.mark.parametrize(("proposal", "schedule"), [("ekf", "always"), ("prior", "triggered"), ("ekf", "never")])
def test_evidence_with_a_kalman_substate_is_unbiased(driven_by_acceleration, proposal, schedule, stream):
    assert_unbiased(driven_by_acceleration.log_ratios(proposal, schedule, stream))


@every_schedule
def test_in_a_linear_model_iterating_changes_nothing(position_alone, driven_by_acceleration, schedule, stream):
    for world in (position_alone, driven_by_acceleration):
        once, often = (world.log_ratios(proposal, schedule, stream, 4) for proposal in ("ekf", "iterated"))
        np.testing.assert_allclose(often, once, atol=1e-9)


@pytest.mark.parametrize("proposal", ["prior", "ekf"])
def test_the_trigger_resamples_now_and_then(position_alone, driven_by_acceleration, proposal):
    """Else the tests above would not tell it from always or never."""
    for world in (position_alone, driven_by_acceleration):
        filters = [world.build(proposal, "triggered", np.random.default_rng(seed)) for seed in range(20)]
        reports = [[filter_.step(frame).resampled for frame in world.frames] for filter_ in filters]
        assert 0.1 < np.mean(reports) < 0.9


def test_marginalising_and_refining_lower_the_spread():
    """All are unbiased; of as many particles, what is marginalised and what the proposal looks at lower the spread."""
    world = accelerated(0.005)
    marginalised, refined = (world.log_ratios(name, "always", 0, 100) for name in ("prior", "ekf"))
    F, Q, drift = world.motion.joint()
    motion, model = LinearMotion(F, np.linalg.cholesky(Q)), LinearObservation([[1.0, 0.0, 0.0], [0.0, 0.0, 0.5]])

    def all_sampled(seed: int) -> float:
        rng = np.random.default_rng(seed)
        start = rng.multivariate_normal([0.0, 0.0, 0.2], np.diag([0.0, 0.0, 0.16]), size=80)
        filter_ = Filter(motion, Scripted(), (), PriorProposal(), SCHEDULES["always"], 80, rng, start)
        for frame in world.frames:
            filter_.step(Frame([replace(frame.groups[0], model=model)]), drift)
        return filter_.log_evidence - world.log_evidence

    sampled = np.array([all_sampled(seed) for seed in range(100)])
    assert refined.std() < 0.8 * marginalised.std()
    assert marginalised.std() < 0.8 * sampled.std()
