"""Odometry as a motion model: composition, shapes, singular covariances."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.lie import SE2, SE3, Euclidean
from rbpf.motion.odometry import Odometry, OdometryMotion
from tests.core.scripted import Scripted

N = 4


@pytest.mark.parametrize("space", [SE2, SE3, Euclidean(2)], ids=repr)
def test_moves_every_particle_by_the_increment(space):
    rng = np.random.default_rng(0)
    state = space.exp(rng.normal(size=(N, space.dim)))
    delta = space.exp(rng.normal(size=space.dim))
    factor = rng.normal(size=(space.dim, space.dim))
    transition = OdometryMotion(space).transition(state, Odometry(delta, factor @ factor.T), 0.1)
    np.testing.assert_allclose(space.between(state, transition.mean), np.tile(delta, (N, 1)), atol=1e-12)
    assert transition.noise_factor.shape == (1, space.dim, space.dim)
    found = transition.noise_factor[0] @ transition.noise_factor[0].T
    np.testing.assert_allclose(found, factor @ factor.T, atol=1e-12)
    assert transition.coupling is None


def test_without_a_control_the_robot_stands_still():
    state = SE2.exp(np.random.default_rng(0).normal(size=(N, 3)))
    transition = OdometryMotion(SE2).transition(state, None, 0.1)
    np.testing.assert_array_equal(transition.mean, state)
    np.testing.assert_array_equal(transition.noise_factor, np.zeros((1, 3, 3)))


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_singular_covariances(rank):
    """As of a planar robot in space: particles spread in the range of the covariance only."""
    rng = np.random.default_rng(rank)
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    values = np.array([0.04, 0.01, 0.0]) * (np.arange(3) < rank)
    cov = (basis * values) @ basis.T
    cov = 0.5 * (cov + cov.T)
    filter_ = Filter(OdometryMotion(SE2), Scripted(), n=3000, rng=rng)
    delta = np.array([0.1, 1.0, 0.2])
    report = filter_.step([], Odometry(delta, cov))
    increment = SE2.local(np.tile(delta, (3000, 1)), filter_.particles.state)
    np.testing.assert_allclose(increment @ basis[:, rank:], 0.0, atol=1e-7)
    assert np.abs(increment.T @ increment / 3000 - cov).max() < 0.04 * 0.15
    np.testing.assert_allclose(report.estimate.mean, delta, atol=1e-9)
    np.testing.assert_allclose(report.estimate.cov, cov, atol=1e-9)
