"""Resampling schemes: unbiased, and as regular as each promises to be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.particles import effective_sample_size, uniform_log_weights
from rbpf.core.resampling import EssTriggered, Multinomial, Residual, Stratified, Systematic
from rbpf.errors import InputError

SCHEMES = [Systematic(), Stratified(), Residual(), Multinomial()]
every_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: type(scheme).__name__)
DRAWS = 2000


def weight_vectors() -> st.SearchStrategy[np.ndarray]:
    """Normalised weights with zeros, equal ones and many orders of magnitude."""
    one = st.one_of(st.just(0.0), st.just(1.0), st.floats(-300.0, 0.0).map(lambda e: 10.0**e))
    return st.lists(one, min_size=1, max_size=40).filter(lambda w: sum(w) > 0).map(lambda w: np.array(w) / sum(w))


def counts(scheme, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.bincount(scheme.ancestors(weights, rng), minlength=weights.size)


@every_scheme
@pytest.mark.parametrize("concentration", [0.1, 1.0, 20.0])
@pytest.mark.parametrize("n", [2, 7, 50])
def test_expected_number_of_descendants(scheme, n, concentration):
    rng = np.random.default_rng(1)
    weights = rng.dirichlet(np.full(n, concentration))
    drawn = np.array([counts(scheme, weights, rng) for _ in range(DRAWS)])
    error = drawn.mean(axis=0) - n * weights
    # A multinomial count has the largest variance of all schemes, n w (1 - w); √(1/DRAWS) for rare ones.
    std = np.sqrt((n * weights * (1 - weights) + 1 / DRAWS) / DRAWS)
    # 177 values per scheme over all cases: every one stays below 4.5 with 99.9 %.
    assert (np.abs(error) < 4.5 * std).all()


@given(weight_vectors(), st.integers(0, 2**32 - 1))
def test_counts_are_as_regular_as_each_scheme_promises(weights, seed):
    expected = weights.size * weights
    systematic, residual, stratified = (
        counts(scheme, weights, np.random.default_rng(seed)) for scheme in (Systematic(), Residual(), Stratified())
    )
    assert (systematic >= np.floor(expected - 1e-9)).all() and (systematic <= np.ceil(expected + 1e-9)).all()
    # What is left over after rounding down is drawn: no more than the number of draws on top.
    left = weights.size - np.floor(expected).sum()
    assert (residual >= np.floor(expected)).all() and (residual <= np.floor(expected) + left).all()
    assert (np.abs(stratified - expected) < 2.0).all()


@every_scheme
@given(weights=weight_vectors(), seed=st.integers(0, 2**32 - 1))
def test_ancestors_are_ascending_and_alive(scheme, weights, seed):
    ancestors = scheme.ancestors(weights, np.random.default_rng(seed))
    assert ancestors.shape == weights.shape and ancestors.dtype.kind == "i"
    assert (np.diff(ancestors) >= 0).all() and (weights[ancestors] > 0).all()


class Extreme(np.random.Generator):
    """Draws the largest or the smallest numbers that there are."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(0))
        self.value = value

    def random(self, size=None, dtype=np.float64, out=None):
        return self.value if size is None else np.full(size, self.value)


@every_scheme
@pytest.mark.parametrize("value", [0.0, np.nextafter(1.0, 0.0)])
@pytest.mark.parametrize("weights", [[0, 1, 0], [0, 0.5, 0.5, 0], [0, 1e-300, 1, 1e-300, 0], [0] * 7 + [1.0]])
def test_zero_weights_have_no_descendants_at_the_ends_of_the_comb(scheme, weights, value):
    weights = np.array(weights, dtype=float)
    ancestors = scheme.ancestors(weights, Extreme(value))
    assert (weights[ancestors] > 0).all()


@pytest.mark.parametrize("scheme", [Systematic(), Stratified(), Residual()], ids=lambda scheme: type(scheme).__name__)
def test_equal_weights_keep_every_particle(scheme):
    rng = np.random.default_rng(3)
    for n in range(1, 400):
        weights = np.exp(uniform_log_weights(n))  # not exactly 1/n
        np.testing.assert_array_equal(scheme.ancestors(weights, rng), np.arange(n))


def test_triggered_below_its_threshold_it_hands_on_the_draw_of_its_scheme():
    weights = np.array([0.7, 0.1, 0.1, 0.1])
    fraction = effective_sample_size(weights) / 4
    rng = np.random.default_rng(5)
    assert EssTriggered(Systematic(), fraction - 1e-6).ancestors(weights, rng) is None
    # Nothing was drawn where it did not resample.
    drawn = EssTriggered(Stratified(), fraction + 1e-6).ancestors(weights, rng)
    np.testing.assert_array_equal(drawn, Stratified().ancestors(weights, np.random.default_rng(5)))
    assert EssTriggered(Systematic(), 0.0).ancestors(np.eye(5)[2], rng) is None


def test_a_threshold_of_one_resamples_whenever_weights_differ():
    rng = np.random.default_rng(0)
    for n in range(2, 300):
        weights = np.exp(uniform_log_weights(n))
        assert EssTriggered(Systematic(), 1.0).ancestors(weights, rng) is None
        weights[0] *= 1.01
        assert EssTriggered(Systematic(), 1.0).ancestors(weights / weights.sum(), rng) is not None


@pytest.mark.parametrize("threshold", [-0.1, 1.1, float("nan")])
def test_a_threshold_is_a_fraction(threshold):
    with pytest.raises(InputError, match="threshold must be at least 0 and at most 1, got"):
        EssTriggered(Systematic(), threshold)
