"""Drivers of single steps against NumPy's ways to the same numbers."""

import numpy as np
import pytest

from rbpf import gaussian
from rbpf.core.likelihoods import Gaussian, GaussianWithOutliers, TruncatedMahalanobis
from rbpf.kernels import dense, forest
from rbpf.kernels.gate import is_inlier, log_likelihood


def covariances(rng, count, size):
    root = rng.normal(size=(count, size, size))
    return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(size)


LIKELIHOODS = [Gaussian(), TruncatedMahalanobis(), TruncatedMahalanobis(4.0, 9.0), GaussianWithOutliers(0.1, 20.0)]


@pytest.mark.parametrize("likelihood", LIKELIHOODS, ids=lambda one: f"{type(one).__name__} {one.params.tolist()}")
def test_a_likelihood_is_its_numpy_twin(likelihood, rng):
    """Of innovations within and far outside of their covariance."""
    nu, cov = rng.normal(size=(40, 2)) * np.repeat([0.1, 1.0, 3.0, 30.0], 10)[:, None], covariances(rng, 40, 2)
    chol = gaussian.cholesky(cov)
    squared, scale = np.square(gaussian.solve_lower(chol, nu)).sum(axis=-1), np.exp(-0.5 * gaussian.log_det(chol))
    lanes = [(likelihood.kernel_id, likelihood.params, *lane, 2) for lane in zip(squared, scale, strict=True)]
    np.testing.assert_allclose([log_likelihood(*lane) for lane in lanes], likelihood.log_density(nu, cov), rtol=1e-9)
    assert [bool(is_inlier(*lane)) for lane in lanes] == likelihood.inlier(nu, cov).tolist()


