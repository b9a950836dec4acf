"""With everything marginalised the filter is a Kalman filter; given its trajectory, so is each particle."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate, _split
from rbpf.core.models import Jacobians, ObservationModel, Part
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import MarginalVelocity, SampledVelocity
from tests.exactness.models import Frame, Kalman, LinearMotion, LinearObservation, Scripted, single

TOLERANCE = 1e-9
PROPOSALS = [PriorProposal(), EkfProposal(), EkfProposal(exact=False), EkfProposal(iterations=3)]
every_proposal = pytest.mark.parametrize("proposal", PROPOSALS, ids=["prior", "ekf", "linearised", "iterated"])


@pytest.fixture
def rng() -> np.random.Generator:
    """With other numbers, noise of rank 1 leaves rounding that the filter and the oracle amplify, each in its own way."""
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


def test_what_increments_tell_exactly_leaves_nothing():
    half = np.random.default_rng(0).normal(size=(40, 4, 2)) * [[1e-3], [1.0], [1e-5], [1e3]]
    assert not _split(half @ half.mT, 2)[2].any()


# A velocity that is marginalised: the joint Kalman filter where that is exact, and the sampled velocity's law.

WALK = np.array([0.0, 0.0, 0.0, 0.6, 0.9, 0.4])
"""Without rotation SE(3) is a vector space, and the joint Kalman filter is exact."""
HALF = np.random.default_rng(1).normal(size=(3, 4))
P0 = HALF @ HALF.T
V0 = np.array([0.4, -0.3, 0.2])
R = np.array([[0.05, 0.01, 0.0], [0.01, 0.04, 0.0], [0.0, 0.0, 0.06]])
STAMPS_S = [0.0, 0.1, 0.4, 0.4, 1.1, 1.3]
"""Steps of different lengths, one of no time."""


class Position(ObservationModel):
    """z = position + v; what rotates does not exist here."""

    dim = 3
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state[..., 4:7]

    def jacobians(self, state, landmark=None, const=None, substate=None):
        rotation = SE3.rotation(state[..., :7])
        by_state = np.zeros((*rotation.shape[:-1], 6 + state.shape[-1] - 7))
        by_state[..., 3:6] = rotation
        return Jacobians(state=by_state)


def substate(rotating: float = 0.0) -> KalmanSubstate:
    cov = np.zeros((6, 6))
    cov[:3, :3], cov[3:, 3:] = rotating**2 * np.eye(3), P0
    return KalmanSubstate(SE3, np.append(np.zeros(3), V0), cov)


def build(
    part: KalmanSubstate, n: int, seed: int, walk: np.ndarray = WALK, proposal=None, threshold: float = 0.5
) -> Filter:
    return Filter(
        MarginalVelocity(walk),
        Scripted(),
        part,
        proposal,
        EssTriggered(Systematic(), threshold),
        n,
        np.random.default_rng(seed),
    )


def measurements(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.outer(STAMPS_S, [0.5, 0.1, -0.2]) + 0.2 * rng.normal(size=(len(STAMPS_S), 3))


def test_the_exact_velocity_given_the_path():
    """Step by step: s | x_0:t of each particle is the Kalman filter's that is told its positions exactly."""
    part = substate()
    filter_ = build(part, 7, 3, threshold=0.0)
    z = measurements(0)
    kalman, places = Kalman(V0, P0), np.zeros((7, 3))
    means = np.repeat(V0[None], 7, axis=0)
    sigma = np.diag(WALK[3:] ** 2)
    for t, stamp in enumerate(STAMPS_S):
        filter_.step(Frame([single(z[t], R, Position())]), None, round(stamp * 1e9))
        dt = stamp - STAMPS_S[max(t - 1, 0)]
        after = filter_.particles.state[:, 4:7]
        if dt > 0.0:
            cov = kalman.cov
            S = dt**2 * cov + dt**3 / 3 * sigma
            gain = (dt * cov + dt**2 / 2 * sigma) @ np.linalg.inv(S)
            means = means + (after - places - dt * means) @ gain.T
            kalman.cov = cov + dt * sigma - gain @ S @ gain.T
        places = after.copy()
        np.testing.assert_allclose(part.mean[:, 3:], means, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(part.mean[:, :3], 0.0, atol=1e-12)
        assert part.cov.shape == (1, 6, 6)
        np.testing.assert_allclose(part.cov[0, 3:, 3:], kalman.cov, rtol=1e-7, atol=1e-9)
    assert filter_.lineage.generation == 0


def test_sampled_and_marginal_velocity_have_one_law():
    """Three steps without measurements, rotation included: first and second moments of the pose agree."""
    n, walk = 15_000, np.array([0.5, 0.4, 0.6, 0.6, 0.9, 0.4])
    std = np.array([0.3, 0.3, 0.3, 0.5, 0.5, 0.5])
    part = KalmanSubstate(SE3, np.array([0.2, -0.1, 0.4, *V0]), np.diag(std**2))
    marginal = build(part, n, 11, walk, PriorProposal())
    rng = np.random.default_rng(12)
    velocity = part._mean + std * rng.standard_normal((n, 6))
    start = np.concatenate([SE3.identity((n,)), velocity], axis=1)
    joint = Filter(
        SampledVelocity(walk), Scripted(), (), PriorProposal(), n=n, rng=np.random.default_rng(13), start=start
    )
    for stamp in (0, 200_000_000, 500_000_000, 600_000_000):
        for filter_ in (marginal, joint):
            filter_.step(Frame(), None, stamp)
    place, samples = SE3.exp(np.array([0.1, -0.1, 0.2, 0.3, 0.1, -0.1])), []
    for filter_ in (marginal, joint):
        error = SE3.local(place, filter_.particles.state[:, :7])
        products = np.einsum("na,nb->nab", error, error)[(slice(None), *np.triu_indices(6))]
        samples.append(np.hstack([error, products]))
    one, other = samples
    scale = np.sqrt((one.var(axis=0) + other.var(axis=0)) / n)
    assert (np.abs(one.mean(axis=0) - other.mean(axis=0)) / scale).max() < 4.0
    assert np.abs(one.mean(axis=0)[:6]).max() > 30.0 * scale[:6].max()
    velocities = joint.particles.state[:, 7:]
    np.testing.assert_allclose(part.mean.mean(axis=0), velocities.mean(axis=0), atol=6.0 / np.sqrt(n))
    total = np.cov(part.mean.T) + part.cov[0]
    np.testing.assert_allclose(total, np.cov(velocities.T), atol=10.0 * total.max() / np.sqrt(n))
