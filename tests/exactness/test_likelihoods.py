"""The truncated Mahalanobis form is S05's, to the letter; the one with outliers is a density."""

import numpy as np
import pytest
from scipy.stats import multivariate_t

from rbpf.core.filter import Filter
from rbpf.core.likelihoods import Gaussian, GaussianWithOutliers, StudentT, TruncatedMahalanobis
from rbpf.core.marginals import Marginals
from rbpf.core.models import ObservationModel, Observations, Records
from rbpf.core.proposals import EkfProposal, PriorProposal, refined
from rbpf.errors import InputError
from rbpf.lie import Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from tests.exactness.models import Frame, LinearMotion, LinearObservation, Relative, Scripted, single
from tests.exactness.scenes import random_covs

TRUNCATED = TruncatedMahalanobis()
PLANE = Euclidean(2)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_truncated_mahalanobis_is_s05_equation_6(p, rng):
    """−½ min(T_l, νᵀS⁻¹ν) with T_l = 4.0, in no units."""
    nu, cov = rng.normal(scale=2.0, size=(300, p)), random_covs(rng, (300,), p, 1.0)
    squared = np.array([v @ np.linalg.solve(S, v) for v, S in zip(nu, cov, strict=True)])
    expected = np.where(squared < 4.0, -0.5 * squared, -2.0)
    assert 0.1 < (squared < 4.0).mean() < 0.9
    np.testing.assert_allclose(TRUNCATED.log_density(nu, cov), expected, rtol=1e-12)
    np.testing.assert_array_equal(TRUNCATED.inlier(nu, cov), squared < 4.0)
    assert TRUNCATED.log_outlier() == -2.0
    np.testing.assert_allclose(TRUNCATED.log_density(1000.0 * nu, 1e6 * cov), expected, rtol=1e-9)


def test_students_t_is_the_usual_one(rng):
    nu, cov = rng.normal(scale=2.0, size=(5, 3)), random_covs(rng, (), 3, 1.0)
    expected = multivariate_t(shape=cov, df=2.5).logpdf(nu)
    np.testing.assert_allclose(StudentT(2.5).log_density(nu, np.tile(cov, (5, 1, 1))), expected, rtol=1e-12)
    with pytest.raises(InputError, match="degrees of freedom above 0 and finite, got inf"):
        StudentT(np.inf)


def test_what_is_clipped_may_update_all_the_same(rng):
    """The second limit is that of updates, and leaves the density and the cost of a null match as they are."""
    nu, cov = rng.normal(scale=2.0, size=(300, 3)), random_covs(rng, (300,), 3, 1.0)
    wide, squared = TruncatedMahalanobis(4.0, 9.0), np.einsum("ni,nij,nj->n", nu, np.linalg.inv(cov), nu)
    assert ((squared > 4.0) & (squared < 9.0)).sum() > 20
    np.testing.assert_array_equal(wide.inlier(nu, cov), squared < 9.0)
    np.testing.assert_array_equal(wide.log_density(nu, cov), TRUNCATED.log_density(nu, cov))
    assert wide.log_outlier() == -2.0
    with pytest.raises(InputError, match=r"update_limit .* must be at least T_l = 4, got 3"):
        TruncatedMahalanobis(4.0, 3.0)


@pytest.mark.parametrize("p", [1, 2])
@pytest.mark.parametrize("likelihood", [GaussianWithOutliers(0.2, 1.0), Gaussian()], ids=["outliers", "gaussian"])
def test_densities_integrate_to_one_over_the_measurement_space(likelihood, p, rng):
    """Outliers are uniform over what the sensor can return: here a cube of side 30 about the prediction."""
    side, points = 30.0, 601
    if isinstance(likelihood, GaussianWithOutliers):
        likelihood = GaussianWithOutliers(0.2, side**p)
    axis, step = np.linspace(-side / 2, side / 2, points, retstep=True)
    midpoints = axis[:-1] + step / 2
    nu = np.stack(np.meshgrid(*[midpoints] * p, indexing="ij"), axis=-1)
    for cov in random_covs(rng, (3,), p, 0.8):
        assert np.exp(likelihood.log_density(nu, cov)).sum() * step**p == pytest.approx(1.0, abs=1e-5)
    truncated = np.exp(TRUNCATED.log_density(nu, cov)).sum() * step**p
    assert abs(truncated - 1.0) > 1.0


