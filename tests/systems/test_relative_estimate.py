"""Poses told relative to a frame that each particle knows in its own world, up to a covariance."""

import numpy as np
import pytest

from rbpf.core.particles import Prior, mixture_estimate
from rbpf.lie import SE2, SE3
from rbpf.systems.anchoring import Anchored, relative_estimate

every_space = pytest.mark.parametrize("space", [SE2, SE3], ids=repr)


def draw(space, n: int, spread: float, seed: int = 0):
    """Weighted particles whose own worlds differ much more than their poses relative to the frame."""
    rng = np.random.default_rng(seed)
    frames = space.exp(rng.normal(size=(n, space.dim)))
    relative = space.retract(space.exp(np.full(space.dim, 0.7)), spread * rng.normal(size=(n, space.dim)))
    factor = 0.02 * rng.normal(size=(n, space.dim, space.dim + 1))
    log_weights = np.log(rng.dirichlet(np.ones(n)))
    return Anchored(frames, factor), space.compose(frames, relative), relative, log_weights


@every_space
def test_frames_that_are_known_exactly(space):
    anchored, state, relative, log_weights = draw(space, 6, 0.1)
    found = relative_estimate(space, Anchored(anchored.mean, 0.0 * anchored.factor), state, log_weights)
    expected = mixture_estimate(Prior.exactly(space, relative), None, log_weights)
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-12)
    np.testing.assert_allclose(found.cov, expected.cov, atol=1e-12)


@every_space
def test_covariance_of_the_frame_is_turned_into_the_poses_chart(space):
    """Against samples of x_0 = mean Exp(F e) of one particle."""
    anchored, state, _, _ = draw(space, 1, 0.0)
    found = relative_estimate(space, anchored, state, np.zeros(1))
    n, factor = 100_000, anchored.factor[0]
    noise = np.random.default_rng(1).standard_normal((n, factor.shape[1]))
    moved = space.between(space.retract(anchored.mean, noise @ factor.T), state)
    errors = space.local(found.mean, moved)
    scale = np.sqrt(np.outer(np.diag(found.cov), np.diag(found.cov)))
    assert (np.abs(np.cov(errors.T) - found.cov) / scale).max() < 0.05
    assert (np.abs(factor @ factor.T - found.cov) / scale).max() > 0.1


@every_space
def test_moving_a_particles_world_changes_nothing(space):
    anchored, state, _, log_weights = draw(space, 5, 0.1)
    worlds = space.exp(np.random.default_rng(2).normal(size=(5, space.dim)))
    moved = Anchored(space.compose(worlds, anchored.mean), anchored.factor)
    one = relative_estimate(space, anchored, state, log_weights)
    other = relative_estimate(space, moved, space.compose(worlds, state), log_weights)
    np.testing.assert_allclose(other.mean, one.mean, atol=1e-12)
    np.testing.assert_allclose(other.cov, one.cov, atol=1e-12)


@every_space
def test_another_name_for_the_frame(space):
    """The covariance is in the right chart at the pose and stays."""
    anchored, state, _, log_weights = draw(space, 5, 0.1)
    origin = space.exp(np.linspace(0.1, 0.6, space.dim))
    plain = relative_estimate(space, anchored, state, log_weights)
    named = relative_estimate(space, anchored, state, log_weights, origin)
    np.testing.assert_allclose(named.mean, space.compose(origin, plain.mean), atol=1e-12)
    np.testing.assert_allclose(named.cov, plain.cov, atol=1e-12)
