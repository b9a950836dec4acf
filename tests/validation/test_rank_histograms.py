"""Ranks are uniform for an exact posterior, and say what is wrong with another."""

import numpy as np
import pytest

from examples.studies.rank_histograms import calibrate
from rbpf.core.filter import Filter
from rbpf.errors import InputError
from tests.validation.fixes import Receiver, Walk

FIXES = 4


def simulate(rng):
    """A place from N(0, 1), and fixes of it with noise 1."""
    place = rng.normal(size=2)
    return place, place + rng.normal(size=(FIXES, 2))


def exact(scale: float = 1.0, shift: float = 0.0, weighted: bool = False):
    """Samples of the posterior N(Σz / (n+1), 1/(n+1)); spoilt on demand."""

    def infer(fixes, rng):
        std = scale / np.sqrt(FIXES + 1)
        mean = fixes.sum(axis=0) / (FIXES + 1) + shift
        if not weighted:
            return mean + std * rng.normal(size=(100, 2)), np.ones(100)
        wide = 1.5 * std
        samples = mean + wide * rng.normal(size=(2000, 2))
        off = np.square(samples - mean).sum(axis=1)
        return samples, np.exp(-0.5 * off / std**2 + 0.5 * off / wide**2)

    return infer


@pytest.mark.parametrize("weighted", [False, True])
def test_an_exact_posterior_is_flat(weighted):
    found = calibrate(simulate, exact(weighted=weighted), ("x", "y"), runs=600)
    assert found.histogram().sum(axis=0).tolist() == [600, 600]
    assert (found.p_values() > 0.01).all()
    np.testing.assert_allclose(found.spread(), 1.0, atol=0.12)


@pytest.mark.parametrize(("scale", "over_confident"), [(0.5, True), (2.0, False)])
def test_a_wrong_spread_bends_the_histogram(scale, over_confident):
    found = calibrate(simulate, exact(scale), ("x", "y"), runs=200)
    assert (found.p_values() < 1e-3).all()
    assert ((found.spread() > 1.3) if over_confident else (found.spread() < 0.7)).all()
    counts, (low, high) = found.histogram(), found.band()
    ends = counts[[0, -1]]
    assert (ends > high).all() if over_confident else (ends < low).all()


def test_a_bias_tilts_it():
    found = calibrate(simulate, exact(shift=0.5), ("x", "y"), runs=200)
    counts = found.histogram()
    assert (counts[:3].sum(axis=0) > 2 * counts[-3:].sum(axis=0)).all()


@pytest.mark.slow
def test_a_filter_of_ones_own_model_is_calibrated():
    """Any model that can simulate: here a filter whose particles start at the prior."""

    def infer(fixes, rng):
        start = rng.normal(size=(800, 2))
        still = Walk(variance=1e-3)  # a jitter too small to matter
        filter_ = Filter(still, Receiver(1.0), n=800, rng=rng, start=start)
        for fix in fixes:
            filter_.step(fix)
        return filter_.particles.state, filter_.particles.weights

    found = calibrate(simulate, infer, ("x", "y"), runs=100)
    assert (found.p_values() > 0.01).all()


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match="need 50 runs"):
        calibrate(simulate, exact(), ("x", "y"), runs=30)
    with pytest.raises(InputError, match=r"expected parameters \(1,\)"):
        calibrate(simulate, exact(), ("x",), runs=50)
