"""Factors, densities, conditioning and the unscented transform of batched small Gaussians."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from rbpf import gaussian
from rbpf.errors import InputError

DIMENSIONS = [1, 2, 3, 6, 8, 9, 12]
every_dimension = pytest.mark.parametrize("n", DIMENSIONS)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20052)


def covariances(rng: np.random.Generator, shape: tuple[int, ...], n: int, rank: int | None = None) -> np.ndarray:
    """Random covariances, of full rank unless told otherwise."""
    half = rng.normal(size=(*shape, n, n + 2 if rank is None else rank))
    return gaussian.symmetrise(np.einsum("...ir,...jr->...ij", half, half))


def gram(factor: np.ndarray) -> np.ndarray:
    return np.einsum("...ir,...jr->...ij", factor, factor)


def least_eigenvalue(cov: np.ndarray) -> float:
    """Relative to the largest."""
    values = np.linalg.eigvalsh(cov)
    return float((values[..., 0] / values[..., -1]).min())


@every_dimension
@pytest.mark.parametrize("shape", [(), (3, 2), (0,)], ids=str)
def test_cholesky_equals_lapack(n, shape, rng):
    cov = covariances(rng, shape, n)
    chol = gaussian.cholesky(cov)
    np.testing.assert_allclose(chol, np.linalg.cholesky(cov), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(gaussian.log_det(chol), np.linalg.slogdet(cov)[1], atol=1e-10)


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


def test_samples_have_the_law_asked_for(rng):
    mean = np.array([[1.0, -2.0, 3.0], [0.0, 5.0, 0.0]])
    cov = covariances(rng, (2,), 3, rank=2)
    n = 40_000
    draws = gaussian.sample(mean, gaussian.psd_factor(cov), rng, (n,))
    assert draws.shape == (n, 2, 3)
    # Five standard errors of a mean, and of a variance of at most the largest.
    largest = np.abs(cov).max()
    np.testing.assert_allclose(draws.mean(0), mean, atol=5.0 * np.sqrt(largest / n))
    for k in range(2):
        np.testing.assert_allclose(np.cov(draws[:, k].T), cov[k], atol=5.0 * largest * np.sqrt(2.0 / n))
    assert abs(np.corrcoef(draws[:, 0, 0], draws[:, 1, 0])[0, 1]) < 5.0 / np.sqrt(n)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (6, 3), (6, 6)])
def test_condition_equals_the_textbook_formula(n, m, rng):
    joint = covariances(rng, (8,), n + m)
    aa, ab, bb = joint[:, :n, :n], joint[:, :n, n:], joint[:, n:, n:]
    mean, value = rng.normal(size=(2, 8, n + m))
    posterior = gaussian.condition(mean[:, :n], mean[:, n:], aa, ab, bb, value[:, n:])
    gain = ab @ np.linalg.inv(bb)
    expected = mean[:, :n] + np.einsum("bij,bj->bi", gain, value[:, n:] - mean[:, n:])
    np.testing.assert_allclose(posterior.mean, expected, atol=1e-9)
    np.testing.assert_allclose(posterior.cov, aa - gain @ np.swapaxes(ab, -1, -2), atol=1e-9)
    np.testing.assert_array_equal(posterior.cov, np.swapaxes(posterior.cov, -1, -2))


def test_condition_on_a_singular_quantity():
    # b is the first component of a, twice, and a constant.
    cov = np.array([[2.0, 0.6], [0.6, 1.0]])
    pick = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    posterior = gaussian.condition([0.0, 0.0], [0.0, 0.0, 7.0], cov, cov @ pick.T, pick @ cov @ pick.T, [3.0, 3.0, 7.0])
    np.testing.assert_allclose(posterior.mean, [3.0, 0.9], atol=1e-12)
    np.testing.assert_allclose(posterior.cov, [[0.0, 0.0], [0.0, 0.82]], atol=1e-12)


def test_condition_leaves_null_directions_out(rng):
    # Five readings of two numbers: what contradicts them all is not evidence about either.
    for _ in range(20):
        design, truth = rng.normal(size=(5, 2)), rng.normal(size=2)
        contradiction = np.linalg.svd(design / np.linalg.norm(design, axis=1, keepdims=True))[0][:, 2]
        reading = design @ truth + contradiction * np.linalg.norm(design, axis=1)
        posterior = gaussian.condition(np.zeros(2), np.zeros(5), np.eye(2), design.T, design @ design.T, reading)
        np.testing.assert_allclose(posterior.mean, truth, atol=1e-8)
        np.testing.assert_allclose(posterior.cov, np.zeros((2, 2)), atol=1e-12)


def test_covariance_stays_semidefinite_over_hundreds_of_updates(rng):
    mean, cov = np.zeros((5, 4)), np.broadcast_to(1e4 * np.eye(4), (5, 4, 4))
    for _ in range(300):
        row = rng.normal(size=(5, 1, 4))
        cross = cov @ np.swapaxes(row, -1, -2)
        innovation = row @ cross + 1e-6
        mean, cov = gaussian.condition(mean, np.zeros((5, 1)), cov, cross, innovation, np.zeros((5, 1)))
        assert least_eigenvalue(cov) > -1e-12
    assert np.isfinite(mean).all()
    assert 0.0 < np.trace(cov[0]) < 1e-7


@pytest.mark.parametrize("n", [1, 2, 3, 6, 12])
@pytest.mark.parametrize("kappa", [None, 0.0, 1.5])
def test_unscented_transform_is_exact_for_affine_maps(n, kappa, rng):
    linear, offset = rng.normal(size=(4, n)), rng.normal(size=4)
    for cov in (covariances(rng, (7,), n), covariances(rng, (7,), n, rank=max(1, n - 1)), np.zeros((7, n, n))):
        mean = rng.normal(size=(7, n))
        image = gaussian.unscented_transform(lambda x: x @ linear.T + offset, mean, cov, kappa)
        np.testing.assert_allclose(image.mean, mean @ linear.T + offset, atol=1e-11)
        np.testing.assert_allclose(image.cov, linear @ cov @ linear.T, atol=1e-10)
        np.testing.assert_allclose(image.cov_xy, cov @ linear.T, atol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_unscented_transform_of_a_square_has_its_moments(n):
    # E[x^2] = s^2 for any kappa; the variance 2 s^4 needs the matched fourth moment.
    cov = np.diag(np.arange(1.0, n + 1.0))
    image = gaussian.unscented_transform(lambda x: np.square(x[..., :1]), np.zeros(n), cov)
    np.testing.assert_allclose(image.mean, [1.0], rtol=1e-12)
    np.testing.assert_allclose(image.cov, [[2.0]], rtol=1e-12)


def test_unscented_transform_calls_its_function_with_points_first():
    shifts = np.array([[10.0], [20.0]])
    image = gaussian.unscented_transform(lambda x: x + shifts, np.zeros((2, 1)), np.ones((2, 1, 1)))
    np.testing.assert_allclose(image.mean, shifts, rtol=1e-12)
    with pytest.raises(InputError, match="kappa >= 0"):
        gaussian.unscented_transform(np.sin, np.zeros(4), np.eye(4), -1.0)


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
