"""Matching of descriptors, beside plain loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.models import NULL
from rbpf.errors import InputError
from rbpf.sensors import descriptors as descriptor_matching
from rbpf.sensors.descriptors import (
    DescriptorIndex,
    DescriptorStore,
    ExactSearch,
    Gate,
    MatchLimits,
    TreeSearch,
    band_pairs,
    gate_pairs,
    match_all,
    match_pairs,
)


def unit(rng, count, length=8):
    descriptors = np.abs(rng.standard_normal((count, length)))
    return (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)


def noisy_pair(rng, count, extra, length=8, noise=0.05):
    """Keys (K, d), and others (M, d) among which those of the first stand, changed a little."""
    second = unit(rng, count + extra, length)
    first = second[:count] + noise * rng.standard_normal((count, length)).astype(np.float32)
    return first / np.linalg.norm(first, axis=1, keepdims=True), second[rng.permutation(count + extra)]


def by_hand(first, second, possible, limits):
    """Pairs of rows, one loop after the other."""
    distance = np.linalg.norm(first[:, None].astype(float) - second[None], axis=2)
    distance[~possible] = np.inf
    pairs = []
    for k in range(len(first)):
        m = int(distance[k].argmin())
        others = np.delete(distance[k], m)
        passes = distance[k, m] <= limits.largest(first.shape[1])
        if limits.ratio < 1.0:
            passes &= distance[k, m] < limits.ratio * others.min(initial=np.inf)
        if limits.mutual:
            passes &= distance[:, m].argmin() == k
        if passes and np.isfinite(distance[k, m]):
            pairs.append((k, m))
    return pairs


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 20),
    extra=st.integers(0, 20),
    ratio=st.sampled_from([0.6, 0.8, 1.0]),
    fraction=st.sampled_from([0.1, 0.5, 1.0]),
)
def test_matches_are_those_of_a_plain_loop(seed, count, extra, ratio, fraction):
    rng = np.random.default_rng(seed)
    first, second = noisy_pair(rng, count, extra)
    limits = MatchLimits(0.5, ratio)
    possible = rng.random((count, count + extra)) < fraction
    matches = match_pairs(first, second, np.nonzero(possible), limits)
    assert list(zip(matches.first.tolist(), matches.second.tolist(), strict=True)) == by_hand(
        first, second, possible, limits
    )
    whole = match_all(first, second, limits)
    everything = np.ones_like(possible)
    assert list(zip(whole.first.tolist(), whole.second.tolist(), strict=True)) == by_hand(
        first, second, everything, limits
    )
    exact = np.linalg.norm(first[whole.first].astype(float) - second[whole.second], axis=1)
    np.testing.assert_allclose(whole.distance, exact, atol=2e-3)


def test_blocks_do_not_show(monkeypatch):
    first, second = noisy_pair(np.random.default_rng(1), 40, 60)
    limits = MatchLimits(0.5, 0.8)
    whole = match_all(first, second, limits)
    assert len(whole) > 20
    monkeypatch.setattr(descriptor_matching, "BLOCK", 7)
    parts = match_all(first, second, limits)
    np.testing.assert_array_equal(parts.first, whole.first)
    np.testing.assert_array_equal(parts.second, whole.second)


def test_few_and_many_pairs_give_the_same(monkeypatch):
    rng = np.random.default_rng(2)
    first, second = noisy_pair(rng, 40, 60)
    pairs = np.nonzero(rng.random((40, 100)) < 0.3)
    found = [match_pairs(first, second, pairs, MatchLimits(0.5))]
    monkeypatch.setattr(descriptor_matching, "GATHERED", 0)
    monkeypatch.setattr(descriptor_matching, "PAIRS", 11)
    found.append(match_pairs(first, second, pairs, MatchLimits(0.5)))
    np.testing.assert_array_equal(found[0].second, found[1].second)
    assert len(found[0]) > 10


def test_two_alike_are_ambiguous():
    rng = np.random.default_rng(3)
    descriptors = unit(rng, 3)
    twice = np.concatenate([descriptors, descriptors[:1]])
    matches = match_all(descriptors, twice, MatchLimits(0.5))
    assert matches.first.tolist() == [1, 2] and matches.second.tolist() == [1, 2]
    pairs = np.nonzero(np.ones((3, 4), dtype=bool))
    assert match_pairs(descriptors, twice, pairs, MatchLimits(0.5)).first.tolist() == [1, 2]


def test_only_what_may_compete_competes():
    descriptors = unit(np.random.default_rng(4), 3)
    twice = np.concatenate([descriptors, descriptors[:1]])
    pairs = np.array([0, 1, 2]), np.array([3, 1, 2])
    assert match_pairs(descriptors, twice, pairs, MatchLimits(0.5)).second.tolist() == [3, 1, 2]


def test_a_row_is_taken_once_even_when_not_mutual():
    key = unit(np.random.default_rng(5), 1)
    near = key + np.float32(0.02)
    both = np.concatenate([near / np.linalg.norm(near), key])
    assert match_all(both, key, MatchLimits(0.5, mutual=False)).first.tolist() == [1]


@pytest.mark.parametrize(("count", "other"), [(0, 5), (5, 0), (0, 0)])
def test_empty_sets(count, other):
    rng = np.random.default_rng(6)
    first, second = unit(rng, count), unit(rng, other)
    assert len(match_all(first, second, MatchLimits())) == 0
    none = np.zeros(0, dtype=np.int64)
    assert len(match_pairs(first, second, (none, none), MatchLimits())) == 0


@given(seed=st.integers(0, 1000), count=st.integers(0, 12), other=st.integers(0, 12))
def test_pairs_in_a_band(seed, count, other):
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, 10, count) * 1.0, rng.integers(0, 10, other) * 1.0
    reach = rng.integers(0, 3, count) * 1.0
    expected = np.argwhere(np.abs(first[:, None] - second[None]) <= reach[:, None])
    k, m = band_pairs(first, second, reach)
    assert sorted(zip(k.tolist(), m.tolist(), strict=True)) == [tuple(row) for row in expected.tolist()]


@given(seed=st.integers(0, 1000), dim=st.sampled_from([2, 3]))
def test_pairs_within_a_gate(seed, dim):
    rng = np.random.default_rng(seed)
    z, mean = rng.uniform(0, 20, (15, dim)), rng.uniform(0, 20, (12, dim))
    root = rng.standard_normal((27, dim, dim))
    spread = root @ root.swapaxes(1, 2) + 0.1 * np.eye(dim)
    noise, cov = spread[:15], spread[15:]
    mean[3] = np.nan
    expected = []
    for k in range(15):
        for m in range(12):
            nu = z[k] - mean[m]
            if nu @ np.linalg.solve(noise[k] + cov[m], nu) <= 9.0:
                expected.append((k, m))
    found = gate_pairs(z, noise, mean, cov, 9.0)
    assert sorted(zip(*(rows.tolist() for rows in found), strict=True)) == expected


@pytest.mark.parametrize(("changes", "found"), [({"distance": 0.0}, "0.0"), ({"ratio": 1.2}, "1.2")])
def test_limits_out_of_range(changes, found):
    with pytest.raises(InputError, match=found):
        MatchLimits(**changes)


LIMITS = MatchLimits(0.3, 0.8)


def seen_again(rng, descriptors, noise=0.02):
    changed = descriptors + noise * rng.standard_normal(descriptors.shape).astype(np.float32)
    return changed / np.linalg.norm(changed, axis=1, keepdims=True)


def filled(descriptors, search=None, limits=LIMITS):
    index = DescriptorIndex(descriptors.shape[1], limits, search)
    index.store.add(np.arange(len(descriptors)), descriptors)
    return index


@given(
    st.lists(
        st.tuples(st.integers(0, 90), st.lists(st.integers(0, 200), max_size=30, unique=True)), max_size=6
    )
)
def test_the_store_holds_what_a_dictionary_would(steps):
    rng, store, held, last = np.random.default_rng(0), DescriptorStore(4), {}, 0
    for count, gone in steps:
        ids, descriptors = last + 1 + np.arange(count), unit(rng, count, 4)
        last += count
        store.add(ids, descriptors)
        held.update(zip(ids.tolist(), descriptors, strict=True))
        drop = [i for i in gone if i in held]
        store.remove(np.array(drop, dtype=np.int64))
        for i in drop:
            del held[i]
        assert store.ids.tolist() == sorted(held) and len(store) == len(held)
        for i, descriptor in zip(store.ids.tolist(), store.descriptors, strict=True):
            np.testing.assert_array_equal(descriptor, held[i])


def test_what_a_store_refuses():
    store = DescriptorStore(4)
    descriptors = unit(np.random.default_rng(0), 3, 4)
    store.add(np.array([2, 5, 6]), descriptors)
    with pytest.raises(InputError, match="must ascend"):
        store.add(np.array([6]), descriptors[:1])
    with pytest.raises(InputError, match="must ascend"):
        store.add(np.array([9, 8]), descriptors[:2])
    with pytest.raises(InputError, match=r"must be \(1, 4\)"):
        store.add(np.array([7]), descriptors[:1, :3])
    with pytest.raises(InputError, match="no descriptor of landmark 3"):
        store.remove(np.array([5, 3]))
    assert store.ids.tolist() == [2, 5, 6]


@pytest.mark.parametrize("search", [ExactSearch(), TreeSearch()])
def test_features_find_their_landmarks_or_none(search):
    rng = np.random.default_rng(1)
    descriptors = unit(rng, 400, 36)
    index = filled(descriptors, search)
    wanted = rng.permutation(400)[:50]
    query = np.concatenate([seen_again(rng, descriptors[wanted]), unit(rng, 30, 36)])
    found = index.match(query)
    np.testing.assert_array_equal(found.ids[:50], wanted)
    assert (found.ids[50:] == NULL).all() and np.isinf(found.distance[50:]).all()
    exact = np.linalg.norm(query[:50].astype(float) - descriptors[wanted], axis=1)
    np.testing.assert_allclose(found.distance[:50], exact, atol=1e-3)


@pytest.mark.parametrize("slack", [0.0, 3.0])
def test_the_tree_beside_the_exact_search(slack):
    rng = np.random.default_rng(2)
    centres = unit(rng, 40, 36)
    descriptors = seen_again(rng, centres[rng.integers(0, 40, 3000)], 0.06)
    query = seen_again(rng, descriptors[rng.permutation(3000)[:300]], 0.01)
    exact, tree = (
        filled(descriptors, search).match(query).ids for search in (ExactSearch(), TreeSearch(slack=slack))
    )
    assert (exact != NULL).sum() > 200
    agree = np.mean(exact == tree)
    assert agree == 1.0 if slack == 0.0 else agree > 0.95


def test_the_tree_follows_what_comes_and_goes():
    rng = np.random.default_rng(3)
    descriptors = unit(rng, 900, 36)
    tree = TreeSearch(slack=0.0, tail=0.2, least=0)
    index, plain = filled(descriptors[:600], tree), filled(descriptors[:600])
    index.match(descriptors[:1])
    for start in range(600, 900, 60):
        for each in (index, plain):
            each.store.add(np.arange(start, start + 60), descriptors[start : start + 60])
            each.store.remove(np.arange(start - 600, start - 580))
        query = seen_again(rng, descriptors[rng.permutation(start + 60)[:200]])
        np.testing.assert_array_equal(index.match(query).ids, plain.match(query).ids)


def test_a_restored_store_makes_the_tree_anew():
    rng = np.random.default_rng(4)
    descriptors = unit(rng, 100, 36)
    index = filled(descriptors, TreeSearch())
    index.match(descriptors)
    other = filled(descriptors[::-1].copy())
    index.store.restore(other.store.arrays())
    assert index.match(descriptors[:1]).ids.tolist() == [99]


@pytest.mark.parametrize("search", [ExactSearch(), TreeSearch()])
def test_an_empty_map(search):
    index = DescriptorIndex(36, search=search)
    descriptors = unit(np.random.default_rng(5), 4, 36)
    assert (index.match(descriptors).ids == NULL).all() and np.isinf(index.nearest(descriptors)).all()
    assert index.match(descriptors[:0]).ids.shape == (0,)
    index.store.add(np.array([7]), descriptors[:1])
    assert index.match(descriptors).ids.tolist() == [7, NULL, NULL, NULL]
    index.store.remove(np.array([7]))
    assert (index.match(descriptors).ids == NULL).all()


def test_the_gate_decides_between_landmarks_that_look_alike():
    rng = np.random.default_rng(6)
    descriptor = unit(rng, 1, 36)
    index = filled(np.concatenate([descriptor, descriptor, descriptor]))
    assert index.match(descriptor).ids.tolist() == [NULL]
    gate = Gate(
        z=np.array([[100.0, 50.0, 90.0]]),
        noise=0.1 * np.eye(3)[None],
        ids=np.array([0, 2]),
        mean=np.array([[300.0, 50.0, 290.0], [101.0, 51.0, 91.0]]),
        cov=np.tile(4.0 * np.eye(3), (2, 1, 1)),
    )
    assert index.match(descriptor, gate).ids.tolist() == [2]
    nowhere = Gate(gate.z + 50.0, gate.noise, gate.ids, gate.mean, gate.cov)
    assert index.match(descriptor, nowhere).ids.tolist() == [NULL]


def test_a_checkpoint_holds_all():
    descriptors = unit(np.random.default_rng(8), 70, 36)
    index, again = filled(descriptors), DescriptorIndex(36)
    index.store.remove(np.array([3, 60]))
    again.store.restore(index.store.arrays())
    again.store.add(np.array([70]), descriptors[:1])
    assert again.store.ids.tolist() == [*index.store.ids.tolist(), 70]
    np.testing.assert_array_equal(again.store.descriptors[:68], index.store.descriptors)


def test_what_an_index_refuses():
    index = filled(unit(np.random.default_rng(9), 3, 36))
    with pytest.raises(InputError, match=r"\(K, 36\)"):
        index.match(np.zeros((2, 128), dtype=np.float32))
    with pytest.raises(InputError, match="tree search"):
        TreeSearch(slack=-1.0)