@pytest.mark.parametrize(("m", "k", "n"), [(3, 7, 5), (2, 4, 1), (1, 0, 2), (0, 3, 2)])
def test_a_product_is_numpys(m, k, n, rng):
    left, right = rng.normal(size=(m, k)), rng.normal(size=(k, n))
    np.testing.assert_allclose(dense.product(left, right), left @ right, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("count", [0, 3, 6])
def test_rows_that_read_few_columns_are_a_matrix(count, rng):
    """One row reads a column twice."""
    cov, slope, at = covariances(rng, 1, 9)[0], rng.normal(size=(count, 2)), rng.integers(0, 9, (count, 2))
    at[:1] = 4
    whole, before = np.einsum("rq,rqn->rn", slope, np.eye(9)[at]), cov.copy()
    rows, out = np.empty((count, 9)), np.eye(count)
    dense.gather(at, slope, cov, rows)
    np.testing.assert_allclose(rows, whole @ cov, rtol=1e-12, atol=1e-12)
    dense.add_inner(at, slope, rows, out)
    np.testing.assert_allclose(out, whole @ cov @ whole.T + np.eye(count), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(out, out.T)
    dense.add_gram(cov, rows, -1.0)
    np.testing.assert_allclose(np.tril(cov), np.tril(before - rows.T @ rows), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("count", [0, 7])
def test_what_rows_say_of_each_particle_is_numpys(count, rng):
    said, weight, turn = rng.normal(size=(count, 4, 9)), rng.normal(size=(count, 3)), rng.normal(size=(9, 3, 3))
    expected = np.concatenate([said[:, :1], said[:, 1:] + np.einsum("rb,nba->ran", weight, turn)], axis=1)
    dense.add_turned(said, weight, turn)
    np.testing.assert_allclose(said, expected, rtol=1e-12, atol=1e-12)
    info, vector, quad = np.empty((9, 3, 3)), np.empty((9, 3)), np.empty(9)
    dense.grams(said, info, vector, quad)
    gram = np.einsum("ran,rbn->nab", said, said)
    for found, whole in ((info, gram[:, 1:, 1:]), (vector, gram[:, 1:, 0]), (quad, gram[:, 0, 0])):
        np.testing.assert_allclose(found, whole, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shared", [1, 4])
def test_what_is_said_in_another_chart_is_numpys(shared, rng):
    """It is what turned rows say of what lies `offset` before."""
    rows, nu = rng.normal(size=(4, 8, 3)), rng.normal(size=(4, 8))
    turn, offset = rng.normal(size=(shared, 3, 3)), rng.normal(size=(shared, 3))
    info, vector = np.swapaxes(rows, 1, 2) @ rows, np.einsum("nra,nr->na", rows, nu)
    quad = np.square(nu).sum(axis=1)
    dense.chart(turn, offset, info, vector, quad)
    rows = rows @ turn
    nu = nu + np.einsum("nra,na->nr", rows, np.broadcast_to(offset, (4, 3)))
    np.testing.assert_allclose(info, np.swapaxes(rows, 1, 2) @ rows, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(vector, np.einsum("nra,nr->na", rows, nu), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(quad, np.square(nu).sum(axis=1), rtol=1e-11)


@pytest.mark.parametrize("shared", [1, 4])
@pytest.mark.parametrize("rank", [0, 2, 6])
def test_a_refined_gaussian_is_numpys(rank, shared, rng):
    """One that a model has spoilt is NaN, the others are as they are."""
    info, vector, root = covariances(rng, 4, 6), rng.normal(size=(4, 6)), rng.normal(size=(shared, 6, rank))
    mean, half, squared, log_det = np.empty((4, rank)), np.empty((4, rank, rank)), np.empty(4), np.empty(4)
    dense.refine(1, info, vector, root, mean, half, squared, log_det)
    turned = np.swapaxes(root, 1, 2)
    inside, ahead = np.eye(rank) + turned @ info @ root, turned @ vector[..., None]
    np.testing.assert_allclose(mean, np.linalg.solve(inside, ahead)[..., 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(half @ np.swapaxes(half, 1, 2), np.linalg.inv(inside), rtol=1e-9, atol=1e-12)
    assert not np.tril(half, -1).any()
    np.testing.assert_allclose(squared, (mean[:, None] @ ahead).ravel(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(inside)[1], rtol=1e-9, atol=1e-12)
    if rank:
        info[1] = np.nan
        dense.refine(1, info, vector, root, mean, half, squared, log_det)
        np.testing.assert_array_equal(np.isnan(log_det), [False, True, False, False])


@pytest.mark.parametrize(("means", "factors", "draws"), [(1, 1, 5), (5, 5, 5), (5, 1, 1), (1, 5, 1)])
def test_increments_and_their_densities_are_numpys(means, factors, draws, rng):
    mean, factor, u = rng.normal(size=(means, 3)), rng.normal(size=(factors, 3, 2)), rng.normal(size=(draws, 2))
    out, cov = np.empty((5, 3)), covariances(rng, 2, 3)
    dense.increments(mean, factor, u, out)
    np.testing.assert_allclose(out, mean + np.einsum("nar,nr->na", factor, u), rtol=1e-12, atol=1e-14)
    nu, chol, total = rng.normal(size=(5, 2, 3)), gaussian.cholesky(cov), np.ones(5)
    dense.log_densities(nu, chol, gaussian.log_det(chol), total)
    np.testing.assert_allclose(total, 1.0 + gaussian.log_density(nu, cov).sum(axis=1), rtol=1e-13)


def test_a_comb_counts_its_teeth(rng):
    """As many as lie before the end of each weight; none falls on a weight of zero."""
    weights, found = rng.exponential(size=50) * (rng.random(50) < 0.5), np.empty(50, dtype=np.int64)
    for weights[-1], offset in ((0.0, 0.0), (0.0, 0.7), (3.0, 0.3)):
        dense.comb(weights, offset, found)
        end = np.cumsum(weights) * (50 / weights.sum())
        np.testing.assert_array_equal(found, np.searchsorted(end, np.arange(50) + offset, side="right"))
        assert weights[found].all()


def test_the_forest_is_compiled_as_it_is_loaded():
    """Setting up filters nothing for long enough to call it: a user's first run would be told of compiling again."""
    assert not any(
        function._can_compile for function in (forest.advance, forest.rows_at, forest.splice, forest.survivors)
    )
