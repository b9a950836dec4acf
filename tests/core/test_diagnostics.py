"""Consistency figures of a filter that states its noise truly, and of one that does not."""

import numpy as np
import pytest
from scipy.stats import chi2

from rbpf.core.diagnostics import ancestors_by_step, chi_square_band, coalescence_steps, motion_correction, nees
from rbpf.core.filter import Filter
from rbpf.core.genealogy import History, Lineage
from rbpf.core.particles import Estimate, effective_sample_size
from rbpf.core.proposals import PriorProposal
from rbpf.lie import SE2, SE3, Euclidean
from tests.exactness.models import Frame, LinearMotion, LinearObservation, Scripted, single

PLANE = Euclidean(2)
STD_STEP, STD_FIX = 0.3, 0.5
RUNS, STEPS = 60, 15


WALK, FIX = LinearMotion(np.eye(2), STD_STEP * np.eye(2)), LinearObservation(np.eye(2))


def fixed(z: np.ndarray, cov: np.ndarray) -> Frame:
    """A position fix."""
    return Frame([single(z, cov, FIX)])


def mean_nees(claimed: float) -> float:
    """Of the last step, over independent runs; `claimed` is the standard deviation it is told."""
    rng = np.random.default_rng(12)
    total = 0.0
    for run in range(RUNS):
        truth = np.zeros(2)
        filter_ = Filter(WALK, Scripted(), n=200, rng=np.random.default_rng(run))
        for _ in range(STEPS):
            truth = truth + STD_STEP * rng.normal(size=2)
            report = filter_.step(fixed(truth + STD_FIX * rng.normal(size=2), claimed**2 * np.eye(2)))
        total += nees(PLANE, report.estimate, truth)
    return total / RUNS


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "side"), [(1.0, 0), (0.5, 1), (2.5, -1)], ids=["true", "too small", "too large"])
def test_a_filter_that_states_its_noise_truly_stays_in_the_band_and_another_leaves_it(factor, side):
    band, value = chi_square_band(dof=2, runs=RUNS), mean_nees(factor * STD_FIX)
    assert (value > band.high) - (value < band.low) == side


def test_band_holds_as_much_as_it_says():
    band = chi_square_band(dof=3, runs=20, probability=0.9)
    means = np.random.default_rng(0).chisquare(3, size=(20_000, 20)).mean(axis=1)
    assert np.mean((means > band.low) & (means < band.high)) == pytest.approx(0.9, abs=0.01)
    assert band.expected == 3.0 and chi_square_band(dof=2).high == pytest.approx(chi2.ppf(0.975, 2))


@pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
def test_nees_is_measured_in_the_chart_at_the_mean(space):
    rng = np.random.default_rng(1)
    mean = space.exp(rng.normal(size=space.dim))
    factor = rng.normal(size=(space.dim, space.dim))
    u = rng.normal(size=space.dim)
    truth = space.retract(mean, 0.01 * factor @ u)
    value = nees(space, Estimate(mean, 1e-4 * factor @ factor.T), truth)
    assert value == pytest.approx(u @ u, rel=1e-6)


def test_nees_leaves_out_what_is_known_exactly_and_effective_sample_sizes():
    assert nees(PLANE, Estimate(np.zeros(2), np.diag([0.0, 4.0])), np.array([0.0, 2.0])) == pytest.approx(1.0)
    assert effective_sample_size(np.full(8, 1 / 8)) == pytest.approx(8.0)
    assert effective_sample_size(np.eye(8)[3]) == 1.0
    assert effective_sample_size(np.array([0.5, 0.5, 0.0])) == pytest.approx(2.0)


def test_the_correction_of_a_motion_is_the_kalman_smoother_s():
    """E[w_t | z_1:t] = L⁻¹ Q S⁻¹ ν, whose covariance is Lᵀ S⁻¹ L: with S of all that is unknown, not of a particle."""
    rng = np.random.default_rng(5)
    factor, noise = np.array([[0.8, 0.0], [0.3, 0.5]]), 0.7 * np.eye(2)
    filter_ = Filter(LinearMotion(np.eye(2), factor), Scripted(), n=20_000, rng=rng)
    mean, cov = np.zeros(2), np.zeros((2, 2))
    for fix in np.cumsum(rng.normal(size=(6, 2)), axis=0):
        found = motion_correction(filter_.step(fixed(fix, noise)).mixture)
        predicted = cov + factor @ factor.T
        innovation = predicted + noise
        assert found is not None
        np.testing.assert_allclose(found.mean, factor.T @ np.linalg.solve(innovation, fix - mean), atol=0.03)
        np.testing.assert_allclose(found.cov, factor.T @ np.linalg.solve(innovation, factor), atol=0.03)
        gain = predicted @ np.linalg.inv(innovation)
        mean, cov = mean + gain @ (fix - mean), predicted - gain @ predicted


def test_a_bootstrap_step_has_no_correction():
    filter_ = Filter(WALK, Scripted(), proposal=PriorProposal(), n=10, rng=np.random.default_rng(0))
    assert motion_correction(filter_.step(fixed(np.zeros(2), np.eye(2))).mixture) is None


def test_ancestors_and_coalescence_follow_the_lineage():
    lineage = Lineage(4)
    history = History(lineage)
    for step, ancestors in enumerate([None, [0, 0, 1, 1], [2, 2, 3, 3], None, [0, 1, 2, 2]]):
        if ancestors is not None:
            lineage.advance(np.array(ancestors))
        history.record(step, np.zeros((4, 3)), np.zeros(4))
    # the last generation descends from rows 0, 1, 2 of the third, those from 2 and 3 of the second, these from row 1
    np.testing.assert_array_equal(ancestors_by_step(history), [1, 2, 3, 3, 4])
    assert coalescence_steps(history) == 4 and coalescence_steps(History(Lineage(2))) is None
