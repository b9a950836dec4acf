"""Smoothed trajectories of a linear-Gaussian model against the Rauch-Tung-Striebel smoother."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.core.smoothing import _transition_log_density, ancestral_smoothing, backward_simulation
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.motion.odometry import Odometry, OdometryMotion
from tests.exactness import models

pytestmark = pytest.mark.slow

STEPS = 7
F = np.array([[1.0, 0.7], [0.0, 0.9]])
L = np.array([[0.35, 0.0], [0.15, 0.3]])
H, R = np.array([[1.0, 0.0]]), np.array([[0.3]])
MODEL = models.LinearObservation(by_state=H)
INPUTS = np.array([[0.5 * np.sin(t), 0.3 * (-1) ** t] for t in range(STEPS)])
"""Known, and different in each step: an input taken from the wrong step would show."""


@pytest.fixture(scope="module")
def measured() -> tuple[list[models.Frame], models.Kalman, list[tuple[np.ndarray, np.ndarray]]]:
    """Frames, the Kalman filter at the end, and the exact smoothed moments."""
    rng = np.random.default_rng(51)
    truth, frames = np.zeros(2), []
    kalman = models.Kalman(np.zeros(2), np.zeros((2, 2)))
    for u in INPUTS:
        truth = F @ truth + u + L @ rng.normal(size=2)
        z = H @ truth + np.sqrt(R[0]) * rng.normal(size=1)
        frames.append(models.Frame([models.single(z, R, MODEL)]))
        kalman.predict(F, L @ L.T, u)
        kalman.update(z, H, R)
        kalman.record()
    exact = models.smooth(kalman.path, F, L @ L.T, INPUTS)
    # The smoother and the filter differ by more than what the tests could overlook.
    assert max(
        abs(mean - filtered)[0] / np.sqrt(cov[0, 0])
        for (mean, cov), (filtered, _) in zip(exact, kalman.path, strict=True)
    ) > 0.3  # fmt: skip
    return frames, kalman, exact


def run(frames: list[models.Frame], n: int, rng: np.random.Generator, **options) -> Filter:
    filter_ = Filter(models.LinearMotion(F, L), models.Scripted(), n=n, rng=rng, **options)
    for frame, u in zip(frames, INPUTS, strict=True):
        filter_.step(frame, u)
    return filter_


@pytest.mark.parametrize("proposal", [PriorProposal(), EkfProposal()], ids=["prior", "ekf"])
def test_ancestral_paths_are_unbiased(measured, proposal, stream):
    """Ẑ Σ W f(x_t) is unbiased for Z E[f(x_t) | z_1:T] along ancestors: two moments of every step."""
    frames, kalman, exact = measured
    means, covs = (np.array(part) for part in zip(*exact, strict=True))
    logs, first, second = [], [], []
    for seed in range(models.SEEDS):
        rng = np.random.default_rng([stream, seed])
        filter_ = run(frames, 60, rng, proposal=proposal, resampler=EssTriggered(Systematic(), 0.6))
        smoothed = ancestral_smoothing(filter_.space, filter_.history, filter_.particles.weights)
        logs.append(filter_.log_evidence - kalman.log_evidence)
        error = smoothed.mean - means
        first.append(np.exp(logs[-1]) * error)
        second.append(np.exp(logs[-1]) * (smoothed.cov + error[:, :, None] * error[:, None, :] - covs))
    models.assert_unbiased(np.array(logs))
    assert models.deviation(np.array(first), 0.0) <= 4.0
    rows, columns = np.triu_indices(2)
    assert models.deviation(np.array(second)[:, :, rows, columns], 0.0) <= 4.0


def test_backward_simulation_agrees_with_the_exact_smoother(measured, stream):
    """Consistent, not unbiased: its error falls like 1/N. It spreads less than coalescing ancestry."""
    frames, _, exact = measured
    means, covs = (np.array(part) for part in zip(*exact, strict=True))
    runs, ancestral = [], []
    for seed in range(30):
        rng = np.random.default_rng([stream, seed])
        filter_ = run(frames, 200, rng, clouds=True, proposal=PriorProposal(), resampler=Systematic())
        runs.append(backward_simulation(filter_.motion, filter_.history, 400, rng, list(INPUTS)))
        ancestral.append(ancestral_smoothing(filter_.space, filter_.history, filter_.particles.weights))
    std = np.sqrt(np.array([np.diag(cov) for cov in covs]))
    error, worse = ((np.array([smoothed.mean for smoothed in of]) - means) / std for of in (runs, ancestral))
    assert models.deviation(error, 0.0) <= 4.0
    assert np.abs(error.mean(axis=0)).max() < 0.08
    assert np.square(error[:, 0]).mean() < 0.85 * np.square(worse[:, 0]).mean()
    spread = np.mean([smoothed.cov for smoothed in runs], axis=0)
    np.testing.assert_allclose(spread, covs, atol=0.06 * covs.max())
    np.testing.assert_array_equal(runs[0].stamps_ns, ancestral[0].stamps_ns)


def test_backward_simulation_says_what_it_cannot_do(measured):
    rng = np.random.default_rng(0)
    plain = run(measured[0], 10, rng)
    with pytest.raises(InputError, match="clouds=True and no lag"):
        backward_simulation(plain.motion, plain.history, 5, rng)
    lagged = run(measured[0], 10, rng, clouds=True, lag=3)
    with pytest.raises(InputError, match="clouds=True and no lag"):
        backward_simulation(lagged.motion, lagged.history, 5, rng)
    kept = run(measured[0], 10, rng, clouds=True)
    singular = models.LinearMotion(F, np.array([[0.3], [0.1]]))
    with pytest.raises(InputError, match="regular noise"):
        backward_simulation(singular, kept.history, 5, rng, list(INPUTS))
    driven = models.LinearMotion(F, np.eye(4), np.eye(2), np.eye(2), np.zeros(2))
    substate = KalmanSubstate(driven.space, np.zeros(2), np.eye(2))
    filter_ = Filter(driven, models.Scripted(), substate, n=10, rng=rng, clouds=True)
    for frame in measured[0]:
        filter_.step(frame)
    with pytest.raises(InputError, match="without a substate"):
        backward_simulation(filter_.motion, filter_.history, 5, rng)


def test_the_transition_density_on_poses_integrates_to_one():
    """The volume of right perturbations is dθ dx dy: the backward weight holds the chart's Jacobian."""
    factor = np.array([[0.5, 0.0, 0.0], [0.1, 0.3, 0.0], [0.0, 0.1, 0.2]])
    before, delta = np.array([[0.7, 1.0, -2.0]]), np.array([0.4, 1.0, 0.0])
    axes = [np.linspace(-3.0, 3.0, points) for points in (61, 49, 49)]
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * np.array([1.0, 0.8, 0.8])
    after = SE2.compose(before, delta) + offsets
    motion, control = OdometryMotion(SE2), Odometry(delta, factor @ factor.T)
    log_density = _transition_log_density(motion, before, SE2.normalise(after), control, 1.0)
    cell = 0.1**3
    assert np.exp(log_density).sum() * cell == pytest.approx(1.0, abs=1e-3)
