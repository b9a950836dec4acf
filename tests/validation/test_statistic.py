"""Statistics of errors and distances between Gaussians: what they are worth, and what follows from them."""

import json

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, norm

from rbpf.validation.consistency.statistic import (
    Statistic,
    coverage,
    degrees_of_freedom,
    map_ratio,
    motion_statistics,
    posterior_ratio,
    step_ratio,
    variance_ratio,
)
from rbpf.validation.metrics.gaussian_differences import kullback_leibler, mahalanobis, sigma_ratio


def test_the_interval_of_a_ratio_holds_the_true_one_in_95_of_100_cases():
    rng = np.random.default_rng(0)
    hits = 0
    for value in 2.5 * rng.chisquare(12, size=2000) / 12:
        found = variance_ratio("", float(value), 12.0, 2.0)
        hits += found.low <= 2.5 <= found.high
    assert hits / 2000 == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize(
    ("value", "dof", "outcome"),
    [
        (1.0, 40, "supports"),
        (9.0, 40, "contradicts"),
        (1 / 9, 40, "contradicts"),
        (1.0, 2, "leaves open"),
        (4.0, 9, "leaves open"),
    ],
)
def test_what_a_ratio_says_depends_on_how_much_it_rests_on(value, dof, outcome):
    assert variance_ratio("", value, dof, 2.0).outcome == outcome


def test_innovations_of_an_honest_filter_are_supported_whatever_their_number_per_step():
    rng = np.random.default_rng(1)
    dofs = rng.integers(0, 12, size=1500).astype(float)
    squares = np.where(dofs > 0, rng.chisquare(np.maximum(dofs, 1)), np.nan)
    found = step_ratio("innovations", squares, dofs)
    assert found is not None
    assert found.outcome == "supports"
    assert found.samples == pytest.approx(dofs.sum(), rel=0.2)
    wide = step_ratio("innovations", 1.5 * squares, dofs)
    assert wide is not None
    assert wide.outcome == "contradicts"


