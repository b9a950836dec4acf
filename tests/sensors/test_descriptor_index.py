"""The descriptors of a map: the store beside a dictionary, the tree beside the exact search, the gate."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.models import NULL
from rbpf.errors import InputError
from rbpf.sensors.descriptors import (
    DescriptorIndex,
    DescriptorStore,
    ExactSearch,
    Gate,
    MatchLimits,
    TreeSearch,
)
from tests.sensors.test_descriptor_matching import unit

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
