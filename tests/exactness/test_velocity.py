"""A velocity that is marginalised: the joint Kalman filter where that is exact, and the sampled velocity's law."""

import numpy as np

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import Jacobians, ObservationModel, Part
from rbpf.core.proposals import PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import MarginalVelocity, SampledVelocity
from tests.exactness.models import Frame, Kalman, Scripted, single

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
