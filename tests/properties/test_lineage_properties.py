"""The forest of ancestors and stored trajectories, against plain composition and a history that copies everything."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.genealogy import History, Lineage


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
    kept = list[int]()  # one may be retained twice
    for _ in range(rng.integers(1, 80)):
        for _ in range(rng.integers(1, 3) if rng.random() < keep else 0):
            lineage.retain(lineage.generation)
            kept.append(lineage.generation)
        if kept and rng.random() < 0.3:
            dropped = kept.pop(rng.integers(len(kept)))
            lineage.release(dropped)
            assert (dropped in lineage._retained) == (dropped in kept)
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


def test_size_of_the_forest():
    """Every generation kept: T + C N log N nodes (P. Jacob, L. Murray, S. Rubenthaler, 2015) with C < 4.
    With equal weights two lineages meet with probability 1/N per generation, so Σ 2N/age gives C of about 2."""
    rng, n = np.random.default_rng(5), 64
    lineage = Lineage(n)
    excess = []
    for t in range(600):
        lineage.retain(t)
        lineage.advance(np.sort(rng.integers(0, n, n)))
        excess.append((lineage.nodes - t) / (n * np.log(n)))
    assert max(excess) < 4.0
    assert 1.0 < np.mean(excess[100:]) < 3.0


class Copied:
    """All paths (T, N, E), gathered anew at every resampling."""

    def __init__(self, n: int, lag: int | None) -> None:
        self.paths = np.zeros((0, n, 2))
        self.stamps, self.clouds = list[int](), list[np.ndarray]()
        self.lag = lag

    def resample(self, ancestors: np.ndarray) -> None:
        self.paths = self.paths[:, ancestors]

    def record(self, stamp: int, state: np.ndarray, log_weights: np.ndarray) -> None:
        keep = len(self.stamps) + 1 if self.lag is None else self.lag
        self.paths = np.concatenate([self.paths, state[None]])[-keep:]
        self.stamps = [*self.stamps, stamp][-keep:]
        self.clouds = [*self.clouds, np.column_stack([state, log_weights])][-keep:]


def recorded(seed: int, lag: int | None, clouds: bool) -> tuple[History, Copied]:
    """A history of random length, size and rate of resampling, saved and restored on its way."""
    rng = np.random.default_rng(seed)
    n, steps, rate = rng.integers(1, 9), rng.integers(1, 80), rng.choice([0.1, 0.6, 1.0])
    lineage = Lineage(n)
    history, oracle = History(lineage, lag, clouds), Copied(n, lag)
    for t in range(steps):
        if rng.random() < rate:
            ancestors = np.sort(rng.integers(0, n, n))
            lineage.advance(ancestors)
            oracle.resample(ancestors)
        state, log_weights = rng.normal(size=(n, 2)), rng.normal(size=n)
        history.record(10 * t, state, log_weights)
        oracle.record(10 * t, state.copy(), log_weights)
        state[:] = np.nan  # what was recorded is a copy
        if rng.random() < 0.05:
            lineage, history = restored(lineage, history)
    return history, oracle


@given(seed=st.integers(0, 2**32 - 1), lag=st.sampled_from([None, 1, 2, 7, 30]), clouds=st.booleans())
def test_paths_are_those_of_a_full_history(seed, lag, clouds):
    history, oracle = recorded(seed, lag, clouds)
    np.testing.assert_array_equal(history.paths(), oracle.paths)
    np.testing.assert_array_equal(history.stamps_ns, oracle.stamps)
    if clouds:
        held = [(s, w) for block in history.blocks for s, w in zip(block.states, block.log_weights, strict=True)]
        np.testing.assert_array_equal([np.column_stack(pair) for pair in held], oracle.clouds)


def restored(lineage: Lineage, history: History) -> tuple[Lineage, History]:
    arrays = lineage.arrays() | history.arrays()
    again = Lineage(lineage.n)
    again.restore(arrays)
    copy = History(again, history.lag, history.clouds)
    copy.restore(arrays)
    return again, copy


@pytest.mark.parametrize("rate", [0.2, 1.0])
def test_a_fixed_lag_takes_constant_memory(rate):
    rng = np.random.default_rng(8)
    n, lag = 20, 25
    lineage = Lineage(n)
    history = History(lineage, lag)
    sizes = []
    for t in range(1500):
        if rng.random() < rate:
            lineage.advance(np.sort(rng.integers(0, n, n)))
        history.record(t, np.zeros((n, 3)), np.zeros(n))
        if t % 20 == 0:
            sizes.append((history.stored_states, len(history.blocks), lineage.nodes))
    states, blocks, nodes = np.max(sizes, axis=0)
    assert states <= lag * n
    assert blocks <= lag + 1
    assert nodes <= 16 * n
    assert lineage.arrays()["lineage/parent"].size <= 16 * n