@pytest.mark.parametrize("proposal", [PriorProposal(), EkfProposal()], ids=["prior", "ekf"])
def test_without_a_density_there_is_no_evidence(proposal):
    """Null, not a number that a comparison of models could mistake for one; the weights are still right."""
    motion = LinearMotion(np.eye(1), np.eye(1))
    model, z = LinearObservation(by_state=[[1.0]]), np.array([0.4])
    filter_ = Filter(motion, Scripted(), (), proposal, n=20, rng=np.random.default_rng(3))
    plain = filter_.step(Frame([single(z, 0.3, model)]))
    assert np.isfinite(plain.log_evidence)
    before = filter_.particles.log_weights
    report = filter_.step(Frame([single(z, 0.3, model, likelihood=TRUNCATED)]))
    assert np.isnan(report.log_evidence)
    assert np.isnan(filter_.log_evidence)
    if isinstance(proposal, PriorProposal) and not report.resampled:
        gained = before - 0.5 * np.minimum(4.0, (0.4 - filter_.particles.state[:, 0]) ** 2 / 0.3)
        np.testing.assert_allclose(filter_.particles.log_weights, gained - np.log(np.exp(gained).sum()), atol=1e-12)


def held_landmarks(cov: np.ndarray, n: int = 8) -> LandmarkMap:
    """Two landmarks that every particle believes at (3, 1) and (−2, 4)."""
    from rbpf.core.genealogy import Lineage

    held = LandmarkMap(PLANE)
    held.begin(n, Lineage(n))
    mean = np.tile(np.array([[3.0, 1.0], [-2.0, 4.0]]), (n, 1, 1))
    held.add_records(Records(mean, np.tile(cov, (n, 2, 1, 1))), Point(2))
    return held


LIKELIHOODS = {"gaussian": None, "truncated": TRUNCATED, "outliers": GaussianWithOutliers(0.1, 30.0)}


@pytest.mark.parametrize("likelihood", LIKELIHOODS.values(), ids=LIKELIHOODS)
def test_two_sightings_of_a_certain_landmark_weigh_like_two_landmarks(likelihood, rng):
    """A known landmark correlates nothing: stacking its rows must not change what each one says."""
    state = rng.normal(scale=0.3, size=(8, 2))
    certain = 1e-14 * np.eye(2)
    z = np.array([[3.2, 0.8], [2.9, 1.3]])
    R = np.array([np.diag([0.1, 0.2]), np.diag([0.05, 0.1])])
    twice = [Observations(z, R, Relative(), likelihood, np.array([0, 0]))]
    moved = z + np.array([[0.0, 0.0], [-5.0, 3.0]])
    once = [Observations(moved, R, Relative(), likelihood, np.array([0, 1]))]
    motion = LinearMotion(np.eye(2), 0.2 * np.eye(2))
    prior = Marginals(PLANE, []).predict(motion.transition(state, None, 1.0), PLANE, 1.0)
    zero = np.zeros((8, 2))
    densities = [held_landmarks(certain).correct(state, zero, groups).all for groups in (twice, once)]
    np.testing.assert_allclose(densities[0], densities[1], atol=1e-9)
    proposals = [refined(prior, held_landmarks(certain).information(state, groups, prior)) for groups in (twice, once)]
    np.testing.assert_allclose(proposals[0].mean, proposals[1].mean, atol=1e-9)
    np.testing.assert_allclose(proposals[0].log_w1, proposals[1].log_w1, atol=1e-9)


