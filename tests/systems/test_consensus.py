"""The motion that most matches agree on."""

import numpy as np

from rbpf.systems.mono.consensus import fit_motion

ALL = np.ones(20, dtype=bool)


def matches(seed: int, count: int = 20) -> tuple[np.ndarray, ...]:
    """ν, H, S of matches of a motion ε drawn from its prior N(0, L Lᵀ), L, and ε."""
    rng = np.random.default_rng(seed)
    factor = np.diag([0.05, 0.05, 0.05, 0.1, 0.1, 0.1])
    motion = factor @ rng.standard_normal(6)
    jac = 100.0 * rng.standard_normal((count, 2, 6))
    nu = jac @ motion + rng.standard_normal((count, 2))
    return nu, jac, np.tile(np.eye(2), (count, 1, 1)), factor, motion


def test_without_outliers_it_is_near_the_posterior_of_a_linear_model():
    nu, jac, cov, factor, _ = matches(0)
    fit = fit_motion(nu, jac, cov, factor, ALL)
    rows, stacked = nu.ravel(), jac.reshape(-1, 6)
    info = np.linalg.inv(factor @ factor.T) + stacked.T @ stacked
    np.testing.assert_allclose(fit.increment, np.linalg.solve(info, stacked.T @ rows), atol=0.01)
    # The loss takes a little of every match's weight, so that it is never surer than the linear posterior.
    ratio = np.diag(fit.cov) / np.diag(np.linalg.inv(info))
    assert (ratio > 1.0).all() and (ratio < 2.5).all()


def test_outliers_stay_far_off_and_do_not_move_it():
    nu, jac, cov, factor, motion = matches(1)
    wrong = np.arange(20) < 6
    nu[wrong] += 25.0
    fit = fit_motion(nu, jac, cov, factor, ALL)
    assert (fit.squared[wrong] > 50.0).all() and (fit.squared[~wrong] < 15.0).all()
    assert (np.abs(fit.increment - motion) < 5.0 * np.sqrt(np.diag(fit.cov))).all()


def test_a_direction_without_noise_is_not_moved_along():
    nu, jac, cov, factor, _ = matches(2)
    fit = fit_motion(nu, jac, cov, factor[:, :4], ALL)
    assert not fit.increment[4:].any() and not fit.cov[4:].any()


def test_a_majority_that_is_not_trusted_is_judged_by_the_trusted_ones():
    """Twelve that move together, as on a thing that passes, against eight that are known to be at rest."""
    nu, jac, cov, factor, motion = matches(3)
    passing = np.arange(20) < 12
    nu[passing] += jac[passing] @ (factor @ np.array([2.0, -2.0, 2.0, 2.0, -2.0, 2.0]))
    fit = fit_motion(nu, jac, cov, factor, ~passing)
    assert (np.abs(fit.increment - motion) < 5.0 * np.sqrt(np.diag(fit.cov))).all()
    assert np.median(fit.squared[passing]) > 50.0 and (fit.squared[~passing] < 15.0).all()
    alone = fit_motion(nu[~passing], jac[~passing], cov[~passing], factor, ALL[:8])
    np.testing.assert_allclose(fit.increment, alone.increment)


def test_an_untrusted_match_is_as_far_off_as_its_own_uncertainty_says():
    """Mahalanobis distances of matches that took no part follow the chi-squared law."""
    squared = []
    for seed in range(60):
        nu, jac, cov, factor, _ = matches(seed)
        trusted = np.arange(20) < 15
        squared.append(fit_motion(nu, jac, cov, factor, trusted).squared[~trusted])
    assert abs(np.mean(squared) / 2.0 - 1.0) < 0.2
