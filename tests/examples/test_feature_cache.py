"""Features kept in files: a run over them is the run over the images."""

import numpy as np
import pytest

from examples.studies import feature_cache
from examples.studies.feature_cache import cache_features, filter_cached
from rbpf.errors import InputError
from rbpf.sensors.features import SiftConfig
from rbpf.systems.stereo.config import StereoConfig
from tests.systems.stereo_sequences import filtered, missing, pairs

CONFIG, COUNT, BAD = StereoConfig(particles=40), 7, 4


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(feature_cache, "CHUNK", 3)


def sequence():
    return pairs(COUNT, lambda t, frame: missing(frame) if t == BAD else frame)


@pytest.mark.slow
def test_the_same_run(tmp_path):
    """To the last bit, with what was wrong with a pair; a part of it, and from the middle on."""
    told = []
    kept = cache_features(sequence(), CONFIG, tmp_path, lambda done, total: told.append((done, total)))
    assert told == [(k, COUNT) for k in range(1, COUNT + 1)]
    ours, plain = filter_cached(kept, CONFIG), filtered(sequence(), CONFIG)
    for name in ("odometry", "features", "agreeing", "observed"):
        np.testing.assert_array_equal(ours.log[name], plain.log[name])
    for name in ("stamps_ns", "poses", "covs"):
        np.testing.assert_array_equal(getattr(ours.log, name), getattr(plain.log, name))
    assert ours.messages == plain.messages and len(ours.messages) == 1
    assert len(kept.first(5)) == 5 and len(filter_cached(kept.first(5), CONFIG).log) == 5
    late = list(kept.frames(COUNT - 2))
    assert len(late) == 2
    np.testing.assert_array_equal(late[1].features.descriptors, list(kept.frames())[-1].features.descriptors)


def test_features_of_another_recording_are_refused(tmp_path):
    cache_features(sequence(), CONFIG, tmp_path)
    with pytest.raises(InputError, match="another recording or with other settings"):
        cache_features(pairs(COUNT + 1), CONFIG, tmp_path)
    with pytest.raises(InputError, match="another recording or with other settings"):
        cache_features(sequence(), StereoConfig(sift=SiftConfig(length=128)), tmp_path)
