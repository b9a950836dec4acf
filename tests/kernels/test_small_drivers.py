"""Drivers of single steps against NumPy's ways to the same numbers."""

import numpy as np
import pytest

from rbpf.kernels import forest
from rbpf.kernels.dense import add_gram, add_inner, gather, product, refine


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def covariances(rng, count, size):
    root = rng.normal(size=(count, size, size))
    return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(size)


@pytest.mark.parametrize(("m", "k", "n"), [(3, 7, 5), (2, 4, 1), (1, 0, 2), (0, 3, 2)])
def test_a_product_is_numpys(m, k, n, rng):
    left, right = rng.normal(size=(m, k)), rng.normal(size=(k, n))
    np.testing.assert_allclose(product(left, right), left @ right, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("count", [0, 3, 6])
def test_rows_that_read_few_columns_are_a_matrix(count, rng):
    """One row reads a column twice."""
    cov, slope, at = covariances(rng, 1, 9)[0], rng.normal(size=(count, 2)), rng.integers(0, 9, (count, 2))
    at[:1] = 4
    whole = np.einsum("rq,rqn->rn", slope, np.eye(9)[at])
    rows, out = np.empty((count, 9)), np.eye(count)
    gather(at, slope, cov, rows)
    np.testing.assert_allclose(rows, whole @ cov, rtol=1e-12, atol=1e-12)
    add_inner(at, slope, rows, out)
    np.testing.assert_allclose(out, whole @ cov @ whole.T + np.eye(count), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(out, out.T)
    add_gram(cov, rows, -1.0)
    expected = covariances(np.random.default_rng(4), 1, 9)[0] - rows.T @ rows
    np.testing.assert_allclose(np.tril(cov), np.tril(expected), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("shared", [1, 4])
@pytest.mark.parametrize("rank", [0, 2, 6])
def test_a_refined_gaussian_is_numpys(rank, shared, rng):
    """One that a model has spoilt is NaN, the others are as they are."""
    info, vector, root = covariances(rng, 4, 6), rng.normal(size=(4, 6)), rng.normal(size=(shared, 6, rank))
    mean, half, squared, log_det = np.empty((4, rank)), np.empty((4, rank, rank)), np.empty(4), np.empty(4)
    refine(info, vector, root, mean, half, squared, log_det)
    turned = np.swapaxes(root, 1, 2)
    inside, ahead = np.eye(rank) + turned @ info @ root, turned @ vector[..., None]
    np.testing.assert_allclose(mean, np.linalg.solve(inside, ahead)[..., 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(half @ np.swapaxes(half, 1, 2), np.linalg.inv(inside), rtol=1e-9, atol=1e-12)
    assert not np.tril(half, -1).any()
    np.testing.assert_allclose(squared, (mean[:, None] @ ahead).ravel(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(inside)[1], rtol=1e-9, atol=1e-12)
    if rank:
        info[1] = np.nan
        refine(info, vector, root, mean, half, squared, log_det)
        np.testing.assert_array_equal(np.isnan(log_det), [False, True, False, False])


def test_the_forest_is_compiled_as_it_is_loaded():
    """Setting up filters nothing for long enough to call it: a user's first run would be told of compiling again."""
    assert not any(function._can_compile for function in (forest.advance, forest.rows_at, forest.splice))
