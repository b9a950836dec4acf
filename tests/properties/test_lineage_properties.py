"""The forest of ancestors against plain composition of ancestor indices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.genealogy import Lineage


def drawn(rng: np.random.Generator, n: int, concentration: float) -> np.ndarray:
    """Ascending ancestors of a multinomial resampling with random weights."""
    weights = rng.dirichlet(np.full(n, concentration))
    return np.sort(rng.choice(n, size=n, p=weights))


class Composed:
    """Rows of retained generations, by composing ancestors."""

    def __init__(self, n: int) -> None:
        self.now = 0
        self.rows = {0: np.arange(n)}

    def advance(self, ancestors: np.ndarray) -> None:
        self.now += 1
        self.rows = {generation: rows[ancestors] for generation, rows in self.rows.items()}
        self.rows[self.now] = np.arange(ancestors.size)


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
def test_rows_are_composed_ancestors(seed):
    rng = np.random.default_rng(seed)
    n, concentration, keep = rng.integers(1, 10), rng.choice([0.05, 0.5, 5.0, 50.0]), rng.random()
    lineage, oracle = Lineage(n), Composed(n)
    kept: set[int] = set()
    for _ in range(rng.integers(1, 80)):
        if rng.random() < keep:
            lineage.retain(lineage.generation)
            kept.add(lineage.generation)
        if kept and rng.random() < 0.3:
            dropped = int(rng.choice(sorted(kept)))
            lineage.release(dropped)
            kept.remove(dropped)
        ancestors = drawn(rng, n, concentration)
        lineage.advance(ancestors)
        oracle.advance(ancestors)
        if rng.random() < 0.05:
            arrays, lineage = lineage.arrays(), Lineage(n)
            lineage.restore(arrays)
            for generation in kept:
                lineage.retain(generation)
        for generation in kept:
            np.testing.assert_array_equal(lineage.rows(generation), oracle.rows[generation])
            assert lineage.distinct(generation) == np.unique(oracle.rows[generation]).size
    np.testing.assert_array_equal(lineage.rows(lineage.generation), np.arange(n))


@given(n=st.integers(1, 9), seed=st.integers(0, 2**32 - 1))
def test_a_generation_may_be_retained_twice(n, seed):
    rng = np.random.default_rng(seed)
    lineage, oracle = Lineage(n), Composed(n)
    lineage.retain(0)
    lineage.retain(0)
    lineage.release(0)
    for _ in range(12):
        ancestors = drawn(rng, n, 0.5)
        lineage.advance(ancestors)
        oracle.advance(ancestors)
    np.testing.assert_array_equal(lineage.rows(0), oracle.rows[0])
    lineage.release(0)
    assert 0 not in lineage._retained


def test_size_of_the_forest():
    """Every generation kept: T + C N log N nodes (P. Jacob, L. Murray, S. Rubenthaler, 2015) with C < 4.

    With equal weights two lineages meet with probability 1/N per generation, so Σ 2N/age gives C of about 2.
    """
    rng, n = np.random.default_rng(5), 64
    lineage = Lineage(n)
    excess = []
    for t in range(600):
        lineage.retain(t)
        lineage.advance(np.sort(rng.integers(0, n, n)))
        excess.append((lineage.nodes - t) / (n * np.log(n)))
    assert max(excess) < 4.0
    assert 1.0 < np.mean(excess[100:]) < 3.0


def test_what_is_settled_is_forgotten_by_a_restoration():
    """A generation's number may mean another ancestry after a restoration."""
    lineage, other = Lineage(2), Lineage(2)
    for one, ancestors in ((lineage, [0, 0]), (other, [1, 1])):
        one.retain(0)
        one.advance(np.array(ancestors))
        np.testing.assert_array_equal(one.rows(0), ancestors)
    lineage.restore(other.arrays())
    lineage.take_up(0)
    np.testing.assert_array_equal(lineage.rows(0), [1, 1])
