"""Drivers of single steps and fits against NumPy's and SciPy's ways to the same numbers."""

import numpy as np
import pytest

from rbpf.kernels import forest
from rbpf.kernels.dense import add_gram, add_inner, gather, product
from rbpf.kernels.increment import are_sound, conditioned
from rbpf.kernels.rigid_fit import rigid_fit
from rbpf.kernels.robust_fit import robust_fit
from rbpf.lie import SE3


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def covariances(rng, count, size):
    root = rng.normal(size=(count, size, size))
    return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(size)


@pytest.mark.parametrize("laws", [1, 5])
def test_a_substate_given_the_increment_is_the_schur_complement(laws, rng):
    d, m = 4, 3
    stack, noise = rng.normal(size=(1, d + m, m)), rng.normal(size=(1, d + m, d + m))
    cov = covariances(rng, laws, m)
    joint, factor = np.empty((laws, d + m, d + m)), np.empty((laws, d, d))
    gain, rest = np.empty((laws, m, d)), np.empty((laws, m, m))
    assert conditioned(stack, cov, noise, joint, factor, gain, rest)
    expected = stack @ cov @ np.swapaxes(stack, -1, -2) + noise @ np.swapaxes(noise, -1, -2)
    ee, se, ss = expected[:, :d, :d], expected[:, d:, :d], expected[:, d:, d:]
    np.testing.assert_allclose(joint, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(factor, np.linalg.cholesky(ee), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(gain, se @ np.linalg.inv(ee), rtol=1e-9, atol=1e-9)
    schur = ss - se @ np.linalg.inv(ee) @ np.swapaxes(se, -1, -2)
    np.testing.assert_allclose(rest, schur, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(rest, np.swapaxes(rest, -1, -2))


@pytest.mark.parametrize("worst", [0.0, np.nan])
def test_an_increment_without_noise_is_told(worst):
    stack, cov = np.zeros((1, 3, 1)), np.ones((1, 1, 1))
    noise = np.diag([1.0, worst, 1.0])[None]
    arrays = np.empty((1, 3, 3)), np.empty((1, 2, 2)), np.empty((1, 1, 2)), np.empty((1, 1, 1))
    assert not conditioned(stack, cov, noise, *arrays)


def iterated(nu, jac, cov, factor, rounds, scale):
    """The same fit, written with NumPy's solver and inverse."""
    chol = np.linalg.cholesky(cov)
    white_nu = np.linalg.solve(chol, nu[..., None])[..., 0]
    white_jac = np.linalg.solve(chol, jac @ factor)
    squared = np.square(white_nu).sum(axis=-1)
    for _ in range(rounds):
        weight = 1.0 / (1.0 + squared / scale**2)
        info = np.eye(factor.shape[1]) + np.einsum("k,kpa,kpb->ab", weight, white_jac, white_jac)
        u = np.linalg.solve(info, np.einsum("k,kpa,kp->a", weight, white_jac, white_nu))
        squared = np.square(white_nu - white_jac @ u).sum(axis=-1)
    return squared, u, info


def test_robust_fit_equals_numpys_and_leaves_the_outliers_far_off(rng):
    count, d = 20, 6
    jac, cov = rng.normal(size=(count, 2, d)), covariances(rng, count, 2)
    factor, truth = np.tril(rng.normal(size=(d, d))), rng.normal(size=d)
    nu = (jac @ factor) @ truth + 0.01 * rng.normal(size=(count, 2))
    nu[:4] += 30.0
    squared, u, chol = np.empty(count), np.empty(d), np.empty((d, d))
    robust_fit(nu, jac, cov, factor, 10, 2.0, squared, u, chol)
    expected, fit, info = iterated(nu, jac, cov, factor, 10, 2.0)
    np.testing.assert_allclose(squared, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(u, fit, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.tril(chol) @ np.tril(chol).T, info, rtol=1e-9, atol=1e-9)
    assert squared[:4].min() > 9.2 > squared[4:].max()


def test_soundness(rng):
    z, cov = rng.normal(size=(5, 3)), covariances(rng, 5, 3)
    cov = 0.5 * (cov + np.swapaxes(cov, -1, -2))
    assert are_sound(z, cov)
    assert are_sound(z[:0], cov[:0])
    for spoil in (np.nan, np.inf):
        bad = z.copy()
        bad[4, 2] = spoil
        assert not are_sound(bad, cov)
    for place, value in (((2, 0, 1), 9.0), ((2, 1, 1), -1.0), ((2, 2, 2), np.nan), ((0, 0, 0), 0.0)):
        bad = cov.copy()
        bad[place] = value
        assert not are_sound(z, bad)


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


def test_the_forest_is_compiled_as_it_is_loaded():
    """Setting up filters nothing for long enough to call it: a user's first run would be told of compiling again."""
    assert not any(function._can_compile for function in (forest.advance, forest.rows_at, forest.splice))


ROUNDS, SETTLED = 20, 1e-10


def twin(world, cov, shape, weight, start):
    """Frame, its derivative by the points, its covariance given them, and that of all."""
    frame = np.repeat(start, len(world), axis=0)
    for _ in range(ROUNDS):
        local = SE3.inverse_transform(frame[:, None], world)
        moved = -SE3.transform_jacobian(local)
        weighed = np.swapaxes(moved, -1, -2) @ weight
        info = (weighed @ moved).sum(axis=1)
        vector = (weighed @ (local - shape)[..., None]).sum(axis=1)
        step = -np.linalg.solve(info, vector)[..., 0]
        frame = SE3.retract(frame, step)
        if np.abs(step).max() <= SETTLED:
            break
    back = np.swapaxes(SE3.rotation(frame), -1, -2)
    by_point = -np.linalg.solve(info[:, None], weighed @ back[:, None])
    slope = np.moveaxis(by_point, 1, 2).reshape(len(frame), 6, -1)
    left = np.linalg.inv(info)
    return frame, slope, left, slope @ cov @ np.swapaxes(slope, -1, -2) + left


@pytest.mark.parametrize("flat", [False, True], ids=["in space", "in a plane"])
@pytest.mark.parametrize("apart", [1e-3, 0.5])
def test_equals_numpys(apart, flat):
    rng, n, m = np.random.default_rng(3), 9, 5
    shape = rng.normal(size=(m, 3)) * ([1.0, 1.0, 0.0] if flat else [1.0, 1.0, 1.0])
    root = rng.normal(scale=0.01, size=(m, 3, 4))
    weight = np.linalg.inv(root @ np.swapaxes(root, -1, -2))
    start = SE3.exp(np.array([[0.4, -0.8, 1.2, 2.0, -1.0, 0.5]]))
    frames = SE3.retract(start, rng.normal(scale=apart, size=(n, 6)))
    world = SE3.transform(frames[:, None], shape + rng.normal(scale=0.02, size=(n, m, 3)))
    half = rng.normal(scale=0.003, size=(n, 3 * m, 20))
    cov = half @ np.swapaxes(half, -1, -2)
    found = (np.empty((n, 7)), np.empty((n, 6, 3 * m)), np.empty((n, 6, 6)), np.empty((n, 6, 6)))
    rigid_fit(world, cov, shape, weight, start, ROUNDS, SETTLED, *found)
    for part, expected in zip(found, twin(world, cov, shape, weight, start), strict=True):
        scale = np.abs(expected).max()
        np.testing.assert_allclose(part / scale, expected / scale, rtol=0.0, atol=1e-8)
    for covs in found[2:]:
        np.testing.assert_array_equal(covs, np.swapaxes(covs, -1, -2))
