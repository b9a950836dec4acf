"""With everything marginalised the filter is a Kalman filter; given its trajectory, so is each particle."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from tests.exactness.models import Frame, Kalman, LinearMotion, LinearObservation, Scripted, single

TOLERANCE = 1e-9
PROPOSALS = [PriorProposal(), EkfProposal(), EkfProposal(exact=False), EkfProposal(iterations=3)]
every_proposal = pytest.mark.parametrize("proposal", PROPOSALS, ids=["prior", "ekf", "linearised", "iterated"])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1960)


class Unequal(LinearMotion):
    """Drives each particle by another multiple of the substate."""

    def transition(self, state, control, dt):
        return replace(super().transition(state, control, dt), coupling=(1.0 + np.arange(3))[:, None, None] * self.B)


def random_motion(rng: np.random.Generator, d: int, m: int, rank: int, kind: type = LinearMotion) -> LinearMotion:
    return kind(
        0.6 * rng.normal(size=(d, d)),
        0.5 * rng.normal(size=(d + m, rank)),
        rng.normal(size=(d, m)),
        0.5 * rng.normal(size=(m, m)),
        rng.normal(size=m),
    )


@every_proposal
@pytest.mark.parametrize("rank", [3, 1], ids=["regular", "singular"])
def test_everything_marginalised_is_a_kalman_filter(proposal, rank, rng):
    motion = random_motion(rng, 0, 3, rank)
    kalman = Kalman(rng.normal(size=3), np.diag([0.5, 1.0, 2.0]))
    models = [LinearObservation(by_substate=rng.normal(size=(p, 3))) for p in (2, 1)]
    filter_ = Filter(
        motion, Scripted(), KalmanSubstate(motion.space, kalman.mean, kalman.cov), proposal, Systematic(), n=5, rng=rng
    )
    F, Q, drift = motion.joint()
    for _ in range(12):
        groups = [single(rng.normal(size=model.dim), 0.3 * np.eye(model.dim), model) for model in models]
        before = kalman.log_evidence
        kalman.predict(F, Q, drift)
        for group, model in zip(groups, models, strict=True):
            kalman.update(group.z[0], next(iter(model.matrices.values())), group.cov[0])
        report = filter_.step(Frame(groups))
        substate = filter_.marginals.parts[KalmanSubstate.supplies]
        assert isinstance(substate, KalmanSubstate)
        np.testing.assert_allclose(substate.mean, np.tile(kalman.mean, (5, 1)), atol=TOLERANCE)
        np.testing.assert_allclose(substate.cov, np.tile(kalman.cov, (5, 1, 1)), atol=TOLERANCE)
        assert report.log_evidence == pytest.approx(kalman.log_evidence - before, abs=TOLERANCE)
    assert filter_.log_evidence == pytest.approx(kalman.log_evidence, abs=TOLERANCE)
    np.testing.assert_allclose(filter_.particles.weights, 0.2, rtol=1e-14)


@pytest.mark.parametrize("proposal", PROPOSALS[::3], ids=["prior", "iterated"])
@pytest.mark.parametrize(("rank", "kind"), [(4, Unequal), (1, LinearMotion)], ids=["regular", "fewer"])
def test_a_sampled_trajectory_is_an_exact_measurement_of_the_substate(proposal, rank, kind, rng):
    """Noise of rank 1 makes the increment a function of the substate."""
    motion = random_motion(rng, 2, 2, rank, kind)
    fix = LinearObservation(np.eye(2), 0.3 * np.ones((2, 2)))
    substate = KalmanSubstate(motion.space, np.ones(2), np.eye(2))
    filter_ = Filter(motion, Scripted(), substate, proposal, EssTriggered(Systematic(), 0.0), n=3, rng=rng)
    kalmans = [Kalman(np.ones(2), np.eye(2)) for _ in range(3)]
    before = filter_.particles.state
    noise = motion.L @ motion.L.T
    for _ in range(6):
        z = rng.normal(size=2)
        filter_.step(Frame([single(z, 0.5 * np.eye(2), fix)]))
        after = filter_.particles.state
        for i, kalman in enumerate(kalmans):
            joint = np.vstack([motion.B * (1.0 + i if kind is Unequal else 1.0), motion.A])
            pair = Kalman(
                np.concatenate([motion.F @ before[i], np.zeros(2)]) + joint @ kalman.mean,
                joint @ kalman.cov @ joint.T + noise,
            )
            pair.mean[2:] += motion.b
            gain = pair.cov[2:, :2] @ np.linalg.pinv(pair.cov[:2, :2])
            kalman.mean = pair.mean[2:] + gain @ (after[i] - pair.mean[:2])
            kalman.cov = pair.cov[2:, 2:] - gain @ pair.cov[:2, 2:]
            kalman.update(z - after[i], 0.3 * np.ones((2, 2)), 0.5 * np.eye(2))
            np.testing.assert_allclose(substate.mean[i], kalman.mean, atol=TOLERANCE)
            np.testing.assert_allclose(substate.cov[i], kalman.cov, atol=TOLERANCE)
        before = after
