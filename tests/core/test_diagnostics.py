"""Consistency figures of a filter that is honest, and of one that is not."""

import numpy as np
import pytest
from scipy.stats import chi2

from rbpf.core.diagnostics import (
    ancestor_diversity,
    ancestors_by_step,
    chi_square_band,
    coalescence_steps,
    effective_sample_size,
    motion_correction,
    nees,
)
from rbpf.core.filter import Filter
from rbpf.core.genealogy import History, Lineage
from rbpf.core.models import MotionModel, ObservationModel, Part, Transition
from rbpf.core.particles import Estimate
from rbpf.core.proposals import PriorProposal
from rbpf.lie import SE2, SE3, Euclidean
from tests.core.scripted import Scripted, seen

PLANE = Euclidean(2)
STD_STEP, STD_FIX = 0.3, 0.5
RUNS, STEPS = 60, 15


class Walk(MotionModel):
    """A random walk in the plane."""

    space = PLANE

    def transition(self, state, control, dt):
        return Transition(state, STD_STEP * np.eye(2)[None])


class Fix(ObservationModel):
    """A position fix."""

    dim = 2
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state.copy()


def mean_nees(claimed: float) -> float:
    """Of the last step, over independent runs; `claimed` is the standard deviation it is told."""
    rng = np.random.default_rng(12)
    cov = claimed**2 * np.eye(2)[None]
    total = 0.0
    for run in range(RUNS):
        truth = np.zeros(2)
        filter_ = Filter(Walk(), Scripted(), n=200, rng=np.random.default_rng(run))
        for _ in range(STEPS):
            truth = truth + STD_STEP * rng.normal(size=2)
            report = filter_.step(seen(Fix(), [truth + STD_FIX * rng.normal(size=2)], cov))
        total += nees(PLANE, report.estimate, truth)
    return total / RUNS


@pytest.mark.slow
def test_an_honest_filter_stays_in_the_band():
    band = chi_square_band(dof=2, runs=RUNS)
    assert band.low < mean_nees(STD_FIX) < band.high


@pytest.mark.slow
@pytest.mark.parametrize(("claimed", "side"), [(0.5 * STD_FIX, "high"), (2.5 * STD_FIX, "low")])
def test_a_dishonest_filter_leaves_it(claimed, side):
    band = chi_square_band(dof=2, runs=RUNS)
    value = mean_nees(claimed)
    assert value > band.high if side == "high" else value < band.low


def test_band_holds_as_much_as_it_says():
    band = chi_square_band(dof=3, runs=20, probability=0.9)
    means = np.random.default_rng(0).chisquare(3, size=(20_000, 20)).mean(axis=1)
    assert np.mean((means > band.low) & (means < band.high)) == pytest.approx(0.9, abs=0.01)
    assert band.expected == 3.0
    assert chi_square_band(dof=2).high == pytest.approx(chi2.ppf(0.975, 2))


@pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
def test_nees_is_measured_in_the_chart_at_the_mean(space):
    rng = np.random.default_rng(1)
    mean = space.exp(rng.normal(size=space.dim))
    factor = rng.normal(size=(space.dim, space.dim))
    u = rng.normal(size=space.dim)
    truth = space.retract(mean, 0.01 * factor @ u)
    value = nees(space, Estimate(mean, 1e-4 * factor @ factor.T), truth)
    assert value == pytest.approx(u @ u, rel=1e-6)


def test_nees_leaves_out_what_is_known_exactly():
    cov = np.diag([0.0, 4.0])
    assert nees(PLANE, Estimate(np.zeros(2), cov), np.array([0.0, 2.0])) == pytest.approx(1.0)


def test_effective_sample_size():
    assert effective_sample_size(np.full(8, 1 / 8)) == pytest.approx(8.0)
    assert effective_sample_size(np.eye(8)[3]) == 1.0
    assert effective_sample_size(np.array([0.5, 0.5, 0.0])) == pytest.approx(2.0)


def test_ancestor_diversity():
    lineage = Lineage(4)
    lineage.retain(0)
    lineage.advance(np.array([0, 0, 1, 3]))
    lineage.advance(np.array([0, 1, 1, 2]))
    lineage.retain(2)
    lineage.advance(np.array([3, 3, 3, 0]))
    # Generation 1 was not kept, and there is none before the first.
    assert ancestor_diversity(lineage, [0, 1, 2, 3, 4]) == {0: 4, 1: 2, 3: 2}


class Slanted(MotionModel):
    """A random walk whose axes are correlated."""

    space = PLANE
    factor = np.array([[0.8, 0.0], [0.3, 0.5]])

    def transition(self, state, control, dt):
        return Transition(state, self.factor[None])


def test_the_correction_of_a_motion_is_the_kalman_smoother_s():
    """E[w_t | z_1:t] = L⁻¹ Q S⁻¹ ν, whose covariance is Lᵀ S⁻¹ L: with S of all that is unknown, not of a particle."""
    rng = np.random.default_rng(5)
    filter_ = Filter(Slanted(), Scripted(), n=20_000, rng=rng)
    factor, noise = Slanted.factor, 0.7 * np.eye(2)
    mean, cov = np.zeros(2), np.zeros((2, 2))
    for fix in np.cumsum(rng.normal(size=(6, 2)), axis=0):
        found = motion_correction(filter_.step(seen(Fix(), [fix], noise[None])).mixture)
        predicted = cov + factor @ factor.T
        innovation = predicted + noise
        assert found is not None
        np.testing.assert_allclose(found.mean, factor.T @ np.linalg.solve(innovation, fix - mean), atol=0.03)
        np.testing.assert_allclose(found.cov, factor.T @ np.linalg.solve(innovation, factor), atol=0.03)
        gain = predicted @ np.linalg.inv(innovation)
        mean, cov = mean + gain @ (fix - mean), predicted - gain @ predicted


def test_a_bootstrap_step_has_no_correction():
    filter_ = Filter(Walk(), Scripted(), proposal=PriorProposal(), n=10, rng=np.random.default_rng(0))
    step = filter_.step(seen(Fix(), [np.zeros(2)]))
    assert motion_correction(step.mixture) is None


def test_ancestors_and_coalescence_follow_the_lineage():
    lineage = Lineage(4)
    history = History(lineage)
    for step, ancestors in enumerate([None, [0, 0, 1, 1], [2, 2, 3, 3], None, [0, 1, 2, 2]]):
        if ancestors is not None:
            lineage.advance(np.array(ancestors))
        history.record(step, np.zeros((4, 3)), np.zeros(4))
    # the last generation descends from rows 0, 1, 2 of the third, those from 2 and 3 of the second, these from row 1
    np.testing.assert_array_equal(ancestors_by_step(history), [1, 2, 3, 3, 4])
    assert coalescence_steps(history) == 4
    assert coalescence_steps(History(Lineage(2))) is None
