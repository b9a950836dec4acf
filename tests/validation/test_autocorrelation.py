import numpy as np
import pytest

from rbpf.validation.consistency.autocorrelation import correlation_time, degrees_of_freedom


def autoregressive(phi: float, steps: int, dim: int, rng: np.random.Generator) -> np.ndarray:
    """e_t = φ e_{t−1} + √(1−φ²) w_t, of unit variance from the start."""
    series = np.empty((steps, dim))
    series[0] = rng.normal(size=dim)
    for t in range(1, steps):
        series[t] = phi * series[t - 1] + np.sqrt(1.0 - phi**2) * rng.normal(size=dim)
    return series


def test_white_errors_count_in_full():
    rng = np.random.default_rng(0)
    assert degrees_of_freedom(rng.normal(size=(2000, 3))) == pytest.approx(6000, rel=0.05)


@pytest.mark.parametrize("phi", [0.5, 0.8, 0.95])
def test_squares_of_an_autoregressive_series_have_the_variance_that_the_degrees_of_freedom_say(phi):
    """The sum of squares has mean T d and variance 2 T d (1+φ²)/(1−φ²): ν = T d (1−φ²)/(1+φ²)."""
    rng = np.random.default_rng(1)
    exact = 3000 * 2 * (1 - phi**2) / (1 + phi**2)
    found = [degrees_of_freedom(autoregressive(phi, 3000, 2, rng)) for _ in range(8)]
    assert np.mean(found) == pytest.approx(exact, rel=0.15)


def test_an_error_that_never_changes_is_one_sample_per_direction():
    assert degrees_of_freedom(np.full((500, 1), 0.3)) == 1.0
    scale = np.random.default_rng(2).normal(size=(1, 1))
    assert degrees_of_freedom(np.tile(scale, (500, 1))) <= 1.5


def test_degrees_of_freedom_do_not_depend_on_the_errors_size():
    series = autoregressive(0.7, 400, 3, np.random.default_rng(3))
    assert degrees_of_freedom(100.0 * series) == pytest.approx(degrees_of_freedom(series))


@pytest.mark.parametrize("phi", [0.0, 0.6, 0.9])
def test_the_correlation_time_of_an_autoregressive_series(phi):
    """T Var(mean) / Var = (1+φ)/(1−φ)."""
    rng = np.random.default_rng(4)
    found = [correlation_time(autoregressive(phi, 4000, 1, rng)[:, 0]) for _ in range(6)]
    assert np.mean(found) == pytest.approx((1 + phi) / (1 - phi), rel=0.2)


def test_a_series_too_short_or_constant_has_no_correlation_time_of_its_own():
    assert correlation_time(np.array([1.0, 2.0])) == 1.0
    assert correlation_time(np.full(50, 2.0)) == 1.0
    assert correlation_time(np.zeros(0)) == 1.0
