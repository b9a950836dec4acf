"""Which descriptors enter a map, stay, and become landmarks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.sensors.descriptors import distances
from rbpf.sensors.landmark_management import LandmarkManager, NewLandmarkConfig
from tests.sensors.test_descriptors import unit

SIZE = (640, 480)


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
    manager = LandmarkManager(config, SIZE)
    seen: dict[int, list[int]] = {}
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
        assert manager.observe(names).tolist() == overdue
        for name in overdue:
            del seen[name]
        px, descriptors = features(rng, 30)
        chosen = manager.select(px, descriptors, np.full(30, np.inf), np.zeros((0, 2)))
        assert chosen.size <= config.max_per_frame
        new = manager.add(chosen.size)
        assert new.tolist() == list(range(ever, ever + chosen.size))
        ever += chosen.size
        seen.update({name: [frame] for name in new.tolist()})
        assert manager.names.tolist() == sorted(seen)
        assert manager.observations.tolist() == [len(seen[name]) for name in sorted(seen)]
        np.testing.assert_array_equal(manager.confirmed, manager.observations >= config.observations)
        if config.observations > 1:
            assert (~manager.confirmed).sum() <= config.max_candidates


@given(seed=st.integers(0, 10_000), spacing=st.floats(0.0, 80.0), distinct=st.floats(0.05, 0.6))
def test_new_keys_are_apart_from_others(seed, spacing, distinct):
    rng = np.random.default_rng(seed)
    manager = LandmarkManager(NewLandmarkConfig(spacing_px=spacing, distinct=distinct), SIZE)
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
    config = NewLandmarkConfig(max_per_frame=6, spacing_px=0.0, distinct=0.0)
    chosen = LandmarkManager(config, SIZE).select(px, unit(rng, 64, 36), np.full(64, np.inf), np.zeros((0, 2)))
    assert set(range(60, 64)) <= set(chosen.tolist()) and chosen.size == 6
    occupied = np.repeat(elsewhere[:1], 5, axis=0) + 15.0
    crowded = LandmarkManager(config, SIZE).select(px, unit(rng, 64, 36), np.full(64, np.inf), occupied)
    assert 60 not in crowded.tolist()


def test_what_is_refused():
    manager = LandmarkManager(NewLandmarkConfig(), SIZE)
    with pytest.raises(InputError, match="no landmark named 0"):
        manager.observe(np.array([0]))
