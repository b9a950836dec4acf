"""Association by maximum likelihood against trying out every explanation."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from rbpf.core.likelihoods import ExistenceModel, Gates, associate
from rbpf.core.models import NEW, NULL

GATES = Gates(accept=9.0, isolate=25.0, log_new=-6.0, log_clutter=-8.0)


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


@given(seed=st.integers(0, 2**32 - 1), m=st.integers(1, 6), k=st.integers(1, 8))
def test_no_landmark_explains_two(seed, m, k):
    nu, cov = problem(np.random.default_rng(seed), 3, k, m, 0.3)
    chosen = associate(nu, cov, np.ones((3, m), dtype=bool), Gates(1e3, 1e4, -6.0, -8.0))
    for row in chosen:
        matched = row[row >= 0]
        assert np.unique(matched).size == matched.size
        assert matched.size == min(k, m)


@pytest.mark.parametrize(
    ("distance", "expected"), [(2.9, 0), (3.1, NULL), (4.9, NULL), (5.1, NEW)], ids=["in", "out", "near", "far"]
)
def test_gates(distance, expected):
    nu = np.array([distance, 0.0]).reshape(1, 1, 1, 2)
    assert associate(nu, np.eye(2)[None, None, None], np.ones((1, 1), dtype=bool), GATES) == expected


def test_a_landmark_that_a_particle_does_not_hold():
    nu, cov = np.zeros((2, 1, 1, 2)), np.broadcast_to(np.eye(2), (2, 1, 1, 2, 2))
    chosen = associate(nu, cov, np.array([[True], [False]]), GATES)
    assert chosen.tolist() == [[0], [NEW]]


def test_an_improbable_landmark_loses_to_clutter():
    # Within the gate, but so uncertain that its density falls below that of clutter.
    nu, cov = np.zeros((1, 1, 1, 2)), 1e5 * np.eye(2)[None, None, None]
    assert associate(nu, cov, np.ones((1, 1), dtype=bool), GATES) == NULL


def test_first_sightings_that_are_less_probable_than_clutter():
    nu, cov = np.zeros((1, 2, 0, 2)), np.zeros((1, 2, 0, 2, 2))
    present = np.ones((1, 0), dtype=bool)
    assert associate(nu, cov, present, Gates(9.0, 25.0, -8.0, -6.0)).tolist() == [[NULL, NULL]]
    assert associate(nu, cov, present, Gates(9.0, 25.0, -6.0, -8.0)).tolist() == [[NEW, NEW]]


def test_where_clutter_is_impossible_nothing_is_forced_on_a_landmark():
    nu = np.array([[[[4.0, 0.0]], [[0.0, 0.0]], [[0.1, 0.0]]]])
    gates = Gates(9.0, 25.0, -6.0, -np.inf)
    chosen = associate(nu, np.broadcast_to(np.eye(2), (1, 3, 1, 2, 2)), np.ones((1, 1), dtype=bool), gates)
    assert chosen.tolist() == [[NULL, 0, NULL]]


class TestExistence:
    model = ExistenceModel(hit=1.0, miss=0.5, limit=3.0, drop=-1.0)

    def after(self, log_odds, seen, expected) -> float:
        return float(self.model.updated(np.array([[log_odds]]), np.array([[seen]]), np.array([[expected]]))[0, 0])

    def test_counting(self):
        assert self.after(0.0, seen=True, expected=True) == 1.0
        assert self.after(0.0, seen=True, expected=False) == 1.0
        assert self.after(0.0, seen=False, expected=True) == -0.5
        assert self.after(0.0, seen=False, expected=False) == 0.0

    def test_limits(self):
        assert self.after(2.7, seen=True, expected=True) == 3.0

    def test_dropping(self):
        assert self.after(-0.5, seen=False, expected=True) == -1.0
        assert self.after(-0.6, seen=False, expected=True) == -np.inf

    def test_what_has_left_stays_away(self):
        assert self.after(-np.inf, seen=True, expected=True) == -np.inf
