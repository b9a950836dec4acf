"""Factors, densities and the unscented transform of batched small Gaussians."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from rbpf import gaussian
from rbpf.errors import InputError

DIMENSIONS = [1, 2, 3, 6, 8, 9, 12]
every_dimension = pytest.mark.parametrize("n", DIMENSIONS)


def covariances(rng: np.random.Generator, shape: tuple[int, ...], n: int, rank: int | None = None) -> np.ndarray:
    """Random covariances, of full rank unless told otherwise."""
    half = rng.normal(size=(*shape, n, n + 2 if rank is None else rank))
    return gaussian.symmetrise(np.einsum("...ir,...jr->...ij", half, half))


def gram(factor: np.ndarray) -> np.ndarray:
    return np.einsum("...ir,...jr->...ij", factor, factor)


@every_dimension
@pytest.mark.parametrize("shape", [(), (3, 2), (0,)], ids=str)
def test_cholesky_equals_lapack(n, shape, rng):
    cov = covariances(rng, shape, n)
    chol = gaussian.cholesky(cov)
    np.testing.assert_allclose(chol, np.linalg.cholesky(cov), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(gaussian.log_det(chol), np.linalg.slogdet(cov)[1], atol=1e-10)
    assert isinstance(gaussian.log_det(chol), float) == (shape == ())


@every_dimension
def test_cholesky_names_the_matrix_that_is_not_definite(n, rng):
    cov = covariances(rng, (4, 3), n)
    for broken in (-np.eye(n), np.zeros((n, n)), np.diag([np.nan] + [1.0] * (n - 1)), np.full((n, n), np.inf)):
        cov[2, 1] = broken
        with pytest.raises(InputError, match=r"Covariance \(2, 1\) of the batch is not positive definite"):
            gaussian.cholesky(cov)
    with pytest.raises(InputError, match="The covariance is not positive definite"):
        gaussian.cholesky(-np.eye(n))


@every_dimension
def test_triangular_solves_and_inverse(n, rng):
    cov = covariances(rng, (20,), n)
    chol = gaussian.cholesky(cov)
    vector, matrix = rng.normal(size=(20, n)), rng.normal(size=(20, n, 4))
    solved = gaussian.solve_lower(chol, vector)
    np.testing.assert_allclose(np.einsum("bij,bj->bi", chol, solved), vector, atol=1e-10)
    np.testing.assert_allclose(chol @ gaussian.solve_lower_matrix(chol, matrix), matrix, atol=1e-10)
    inverse = gaussian.inverse(cov)
    np.testing.assert_array_equal(inverse, np.swapaxes(inverse, -1, -2))
    np.testing.assert_allclose(inverse @ cov, np.broadcast_to(np.eye(n), cov.shape), atol=1e-9)
    large = covariances(rng, (), 5 * n)
    np.testing.assert_allclose(gaussian.inverse(large) @ large, np.eye(5 * n), atol=1e-9)


@every_dimension
def test_semidefinite_factor_of_every_rank(n, rng):
    for rank in range(n + 1):
        cov = covariances(rng, (10,), n, rank)
        factor = gaussian.psd_factor(cov)
        np.testing.assert_allclose(gram(factor), cov, rtol=0.0, atol=1e-12 * max(1.0, np.abs(cov).max()))
    definite = covariances(rng, (10,), n)
    np.testing.assert_allclose(gaussian.psd_factor(definite), np.linalg.cholesky(definite), atol=1e-10)


def test_semidefinite_factor_keeps_the_digits_of_small_units():
    # A standard deviation of 1e-7 rad, fully correlated with one of 1e3 m, beside a quantity that is certain.
    factor = gaussian.psd_factor([[1e-14, 1e-4, 0.0], [1e-4, 1e6, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(gram(factor)[:2, :2], [[1e-14, 1e-4], [1e-4, 1e6]], rtol=1e-12)
    np.testing.assert_array_equal(factor[2], np.zeros(3))


@pytest.mark.parametrize(
    "cov",
    [
        [[1.0, 1.0 + 1e-12], [1.0 + 1e-12, 1.0]],
        [[-1e-12, 0.0], [0.0, 1.0]],
        [[0.0, 1e-11], [1e-11, 1.0]],
        [[1e-30, 1e-11], [1e-11, 1.0]],
        [[1e-320, 1e-200], [1e-200, 1.0]],
        [[1.0, 0.5], [0.5 + 1e-12, 1.0]],
    ],
)
def test_semidefinite_factor_forgives_rounding(cov):
    with np.errstate(all="raise", under="ignore"):
        factor = gaussian.psd_factor(cov)
    np.testing.assert_allclose(gram(factor), cov, rtol=0.0, atol=1e-10)


def test_semidefinite_factor_refuses_what_is_no_covariance(rng):
    cov = covariances(rng, (3,), 2)
    cov[1] = [[1.0, 2.0], [2.0, 1.0]]
    with pytest.raises(InputError, match=r"Covariance \(1,\) of the batch has a negative eigenvalue"):
        gaussian.psd_factor(cov)
    for value in (np.nan, np.inf):
        with pytest.raises(InputError, match="not finite"):
            gaussian.psd_factor([[1.0, value], [value, 1.0]])
    with pytest.raises(InputError, match="not symmetric"):
        gaussian.psd_factor([[1.0, 0.5], [0.4, 1.0]])


@every_dimension
def test_log_density_equals_scipy(n, rng):
    cov, residual = covariances(rng, (6,), n), rng.normal(size=(6, n))
    expected = [multivariate_normal(np.zeros(n), c).logpdf(r) for c, r in zip(cov, residual, strict=True)]
    np.testing.assert_allclose(gaussian.log_density(residual, cov), expected, rtol=1e-10)
    assert gaussian.log_density(residual[:, None], cov[0]).shape == (6, 1)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 12])
def test_unscented_transform_is_exact_for_affine_maps(n, rng):
    linear, offset = rng.normal(size=(4, n)), rng.normal(size=4)
    for cov in (covariances(rng, (7,), n), covariances(rng, (7,), n, rank=max(1, n - 1)), np.zeros((7, n, n))):
        mean = rng.normal(size=(7, n))
        found_mean, found_cov = gaussian.unscented_transform(lambda x: x @ linear.T + offset, mean, cov)
        np.testing.assert_allclose(found_mean, mean @ linear.T + offset, atol=1e-11)
        np.testing.assert_allclose(found_cov, linear @ cov @ linear.T, atol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_unscented_transform_of_a_square_has_its_moments(n):
    # E[x^2] = s^2 for any kappa; the variance 2 s^4 needs the matched fourth moment.
    cov = np.diag(np.arange(1.0, n + 1.0))
    mean, variance = gaussian.unscented_transform(lambda x: np.square(x[..., :1]), np.zeros(n), cov)
    np.testing.assert_allclose(mean, [1.0], rtol=1e-12)
    np.testing.assert_allclose(variance, [[2.0]], rtol=1e-12)


def test_unscented_transform_calls_its_function_with_points_first():
    shifts = np.array([[10.0], [20.0]])
    mean, _ = gaussian.unscented_transform(lambda x: x + shifts, np.zeros((2, 1)), np.ones((2, 1, 1)))
    np.testing.assert_allclose(mean, shifts, rtol=1e-12)


def test_pack_goes_row_by_row_through_the_lower_triangle(rng):
    cov = covariances(rng, (4, 2), 3)
    packed = gaussian.pack(cov)
    rows, columns = [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]
    np.testing.assert_array_equal(packed, cov[..., rows, columns])
    np.testing.assert_array_equal(gaussian.unpack(packed, 3), cov)
    with pytest.raises(InputError, match="has 3 entries, got 6"):
        gaussian.unpack(packed, 2)


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(-8, 8), st.booleans())
def test_any_scaled_covariance_has_a_factor(seed, n, exponent, singular):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** (exponent * rng.uniform(0.0, 1.0, n))
    cov = covariances(rng, (3,), n, rank=max(1, n - 1) if singular else None) * np.outer(scale, scale)
    error = (gram(gaussian.psd_factor(cov)) - cov) / np.outer(scale, scale)
    assert np.abs(error).max() < 1e-10
