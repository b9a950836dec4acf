"""Least squares: closed forms, SciPy, a manifold, undetermined directions, and what is refused."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from rbpf.errors import InputError
from rbpf.lie import SE3, skew
from rbpf.motion.least_squares import Rule, minimise

TIMES = np.linspace(0.0, 4.0, 40)
STRICT = Rule(offset=1e-9)


def decay(x):
    """Residuals of an exponential with an offset, and their derivative."""
    noise = 0.05 * np.sin(37.0 * TIMES)
    shape = np.exp(-x[1] * TIMES)
    truth = 2.0 * np.exp(-0.7 * TIMES) + 0.3 + noise
    return x[0] * shape + x[2] - truth, np.stack([shape, -x[0] * TIMES * shape, np.ones(40)], axis=1)


def rosenbrock(x):
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]), np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])


@pytest.mark.parametrize(("function", "start"), [(decay, [1.0, 0.1, 0.0]), (rosenbrock, [-1.2, 1.0])])
def test_the_minimum_is_scipys(function, start):
    ours = minimise(function, np.array(start), np.add, STRICT)
    theirs = least_squares(lambda x: function(x)[0], start, lambda x: function(x)[1], xtol=1e-15, ftol=1e-15)
    assert ours.converged
    np.testing.assert_allclose(ours.x, theirs.x, rtol=1e-7)
    np.testing.assert_allclose(ours.squared, 2.0 * theirs.cost, atol=1e-12)
    np.testing.assert_allclose(ours.cov, np.linalg.inv(theirs.jac.T @ theirs.jac), rtol=1e-5)


def test_a_linear_problem_takes_one_step_without_damping():
    rng = np.random.default_rng(1)
    jac, b = rng.normal(size=(12, 4)), rng.normal(size=12)
    found = minimise(lambda x: (jac @ x - b, jac), np.zeros(4), np.add, Rule(damping=0.0))
    assert (found.iterations, found.converged) == (1, True)
    np.testing.assert_allclose(found.x, np.linalg.lstsq(jac, b, rcond=None)[0], rtol=1e-9)
    np.testing.assert_allclose(found.cov, np.linalg.inv(jac.T @ jac), rtol=1e-9)
    np.testing.assert_allclose(found.factor @ found.factor.T, found.cov)


def test_on_a_manifold():
    """Aligning points, beside SciPy in the tangent space of the truth."""
    rng = np.random.default_rng(2)
    truth = SE3.exp(np.array([2.0, -1.0, 0.5, 3.0, -4.0, 5.0]))
    points = rng.normal(size=(9, 3))
    seen = SE3.transform(truth, points) + 0.1 * rng.normal(size=(9, 3))

    def function(x):
        miss = (SE3.transform(x, points) - seen).ravel()
        turned = SE3.rotation(x) @ np.concatenate([-skew(points), np.tile(np.eye(3), (9, 1, 1))], axis=-1)
        return miss, turned.reshape(-1, 6)

    ours = minimise(function, SE3.identity(), SE3.retract, STRICT)
    theirs = least_squares(lambda xi: function(SE3.retract(truth, xi))[0], np.zeros(6), xtol=1e-15, ftol=1e-15)
    np.testing.assert_allclose(SE3.local(truth, ours.x), theirs.x, atol=1e-7)


def test_an_undetermined_direction_has_an_enormous_finite_variance():
    jac = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
    found = minimise(lambda x: (jac @ x - [1.0, 1.0, 3.0], jac), np.zeros(3), np.add)
    assert found.converged
    np.testing.assert_allclose(jac @ found.x, jac @ np.linalg.pinv(jac) @ [1.0, 1.0, 3.0], atol=1e-6)
    assert np.isfinite(found.cov).all()
    assert np.array([1.0, -1.0, 0.0]) @ found.cov @ np.array([1.0, -1.0, 0.0]) > 1e11
    np.testing.assert_allclose(found.cov[2, 2], 1.0 / 9.0)


def test_a_step_to_where_nothing_is_defined_is_taken_back():
    """The logarithm's first full step from 5 goes below zero."""

    def function(x):
        return (np.log(x), 1.0 / x[:, None]) if x[0] > 0.0 else (np.array([np.inf]), np.ones((1, 1)))

    found = minimise(function, np.array([5.0]), np.add, STRICT)
    assert found.converged
    np.testing.assert_allclose(found.x, 1.0, atol=1e-9)


def test_too_few_iterations_are_said():
    found = minimise(rosenbrock, np.array([-1.2, 1.0]), np.add, Rule(iterations=3))
    assert (found.iterations, found.converged) == (3, False)


@pytest.mark.parametrize(
    ("residual", "jac", "message"),
    [
        (np.ones(2), np.ones((2, 3)), "needs as many residuals as unknowns, got 2 and 3"),
        (np.array([1.0, np.nan]), np.ones((2, 1)), "not finite at the start"),
        (np.ones(2), np.full((2, 1), np.inf), "not finite at the start"),
        (np.ones(2), np.zeros((2, 1)), "do not depend on the unknowns"),
    ],
)
def test_what_cannot_be_solved_is_refused(residual, jac, message):
    with pytest.raises(InputError, match=message):
        minimise(lambda x: (residual, jac), np.zeros(jac.shape[1]), np.add)
