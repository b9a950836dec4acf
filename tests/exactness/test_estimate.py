"""A step's estimate follows both weights, and carries covariances into the chart of the mean."""

import numpy as np
import pytest

from rbpf.core.filter import Filter, StepReport
from rbpf.core.likelihoods import GaussianWithOutliers, TruncatedMahalanobis
from rbpf.core.models import NEW, NULL, Observations, Records
from rbpf.core.particles import Prior, mixture_estimate
from rbpf.core.proposals import EkfProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.lie import SE2, SE3, Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import MixturePoint, Point
from tests.exactness.models import Curved, Frame, LinearMotion, LinearObservation, Relative, Scripted, single

PLANE = Euclidean(2)
TRUE = np.array([1.18, -0.68])


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("resampler", [None, Systematic()], ids=["as needed", "always"])
def test_what_enters_the_second_weight_alone_is_in_the_estimate(exact, resampler):
    """A landmark of two components says where the robot is; the mixture before sampling is the prediction, 0 ± 1."""
    n, held = 20_000, LandmarkMap(PLANE)
    filter_ = Filter(
        LinearMotion(np.eye(2), np.eye(2)), Scripted(), held, EkfProposal(exact), resampler, n,
        np.random.default_rng(3),
    )  # fmt: skip
    mean = np.tile(np.array([[[3.0, 1.0], [9.0, 9.0]]]), (n, 1, 1, 1))
    held.add_records(
        Records(mean, np.tile(1e-6 * np.eye(2), (n, 1, 2, 1, 1)), None, np.full((n, 1, 2), np.log(0.5))),
        MixturePoint(2),
    )
    z = np.array([[3.0, 1.0]]) - TRUE * (1.0 + 0.01)
    report = filter_.step(Frame([Observations(z, 0.01 * np.eye(2)[None], Relative(), ids=np.array([0]))]))
    sampled = filter_.estimate()
    np.testing.assert_allclose(sampled.mean, TRUE, atol=0.02)
    np.testing.assert_allclose(report.estimate.mean, TRUE, atol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(report.estimate.cov)), 0.0995, atol=0.01)
    np.testing.assert_allclose(report.estimate.cov, sampled.cov, atol=1e-3)


def test_the_nonlinear_part_is_in_the_estimate():
    """Of a fix whose slope is another one than where it is linearised, x + x²/5 of the first coordinate."""
    fix = Curved(lambda state: state[..., :1] + 0.2 * state[..., :1] ** 2)
    z, var = 2.5, 0.3
    grid = np.linspace(-6.0, 6.0, 20_001)
    density = np.exp(-0.5 * grid**2 - 0.5 * (z - grid - 0.2 * grid**2) ** 2 / var)
    exact = (grid * density).sum() / density.sum()
    std = np.sqrt(((grid - exact) ** 2 * density).sum() / density.sum())
    filter_ = Filter(LinearMotion(np.eye(2), np.eye(2)), Scripted(), n=50_000, rng=np.random.default_rng(4))
    report = filter_.step(Frame([single(np.array([z]), var, fix)]))
    assert abs(mixture_estimate(*report.mixture).mean[0] - exact) > 0.1
    assert report.estimate.mean[0] == pytest.approx(exact, abs=0.1 * std)
    np.testing.assert_allclose(report.estimate.mean, filter_.estimate().mean, atol=0.01)


def test_in_a_linear_model_the_estimate_has_no_noise_of_sampling():
    """w₂ is constant: what a Kalman filter says, whether or not the step resamples."""
    for resampler in (Systematic(), EssTriggered(Systematic())):
        filter_ = Filter(
            LinearMotion(np.eye(2), np.eye(2)), Scripted(), (), None, resampler, 30, np.random.default_rng(5)
        )
        report = filter_.step(Frame([single(np.array([1.0]), 0.5, LinearObservation(by_state=[[1.0, 0.0]]))]))
        assert report.second is not None and report.second.trust == 0.0
        np.testing.assert_allclose(report.estimate.mean, [1.0 / 1.5, 0.0], atol=1e-12)
        np.testing.assert_allclose(report.estimate.cov, np.diag([0.5 / 1.5, 1.0]), atol=1e-12)


