"""Constant velocity driven by white-noise acceleration: E06 (5), its two sampled modes, and the start."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import POSE_AND_VELOCITY, MarginalVelocity, PosePrior, SampledVelocity, velocity_walk

WALK = np.array([0.3, 0.5, 0.7, 1.1, 0.2, 0.9])
SIGMA = np.diag(WALK**2)
HALF = np.random.default_rng(3).normal(scale=0.2, size=(6, 8))
PRIOR = PosePrior(SE3.exp(np.array([0.4, -0.2, 1.0, 3.0, -1.0, 2.0])), HALF @ HALF.T)
every_time_step = pytest.mark.parametrize("dt", [1.0 / 30.0, 0.5, 2.0, 7.0])


def covariance(dt: float) -> np.ndarray:
    """E06 (5), written out."""
    return np.block([[dt**3 / 3 * SIGMA, dt**2 / 2 * SIGMA], [dt**2 / 2 * SIGMA, dt * SIGMA]])


def states(n: int, seed: int = 0) -> np.ndarray:
    return POSE_AND_VELOCITY.exp(np.random.default_rng(seed).normal(scale=0.6, size=(n, 12)))


@every_time_step
def test_variance_that_the_pose_leaves_to_the_velocity(dt):
    """The last six columns: Schur complement of (5), δΣ/4, which the paper's mode drops."""
    rest = velocity_walk(WALK, dt)[:, 6:]
    Q = covariance(dt)
    schur = Q[6:, 6:] - Q[6:, :6] @ np.linalg.inv(Q[:6, :6]) @ Q[:6, 6:]
    np.testing.assert_allclose(rest[6:] @ rest[6:].T, schur, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(schur, dt * SIGMA / 4, rtol=1e-10, atol=1e-14)
    joint, paper = (
        SampledVelocity(WALK, mode).transition(states(1), None, dt).noise_factor[0] for mode in ("joint", "paper")
    )
    dropped = joint @ joint.T - paper @ paper.T
    np.testing.assert_allclose(dropped[6:, 6:], dt * SIGMA / 4, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(dropped[:6], 0.0, atol=1e-13)


@every_time_step
def test_paper_moves_the_velocity_with_the_pose(dt):
    """v ← v + (3/2δ) w₁ with w₁ = J_r(δv)⁻¹ Log(predicted⁻¹ sampled), for every sample."""
    state = states(5)
    transition = SampledVelocity(0.05 * WALK, "paper").transition(state, None, dt)
    noise = np.random.default_rng(4).normal(size=(5, transition.noise_factor.shape[2]))
    increment = np.einsum("nar,nr->na", transition.noise_factor, noise)
    sampled = POSE_AND_VELOCITY.retract(transition.mean, increment)
    drift = dt * state[:, 7:]
    w1 = SE3.local(SE3.retract(state[:, :7], drift), sampled[:, :7])
    w1 = np.einsum("nab,nb->na", SE3.right_jacobian_inverse(drift), w1)
    assert np.abs(w1).max() > 1e-4
    np.testing.assert_allclose(sampled[:, 7:] - state[:, 7:], 1.5 / dt * w1, rtol=1e-7, atol=1e-9)


def test_joint_noise_in_the_chart_of_the_prediction():
    """Exp(δv + w₁) as Exp(δv) Exp(ε): drawn from (5), then charted, it has the covariance of the factor."""
    dt, n = 0.4, 200_000
    walk = 0.02 * WALK
    state = POSE_AND_VELOCITY.exp(np.array([[0.3, -0.4, 0.5, 1.0, 2.0, 3.0, 1.5, -2.0, 1.0, 2.0, -1.0, 3.0]]))
    transition = SampledVelocity(walk, "joint").transition(state, None, dt)
    noise = np.random.default_rng(5).multivariate_normal(np.zeros(12), covariance(dt), size=n) * 0.02
    after = SE3.retract(state[:, :7], dt * state[:, 7:] + noise[:, :6])
    drawn = np.concatenate([SE3.local(transition.mean[:, :7], after), noise[:, 6:]], axis=1)
    factor = transition.noise_factor[0]
    expected = factor @ factor.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(drawn.T @ drawn / n - expected) / scale).max() < 5.0 * np.sqrt(2.0 / n)
    uncharted = covariance(dt) * 0.02**2
    assert (np.abs(uncharted - expected) / scale).max() > 0.05


@pytest.mark.parametrize("dt", [0.0, 0.7])
def test_prediction(dt):
    """The pose follows the velocity, and without time nothing moves; the substate is coupled to the pose by the time."""
    state = states(4)
    for mode in ("paper", "joint"):
        transition = SampledVelocity(WALK, mode).transition(state, None, dt)
        moved = SE3.compose(state[:, :7], SE3.exp(dt * state[:, 7:]))
        np.testing.assert_allclose(transition.mean[:, :7], moved, atol=1e-15)
        np.testing.assert_array_equal(transition.mean[:, 7:], state[:, 7:])
        assert transition.noise_factor.any() == (dt > 0.0)
    marginal = MarginalVelocity(WALK).transition(state[:, :7], None, dt)
    np.testing.assert_array_equal(marginal.mean, state[:, :7])
    np.testing.assert_array_equal(marginal.coupling, dt * np.eye(6)[None])
    np.testing.assert_array_equal(marginal.dynamics, np.eye(6)[None])
    np.testing.assert_array_equal(marginal.drift, np.zeros((1, 6)))
    factor = marginal.noise_factor[0]
    np.testing.assert_allclose(factor @ factor.T, covariance(dt), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("dt", [0.0, 0.3])
@pytest.mark.parametrize("std_velocity", [None, 0.3 * WALK])
@pytest.mark.parametrize("mode", ["marginal", "joint", "paper"])
def test_a_prior_places_the_body(mode, std_velocity, dt):
    """Wherever it was; the velocity is independent of the place: as at the start, walked on, or forgotten."""
    state, std_start, prior = states(3), 0.5 * WALK, replace(PRIOR, std_velocity=std_velocity)
    if mode == "marginal":
        transition = MarginalVelocity(WALK).transition(state[:, :7], prior, dt)
        np.testing.assert_array_equal(transition.coupling, np.zeros((1, 6, 6)))
        np.testing.assert_array_equal(transition.dynamics, np.eye(6)[None] * (std_velocity is None))
        of_velocity = dt * SIGMA
    else:
        transition = SampledVelocity(WALK, mode, std_start).transition(state, prior, dt)
        np.testing.assert_array_equal(transition.mean[:, 7:], state[:, 7:] * (std_velocity is None))
        of_velocity = np.diag(std_start**2)
    if std_velocity is not None:
        of_velocity = np.diag(std_velocity**2)
    np.testing.assert_allclose(transition.mean[:, :7], np.repeat(PRIOR.mean[None], 3, axis=0), rtol=1e-14)
    factor, zero = transition.noise_factor[0], np.zeros((6, 6))
    expected = np.block([[PRIOR.cov, zero], [zero, of_velocity]])
    np.testing.assert_allclose(factor @ factor.T, expected, atol=1e-14)


@pytest.mark.parametrize(
    "std", [np.nan, -0.1, np.array([1.0, 1.0, np.inf, 1.0, 1.0, 1.0]), np.ones(5), np.ones((2, 6))]
)
def test_bad_standard_deviations(std):
    np.testing.assert_array_equal(MarginalVelocity(0.5).std_walk, np.full(6, 0.5))
    for build in (MarginalVelocity, SampledVelocity, lambda std: SampledVelocity(1.0, std_start=std)):
        with pytest.raises(InputError, match="must be one or 6 numbers from 0 up"):
            build(std)


@pytest.mark.parametrize(
    ("mean", "cov", "sentence"),
    [
        (PRIOR.mean[:6], PRIOR.cov, r"needs a finite mean \(7,\) and cov \(6, 6\)"),
        (PRIOR.mean * np.nan, PRIOR.cov, r"needs a finite mean \(7,\) and cov \(6, 6\)"),
        (PRIOR.mean, -np.eye(6), "negative eigenvalue"),
    ],
)
def test_bad_priors(mean, cov, sentence):
    for motion, state in ((MarginalVelocity(1.0), states(2)[:, :7]), (SampledVelocity(1.0), states(2))):
        with pytest.raises(InputError, match=sentence):
            motion.transition(state, PosePrior(mean, cov), 0.0)


def test_an_unknown_mode_of_a_sampled_velocity():
    with pytest.raises(InputError, match="'paper' or 'joint', got 'marginal'"):
        SampledVelocity(0.1, "marginal")
