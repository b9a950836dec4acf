"""Odometry as a motion model, of wheels and of a camera: composition, injected noise, fewer degrees of freedom."""

import numpy as np
import pytest

from rbpf import gaussian
from rbpf.core.filter import Filter
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Euclidean
from rbpf.motion.odometry import CAMERA_PLANE, Odometry, OdometryMotion, preintegrate
from tests.core.scripted import Scripted

N = 4
ADDED = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
HALF = np.random.default_rng(0).normal(scale=0.02, size=(6, 6))
MEASURED = Odometry(SE3.exp(np.array([0.02, 0.3, -0.01, 0.1, 0.02, 0.5])), HALF @ HALF.T)
PLANAR, OTHER = [1, 3, 5], [0, 2, 4]


@pytest.mark.parametrize("space", [SE2, SE3, Euclidean(2)], ids=repr)
def test_moves_every_particle_by_the_increment(space):
    rng = np.random.default_rng(0)
    state, delta = space.exp(rng.normal(size=(N, space.dim))), space.exp(rng.normal(size=space.dim))
    factor = rng.normal(size=(space.dim, space.dim))
    transition = OdometryMotion(space).transition(state, Odometry(delta, factor @ factor.T), 0.1)
    np.testing.assert_allclose(space.between(state, transition.mean), np.tile(delta, (N, 1)), atol=1e-12)
    assert transition.noise_factor.shape == (1, space.dim, space.dim)
    found = transition.noise_factor[0] @ transition.noise_factor[0].T
    np.testing.assert_allclose(found, factor @ factor.T, atol=1e-12)
    assert transition.coupling is None
    # Without a control the robot stands still.
    transition = OdometryMotion(space, 0.1).transition(state, None, 0.1)
    np.testing.assert_array_equal(transition.mean, state)
    np.testing.assert_array_equal(transition.noise_factor, np.zeros((1, space.dim, space.dim)))


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_singular_covariances(rank):
    """As of a planar robot in space: particles spread as the covariance says, in its range only."""
    rng = np.random.default_rng(rank)
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    values = np.array([0.04, 0.01, 0.02]) * (np.arange(3) < rank)
    cov = gaussian.symmetrise((basis * values) @ basis.T)
    filter_ = Filter(OdometryMotion(SE2), Scripted(), n=3000, rng=rng)
    delta = np.array([0.1, 1.0, 0.2])
    report = filter_.step([], Odometry(delta, cov))
    increment = SE2.local(np.tile(delta, (3000, 1)), filter_.particles.state)
    np.testing.assert_allclose(increment @ basis[:, rank:], 0.0, atol=1e-7)
    assert np.abs(increment.T @ increment / 3000 - cov).max() < 0.04 * 0.15
    np.testing.assert_allclose(np.append(report.estimate.mean, report.estimate.cov), np.append(delta, cov), atol=1e-9)


def test_injected_noise_is_added_and_nothing_else_changes():
    plain = OdometryMotion(SE3).constrained(MEASURED)
    np.testing.assert_array_equal(np.append(plain.delta, plain.cov), np.append(MEASURED.delta, MEASURED.cov))
    for std in (ADDED, 0.1):
        found = OdometryMotion(SE3, std).constrained(MEASURED)
        np.testing.assert_allclose(found.cov, MEASURED.cov + np.diag(np.broadcast_to(std, 6) ** 2))


def test_three_degrees_of_freedom_drop_the_others():
    found = OdometryMotion(SE3, 0.1, CAMERA_PLANE).constrained(MEASURED)
    xi = SE3.log(found.delta)
    np.testing.assert_allclose(xi[PLANAR], SE3.log(MEASURED.delta)[PLANAR], atol=1e-12)
    np.testing.assert_allclose(xi[OTHER], 0.0, atol=1e-15)
    expected = (MEASURED.cov + 0.01 * np.eye(6))[np.ix_(PLANAR, PLANAR)]
    np.testing.assert_allclose(found.cov[np.ix_(PLANAR, PLANAR)], expected)
    np.testing.assert_array_equal(found.cov[OTHER], 0.0)
    slope = Odometry(MEASURED.delta, MEASURED.cov, np.ones((6, 1)))
    moved = OdometryMotion(SE3, free=CAMERA_PLANE, constants=1).transition(MEASURED.delta[None], slope, 0.1)
    np.testing.assert_array_equal(moved.coupling[0, :, 0], CAMERA_PLANE)


def test_chained_covariance_against_samples():
    rng = np.random.default_rng(0)
    covs = [1e-6 * root @ root.T for root in np.random.default_rng(1).normal(size=(2, 6, 6))]
    first, second = (Odometry(SE3.exp(rng.normal(size=6)), cov) for cov in covs)
    both = first.then(second)
    errors = [rng.multivariate_normal(np.zeros(6), motion.cov, 40_000) for motion in (first, second)]
    moved = SE3.compose(SE3.retract(first.delta, errors[0]), SE3.retract(second.delta, errors[1]))
    np.testing.assert_allclose(both.delta, SE3.compose(first.delta, second.delta))
    size = np.sqrt(np.diagonal(both.cov))
    sampled = np.cov(SE3.local(both.delta, moved).T)
    np.testing.assert_allclose(sampled / np.outer(size, size), both.cov / np.outer(size, size), atol=0.03)
    rest = first.then(Odometry.at_rest())
    np.testing.assert_allclose(np.append(rest.delta, rest.cov), np.append(first.delta, first.cov), atol=1e-15)


def test_what_comes_between_two_frames_is_one_motion():
    rng = np.random.default_rng(0)
    ticks, by, root = 0.1 * rng.normal(size=(20, 6)), rng.normal(size=(6, 2)), rng.normal(size=(6, 6))
    motion, derivative = preintegrate(ticks, root @ root.T, by)

    def end(off: np.ndarray) -> np.ndarray:
        return SE3.local(motion.delta, preintegrate(ticks + off, np.eye(6), by)[0].delta)

    found = [(end(1e-6 * by[:, k]) - end(-1e-6 * by[:, k])) / 2e-6 for k in range(2)]
    np.testing.assert_allclose(np.transpose(found), derivative, atol=1e-8)
    each = [[end(1e-6 * (np.arange(20) == t)[:, None] * root[:, k]) / 1e-6 for k in range(6)] for t in range(20)]
    cov = np.einsum("tki,tkj->ij", each, each)
    np.testing.assert_allclose(motion.cov, cov, atol=1e-4 * np.abs(cov).max())


@pytest.mark.parametrize("std", [-1.0, np.ones(3), np.nan])
def test_wrong_noise_is_refused(std):
    with pytest.raises(InputError, match="std_added must be one or 6 numbers from 0 up"):
        OdometryMotion(SE3, std)