@pytest.mark.parametrize("shared", [True, False], ids=["one noise", "noise per particle"])
@pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
def test_the_covariance_within_a_particle_is_carried_into_the_chart_of_the_mean(space, shared):
    """Particles far apart, each with a narrow Gaussian: against draws."""
    rng, n, draws = np.random.default_rng(7), 5, 100_000
    base = space.retract(space.identity((n,)), 0.7 * rng.normal(size=(n, space.dim)))
    factor = 0.05 * rng.normal(size=(1 if shared else n, space.dim, space.dim))
    prior, weights = Prior(space, base, np.zeros((1, space.dim)), factor), rng.dirichlet(np.full(n, 5.0))
    estimate = mixture_estimate(prior, None, np.log(weights))
    centres = space.local(estimate.mean, base)
    between = np.einsum("n,na,nb->ab", weights, centres, centres)
    within, plain = np.zeros((2, space.dim, space.dim))
    for i in range(n):
        own = factor[0 if shared else i]
        state = space.retract(base[i], rng.normal(size=(draws, space.dim)) @ own.T)
        within += weights[i] * np.cov(space.local(estimate.mean, state).T)
        plain += weights[i] * own @ own.T
    size = np.abs(within).max()
    np.testing.assert_allclose(estimate.cov - between, within, atol=0.02 * size)
    assert np.abs(plain - within).max() > 0.03 * size


# The normalised innovation squared and its degrees of freedom count the rows that took part, particle by particle.

N = 40

LANDMARKS = np.array([[3.0, 1.0], [3.2, 0.9]])
EVERY_PATH = pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "numpy"])
HALVES = np.arange(N)[:, None] % 2
"""Particles by which of two landmarks they take."""


def report(z, ids, likelihood=None, compiled=True, factor: float = 0.3, **costs) -> StepReport:
    """Of one step from the origin, with measurements z (K, 2) of landmarks."""
    held = LandmarkMap(PLANE, compiled=compiled)
    motion = LinearMotion(np.eye(2), factor * np.eye(2))
    filter_ = Filter(motion, Scripted(), held, n=N, rng=np.random.default_rng(15))
    held.add_records(Records(np.tile(LANDMARKS, (N, 1, 1)), np.tile(0.05 * np.eye(2), (N, 2, 1, 1))), Point(2))
    z = np.atleast_2d(z)
    group = Observations(z, np.tile(0.1 * np.eye(2), (len(z), 1, 1)), Relative(), likelihood, ids, **costs)
    return filter_.step(Frame([group]))


@EVERY_PATH
def test_two_associations_that_are_split_over_the_particles_are_one_measurement(compiled):
    z = np.array([3.1, 0.95])
    split, one = report(z, HALVES, compiled=compiled), report(z, np.array([0]), compiled=compiled)
    assert split.rows == one.rows == 2.0
    assert split.nis == pytest.approx(one.nis, rel=1e-12)


@EVERY_PATH
@pytest.mark.parametrize("likelihood", [TruncatedMahalanobis(4.0, 16.3), GaussianWithOutliers(0.1, 50.0)])
def test_what_is_gated_is_not_counted(likelihood, compiled):
    far, near = np.array([9.0, 9.0]), np.array([3.05, 1.0])
    gated = report(far, np.array([0]), likelihood, compiled)
    assert (gated.nis, gated.rows) == (0.0, 0.0)
    alone = report(near, np.array([1]), likelihood, compiled)
    both = report(np.stack([far, near]), np.array([0, 1]), likelihood, compiled)
    assert both.rows == alone.rows == 2.0
    assert both.nis == pytest.approx(alone.nis, rel=1e-12)
    twice = report(np.stack([far, near]), np.array([1, 1]), likelihood, compiled)
    assert twice.rows == 2.0


@EVERY_PATH
@pytest.mark.parametrize("outcome", [NEW, NULL])
def test_rows_count_by_the_weight_of_the_particles_that_use_them(outcome, compiled):
    """Those that do not pay a density for it, so that their weight is known."""
    z, density = np.array([3.1, 0.95]), {"log_new": -1.0, "log_clutter": -1.0}
    ids = np.where(np.arange(N)[:, None] % 4 == 0, outcome, 0)
    found, one = report(z, ids, compiled=compiled, **density), report(z, np.array([0]), compiled=compiled)
    known = 0.75 * np.exp(one.log_evidence)
    fraction = known / (known + 0.25 * np.exp(-1.0))
    assert found.rows == pytest.approx(2.0 * fraction, rel=1e-9)
    assert found.nis == pytest.approx(one.nis * fraction, rel=1e-9)