def looked_ahead(z: np.ndarray, likelihood: TruncatedMahalanobis, noise: float) -> float:
    """Log w₁ of measurements z (K,) of the first coordinate of a state N(0, 1)."""
    motion = LinearMotion(np.eye(1), np.eye(1))
    group = Observations(z[:, None], np.full((z.size, 1, 1), noise), LinearObservation(by_state=[[1.0]]), likelihood)
    parts = Marginals(motion.space, [])
    prior = parts.predict(motion.transition(np.zeros((1, 1)), None, 1.0), motion.space, 1.0)
    return float(EkfProposal().propose(prior, parts.linearised(prior, [group]), np.random.default_rng(0)).log_w1[0])


def integrated(z: np.ndarray, noise: float) -> float:
    """Log ∫ N(x; 0, 1) Π exp(−½ min(4, (z − x)²/R)) dx."""
    grid = np.linspace(-12.0, 12.0, 24_001)
    logs = -0.5 * np.minimum(4.0, (z[:, None] - grid) ** 2 / noise).sum(axis=0) - 0.5 * grid**2
    return float(np.log(np.trapezoid(np.exp(logs), grid) / np.sqrt(2.0 * np.pi)))


@pytest.mark.parametrize("noise", [0.1, 1.0, 10.0])
def test_the_look_ahead_weight_is_truncated_where_the_likelihood_is(noise):
    """The integral of the truncated likelihood over the prior is between w₁ and 2 w₁, at any distance."""
    far = np.linspace(0.0, 8.0, 81) * np.sqrt(1.0 + noise)
    for likelihood in (TRUNCATED, TruncatedMahalanobis(4.0, 16.3)):
        log_w1 = np.array([looked_ahead(np.array([z]), likelihood, noise) for z in far])
        exact = np.array([integrated(np.array([z]), noise) for z in far])
        assert (np.diff(log_w1) <= 1e-12).all()
        assert (log_w1 <= exact + 1e-9).all() and (exact <= log_w1 + np.log(2.0)).all()


def test_the_look_ahead_weight_of_several_rows_is_a_bound(rng):
    """Rows that agree, that contradict one another, and outliers: never above the integral, nor below all outliers."""
    for _ in range(300):
        z, noise = (rng.normal(scale=rng.choice([0.5, 2.0, 8.0]), size=rng.integers(1, 7)), 10.0 ** rng.normal())
        log_w1 = looked_ahead(z, TruncatedMahalanobis(4.0, 16.3), noise)
        assert -2.0 * z.size - 1e-12 <= log_w1 <= integrated(z, noise) + 1e-9


class Along(ObservationModel):
    """The landmark's first coordinate seen from one of the state's coordinates."""

    dim = 1

    def __init__(self, axis: int):
        self.axis = axis

    def predict(self, state, landmark=None, const=None, substate=None):
        return landmark[..., :1] - state[..., self.axis : self.axis + 1]


@pytest.mark.parametrize("likelihood", [None, GaussianWithOutliers(0.2, 24.0)], ids=["gaussian", "outliers"])
def test_the_density_of_two_sightings_of_an_uncertain_landmark_integrates_to_one(likelihood):
    """Particles on a grid span the innovations of both; each may be an outlier without the other."""
    side, points = 24.0, 121
    axis, step = np.linspace(-side / 2, side / 2, points, retstep=True)
    state = np.stack(np.meshgrid(axis + 3.0, axis + 3.0, indexing="ij"), axis=-1).reshape(-1, 2)
    held = held_landmarks(0.8 * np.eye(2), n=points**2)
    zero, R, ids = np.zeros((1, 1)), np.full((1, 1, 1), 0.4), np.array([0])
    groups = [Observations(zero, R, Along(axis), likelihood, ids) for axis in (0, 1)]
    densities = held.correct(state, np.zeros_like(state), groups)
    assert np.exp(densities.all).sum() * step**2 == pytest.approx(1.0, abs=0.02)
