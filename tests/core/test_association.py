"""Association by maximum likelihood against trying out every explanation."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from rbpf.core.likelihoods import ExistenceModel, Gates, associate
from rbpf.core.models import NEW, NULL


def problem(rng: np.random.Generator, n: int, k: int, m: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Innovations and covariances with many near ties for a small spread."""
    factor = rng.normal(size=(n, k, m, 2, 3))
    return spread * rng.normal(size=(n, k, m, 2)), factor @ np.swapaxes(factor, -1, -2) + 0.3 * np.eye(2)


def explained(nu, cov, present, gates: Gates, choice: tuple[int, ...]) -> float:
    """Log-density of one particle's explanation, −∞ where it is not allowed."""
    total = 0.0
    matched = [landmark for landmark in choice if landmark >= 0]
    if len(set(matched)) < len(matched):
        return -np.inf
    for k, landmark in enumerate(choice):
        squared = np.array([v @ np.linalg.solve(c, v) for v, c in zip(nu[k], cov[k], strict=True)])
        squared[~present] = np.inf
        if landmark >= 0:
            if not squared[landmark] <= gates.accept:
                return -np.inf
            total += multivariate_normal.logpdf(nu[k, landmark], np.zeros(2), cov[k, landmark])
        elif landmark == NEW:
            if squared.min(initial=np.inf) <= gates.isolate:
                return -np.inf
            total += gates.log_new
        else:
            total += gates.log_clutter
    return total


@given(
    seed=st.integers(0, 2**32 - 1),
    k=st.integers(1, 3),
    m=st.integers(0, 3),
    spread=st.sampled_from([0.5, 2.0, 8.0]),
    log_new=st.floats(-12.0, -1.0),
)
def test_no_explanation_is_more_probable(seed, k, m, spread, log_new):
    rng = np.random.default_rng(seed)
    gates = Gates(accept=9.0, isolate=16.0, log_new=log_new, log_clutter=-6.0)
    nu, cov = problem(rng, 2, k, m, spread)
    present = rng.random((2, m)) < 0.7
    chosen = associate(nu, cov, present, gates)
    for i in range(2):
        every = product([NULL, NEW, *range(m)], repeat=k)
        best = max(explained(nu[i], cov[i], present[i], gates, choice) for choice in every)
        found = explained(nu[i], cov[i], present[i], gates, tuple(chosen[i].tolist()))
        assert found == pytest.approx(best, abs=1e-9)


def test_where_clutter_is_impossible_nothing_is_forced_on_a_landmark():
    nu = np.array([[[[4.0, 0.0]], [[0.0, 0.0]], [[0.1, 0.0]]]])
    gates = Gates(9.0, 25.0, -6.0, -np.inf)
    chosen = associate(nu, np.broadcast_to(np.eye(2), (1, 3, 1, 2, 2)), np.ones((1, 1), dtype=bool), gates)
    assert chosen.tolist() == [[NULL, 0, NULL]]


@pytest.mark.parametrize(
    ("log_odds", "seen", "expected", "after"),
    [
        (0.0, True, True, 1.0),
        (0.0, True, False, 1.0),
        (0.0, False, True, -0.5),
        (0.0, False, False, 0.0),
        (2.7, True, True, 3.0),  # the limit
        (-0.5, False, True, -1.0),
        (-0.6, False, True, -np.inf),  # dropped
        (-np.inf, True, True, -np.inf),  # what has left stays away
    ],
)
def test_log_odds_of_existence(log_odds, seen, expected, after):
    model = ExistenceModel(hit=1.0, miss=0.5, limit=3.0, drop=-1.0)
    assert model.updated(np.array([[log_odds]]), np.array([[seen]]), np.array([[expected]])) == after
