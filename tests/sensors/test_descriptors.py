"""Matching of descriptors, beside plain loops; which of them enter a map, stay, and become landmarks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rbpf.core.models import NULL
from rbpf.errors import InputError
from rbpf.sensors import descriptors as descriptor_matching
from rbpf.sensors.descriptors import MatchLimits, band_pairs, distances, gate_pairs, match_all, match_pairs
from rbpf.sensors.landmark_management import LandmarkManager, NewLandmarkConfig


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
    count=st.integers(0, 20),
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


def test_how_pairs_are_taken_together_does_not_show(monkeypatch):
    rng = np.random.default_rng(1)
    first, second = noisy_pair(rng, 40, 60)
    limits, pairs = MatchLimits(0.5, 0.8), np.nonzero(rng.random((40, 100)) < 0.3)
    whole, some = match_all(first, second, limits), match_pairs(first, second, pairs, limits)
    assert len(whole) > 20 and len(some) > 10
    for name, value in (("BLOCK", 7), ("GATHERED", 0), ("PAIRS", 11)):
        monkeypatch.setattr(descriptor_matching, name, value)
    parts, again = match_all(first, second, limits), match_pairs(first, second, pairs, limits)
    np.testing.assert_array_equal([parts.first, parts.second], [whole.first, whole.second])
    np.testing.assert_array_equal([again.first, again.second], [some.first, some.second])


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


LIMITS = MatchLimits(0.3, 0.8)


SIZE = (640, 480)


def managing(length=36, **config):
    return LandmarkManager(NewLandmarkConfig(**config), SIZE, length)


def test_what_a_manager_refuses():
    manager = managing(4)
    manager.add(unit(np.random.default_rng(0), 3, 4))
    for use, what, words in (
        (manager.rows, (np.array([1, 3]),), "no landmark named 3"),
        (manager.observe, (np.array([5]),), "no landmark named 5"),
        (manager.match, (np.zeros((2, 128), dtype=np.float32), LIMITS), r"\(K, 4\)"),
    ):
        with pytest.raises(InputError, match=words):
            use(*what)
    assert manager.names.tolist() == [0, 1, 2]


def test_an_empty_map():
    manager, descriptors = managing(), unit(np.random.default_rng(5), 4, 36)
    assert (manager.match(descriptors, LIMITS) == NULL).all() and np.isinf(manager.nearest(descriptors)).all()
    manager.add(descriptors[:1])
    assert manager.match(descriptors, LIMITS).tolist() == [0, NULL, NULL, NULL]


def features(rng, count):
    return rng.uniform([0, 0], SIZE, (count, 2)), unit(rng, count, 36)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    fraction=st.floats(0.0, 1.0),
    config=st.builds(
        NewLandmarkConfig,
        max_per_frame=st.integers(0, 20),
        patience=st.integers(1, 4),
        observations=st.integers(1, 4),
        max_candidates=st.integers(0, 40),
    ),
)
def test_sightings_decide_who_stays(seed, fraction, config):
    rng = np.random.default_rng(seed)
    manager = LandmarkManager(config, SIZE, 36)
    seen: dict[int, list[int]] = {}
    looks: dict[int, np.ndarray] = {}
    ever = 0
    for frame in range(1, 15):
        names = manager.names[rng.random(manager.names.size) < fraction]
        for name in names.tolist():
            seen[name].append(frame)
        overdue = [
            name
            for name, frames in seen.items()
            if len(frames) < config.observations and frame - frames[-1] >= config.patience
        ]
        assert manager.observe(names)[0].tolist() == overdue
        for name in overdue:
            del seen[name]
        px, descriptors = features(rng, 30)
        chosen = manager.select(px, descriptors, np.full(30, np.inf), np.zeros((0, 2)))
        assert chosen.size <= config.max_per_frame
        new = manager.add(descriptors[chosen])
        assert new.tolist() == list(range(ever, ever + chosen.size))
        ever += chosen.size
        seen.update({name: [frame] for name in new.tolist()})
        looks.update(zip(new.tolist(), descriptors[chosen], strict=True))
        assert manager.names.tolist() == sorted(seen)
        np.testing.assert_array_equal(manager.descriptors, np.array([looks[k] for k in sorted(seen)]).reshape(-1, 36))
        assert manager.observations.tolist() == [len(seen[name]) for name in sorted(seen)]
        np.testing.assert_array_equal(manager.confirmed, manager.observations >= config.observations)
        if config.observations > 1:
            assert (~manager.confirmed).sum() <= config.max_candidates


@given(seed=st.integers(0, 10_000), spacing=st.floats(0.0, 80.0), distinct=st.floats(0.05, 0.6))
def test_new_keys_are_apart_from_others(seed, spacing, distinct):
    rng = np.random.default_rng(seed)
    manager = managing(spacing_px=spacing, distinct=distinct)
    px, descriptors = features(rng, 40)
    taken, nearest = rng.uniform([0, 0], SIZE, (10, 2)), rng.uniform(0.0, 0.8, 40)
    chosen = manager.select(px, descriptors, nearest, taken)
    assert (nearest[chosen] >= distinct).all()
    places = np.concatenate([taken, px[chosen]])
    gaps = np.linalg.norm(px[chosen][:, None] - places[None], axis=2)
    gaps[np.arange(chosen.size), 10 + np.arange(chosen.size)] = np.inf
    assert (gaps >= spacing - 1e-9).all()
    between = distances(descriptors[chosen] @ descriptors[chosen].T)[~np.eye(chosen.size, dtype=bool)]
    assert (between >= distinct - 1e-3).all()
    if chosen.size < 15:
        # Whoever was left out is too near to something.
        left = np.setdiff1d(np.arange(40), chosen)
        near = np.linalg.norm(px[left][:, None] - places[None], axis=2).min(axis=1) < spacing
        alike = nearest[left] < distinct
        if chosen.size:
            alike |= distances(descriptors[left] @ descriptors[chosen].T).min(axis=1) < distinct
        assert (near | alike).all()


def test_new_keys_spread_over_the_image():
    rng = np.random.default_rng(0)
    corner = rng.uniform([0, 0], [100, 75], (60, 2))
    elsewhere = np.array([[600.0, 450.0], [20.0, 460.0], [620.0, 20.0], [320.0, 240.0]])
    px = np.concatenate([corner, elsewhere])
    manager = managing(max_per_frame=6, spacing_px=0.0, distinct=0.0)
    chosen = manager.select(px, unit(rng, 64, 36), np.full(64, np.inf), np.zeros((0, 2)))
    assert set(range(60, 64)) <= set(chosen.tolist()) and chosen.size == 6
    occupied = np.repeat(elsewhere[:1], 5, axis=0) + 15.0
    crowded = manager.select(px, unit(rng, 64, 36), np.full(64, np.inf), occupied)
    assert 60 not in crowded.tolist()
