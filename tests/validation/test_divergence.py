"""Distances between Gaussians against numeric integrals and their invariances."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from rbpf.validation.metrics.gaussian_differences import bhattacharyya, kullback_leibler, mahalanobis, sigma_ratio

RNG = np.random.default_rng(5)


def random_cov(count, dim):
    factor = RNG.normal(size=(count, dim, dim)) + 1.5 * np.eye(dim)
    return factor @ factor.mT


@pytest.mark.parametrize(("delta", "std_p", "std_q"), [(0.0, 1.0, 1.0), (0.7, 0.5, 1.2), (-1.3, 2.0, 0.8)])
def test_one_dimension_agrees_with_numeric_integrals(delta, std_p, std_q):
    p, q = norm(delta, std_p), norm(0.0, std_q)
    args = np.array([delta]), np.array([[std_p**2]]), np.array([[std_q**2]])
    kl, _ = quad(lambda x: p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), -30, 30, limit=200)
    overlap, _ = quad(lambda x: np.sqrt(p.pdf(x) * q.pdf(x)), -30, 30, limit=200)
    assert kullback_leibler(*args) == pytest.approx(kl, abs=1e-9)
    assert bhattacharyya(*args) == pytest.approx(-np.log(overlap), abs=1e-9)
    assert sigma_ratio(*args[1:]) == pytest.approx(std_p / std_q)
    assert mahalanobis(args[0], args[2]) == pytest.approx(abs(delta) / std_q)


def test_no_chart_matters_and_stacks_are_taken_one_by_one():
    delta, p, q = RNG.normal(size=(5, 4)), random_cov(5, 4), random_cov(5, 4)
    turn = random_cov(1, 4)[0] @ np.diag([1.0, 0.1, 3.0, 10.0])
    moved = delta @ turn.T, turn @ p @ turn.T, turn @ q @ turn.T
    for distance in (kullback_leibler, bhattacharyya):
        assert distance(*moved) == pytest.approx(distance(delta, p, q))
        assert distance(delta[2], p[2], q[2]) == pytest.approx(distance(delta, p, q)[2])
        assert distance(0 * delta, p, p) == pytest.approx(np.zeros(5), abs=1e-12)
    assert bhattacharyya(delta, p, q) == pytest.approx(bhattacharyya(-delta, q, p))
    assert sigma_ratio(9.0 * q, q) == pytest.approx(3.0 * np.ones(5))