def corrections(steps: int, bias: np.ndarray, scale: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """û = K (b + s w) + noise of the measurements, of a filter that expects N(0, K), K = I − M⁻¹."""
    info = rng.uniform(0.2, 5.0, size=(steps, 3, 1)) * np.eye(3)
    gain = info / (1.0 + info + 1e-300)
    gain = np.where(np.eye(3, dtype=bool), gain, 0.0)
    motion = bias + scale * rng.normal(size=(steps, 3))
    measured = motion + rng.normal(size=(steps, 3)) / np.sqrt(np.einsum("taa->ta", info))
    return np.einsum("tab,tb->ta", gain, measured), gain


def test_corrections_of_an_honest_motion_are_supported_and_a_bias_is_found_and_measured():
    size, bias = motion_statistics(*corrections(600, np.zeros(3), 1.0, np.random.default_rng(3)))
    assert size.outcome == "supports"
    assert bias.outcome != "contradicts"
    assert bias.low < 0.1
    true = np.array([0.0, 0.8, 0.0])
    _, bias = motion_statistics(*corrections(300, true, 1.0, np.random.default_rng(4)))
    assert bias.outcome == "contradicts"
    assert bias.low < 0.8 < bias.high
    assert bias.value == pytest.approx(0.8, abs=0.15)


def test_coverage_of_an_honest_filter_and_of_a_confident_one():
    nees = np.random.default_rng(6).chisquare(3, size=4000)
    honest = coverage(nees, 3, 400.0)
    assert [s.value for s in honest] == pytest.approx([0.5, 0.9, 0.95], abs=0.03)
    assert {s.outcome for s in honest} == {"supports"}
    confident = coverage(9.0 * nees, 3, 400.0)
    expected = chi2.cdf(chi2.ppf([0.5, 0.9, 0.95], 3) / 9.0, 3)
    assert [s.value for s in confident] == pytest.approx(expected, abs=0.03)
    assert {s.outcome for s in confident} == {"contradicts"}


def test_a_statistic_survives_json():
    bias = Statistic("bias", 0.3, 0.0, np.inf, (-np.inf, 0.25), 20.0, "bias")
    for statistic in (bias, variance_ratio("ratio", 1.2, 7.5, 2.0)):
        assert Statistic.of_entries(json.loads(json.dumps(statistic.entries(), allow_nan=False))) == statistic


def autoregressive(phi: float, steps: int, dim: int, rng: np.random.Generator) -> np.ndarray:
    """e_t = φ e_{t−1} + √(1−φ²) w_t, of unit variance from the start."""
    series = np.empty((steps, dim))
    series[0] = rng.normal(size=dim)
    for t in range(1, steps):
        series[t] = phi * series[t - 1] + np.sqrt(1.0 - phi**2) * rng.normal(size=dim)
    return series


@pytest.mark.parametrize("phi", [0.0, 0.8, 0.95])
def test_squares_of_an_autoregressive_series_have_the_variance_that_the_degrees_of_freedom_say(phi):
    """The sum of squares has mean T d and variance 2 T d (1+φ²)/(1−φ²): ν = T d (1−φ²)/(1+φ²)."""
    rng = np.random.default_rng(1)
    exact = 3000 * 2 * (1 - phi**2) / (1 + phi**2)
    found = [degrees_of_freedom(autoregressive(phi, 3000, 2, rng)) for _ in range(8)]
    assert np.mean(found) == pytest.approx(exact, rel=0.15)


def test_a_filter_that_is_exact_is_what_the_posterior_expects():
    """A random walk with fixes: the Kalman filter's online estimates beside the smoother's of all fixes."""
    rng, steps = np.random.default_rng(0), 400
    truth = np.cumsum(rng.normal(size=steps))
    fixes = truth + rng.normal(size=steps)
    mean, var = np.zeros(steps), np.zeros(steps)
    before, spread = 0.0, 0.0
    for t in range(steps):
        prior = spread + 1.0
        gain = prior / (prior + 1.0)
        before, spread = before + gain * (fixes[t] - before), (1.0 - gain) * prior
        mean[t], var[t] = before, spread
    smooth, smooth_var = mean.copy(), var.copy()
    for t in range(steps - 2, -1, -1):
        gain = var[t] / (var[t] + 1.0)
        smooth[t] += gain * (smooth[t + 1] - mean[t])
        smooth_var[t] += gain**2 * (smooth_var[t + 1] - var[t] - 1.0)
    posterior, delta = smooth_var[:, None, None], (smooth - mean)[:, None]
    for factor, outcome in ((1.0, "supports"), (1 / 9, "contradicts"), (9.0, "contradicts")):
        found = posterior_ratio("x", factor * var[:, None, None], posterior, delta)
        assert found.value == pytest.approx(1.0 / factor, rel=0.1)
        assert found.outcome == outcome
    last = posterior_ratio("x", var[-1:, None, None], posterior[-1:], delta[-1:], same_data=True)
    assert last.low == last.value == last.high == pytest.approx(1.0)
    assert posterior_ratio("x", np.zeros((3, 2, 2)), np.zeros((3, 2, 2)), np.ones((3, 2))) is None


def test_a_map_that_is_turned_is_one_error_however_many_landmarks_it_has():
    rng = np.random.default_rng(1)
    places = rng.uniform(-5.0, 5.0, size=(200, 2))
    turned = 0.3 * places[:, ::-1] * [1.0, -1.0]
    own = rng.normal(size=(200, 2))
    assert map_ratio("x", places, turned).samples == pytest.approx(6.0, rel=0.01)
    assert map_ratio("x", places, own).samples > 300.0
    assert map_ratio("x", places, 3.0 * own).outcome == "contradicts"
    assert map_ratio("x", places, own).outcome == "supports"
    assert map_ratio("x", places, 2.0 * turned + 0.1 * own).outcome == "leaves open"


RNG = np.random.default_rng(5)


def random_cov(count, dim):
    factor = RNG.normal(size=(count, dim, dim)) + 1.5 * np.eye(dim)
    return factor @ factor.mT


@pytest.mark.parametrize(("delta", "std_p", "std_q"), [(0.0, 1.0, 1.0), (0.7, 0.5, 1.2), (-1.3, 2.0, 0.8)])
def test_one_dimension_agrees_with_numeric_integrals(delta, std_p, std_q):
    p, q = norm(delta, std_p), norm(0.0, std_q)
    args = np.array([delta]), np.array([[std_p**2]]), np.array([[std_q**2]])
    kl, _ = quad(lambda x: p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), -30, 30, limit=200)
    assert kullback_leibler(*args) == pytest.approx(kl, abs=1e-9)
    assert sigma_ratio(*args[1:]) == pytest.approx(std_p / std_q)
    assert mahalanobis(args[0], args[2]) == pytest.approx(abs(delta) / std_q)


def test_no_chart_matters_and_stacks_are_taken_one_by_one():
    delta, p, q = RNG.normal(size=(5, 4)), random_cov(5, 4), random_cov(5, 4)
    turn = random_cov(1, 4)[0] @ np.diag([1.0, 0.1, 3.0, 10.0])
    moved = delta @ turn.T, turn @ p @ turn.T, turn @ q @ turn.T
    assert kullback_leibler(*moved) == pytest.approx(kullback_leibler(delta, p, q))
    assert kullback_leibler(delta[2], p[2], q[2]) == pytest.approx(kullback_leibler(delta, p, q)[2])
    assert kullback_leibler(0 * delta, p, p) == pytest.approx(np.zeros(5), abs=1e-12)
    assert sigma_ratio(9.0 * q, q) == pytest.approx(3.0 * np.ones(5))
