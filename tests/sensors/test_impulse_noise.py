"""Salt and pepper is taken out, and nothing else is touched."""

import numpy as np
import pytest

from examples.studies.image_faults import salt_and_pepper
from rbpf.sensors.stereo import TOLERATED_FRACTION, PairConfig, StereoMatcher, remove_impulses
from tests.systems.stereo_sequences import pairs


@pytest.fixture(scope="module")
def whole():
    return list(pairs(2).frames())


@pytest.fixture(scope="module")
def noisy():
    return list(salt_and_pepper(0.02)(pairs(2)).frames())


def test_other_images_stay_as_they_are(whole):
    """Also with noise of 8 grey levels, with a black frame and with lines of one pixel."""
    rng = np.random.default_rng(0)
    lines = np.full((240, 320), 90, dtype=np.uint8)
    lines[::7], lines[:, ::9] = 250, 5
    noisy = np.clip(whole[0].image + rng.normal(scale=8.0, size=(240, 320)), 0, 255).astype(np.uint8)
    for image in (whole[0].image, noisy, np.zeros((240, 320), np.uint8), lines):
        filtered = remove_impulses(image)
        assert filtered[0] is image and filtered[1] == 0.0


def test_a_few_specks_stay(whole):
    image = whole[0].image.copy()
    rows = np.random.default_rng(0).choice(
        image.size, int(0.8 * TOLERATED_FRACTION * image.size), replace=False
    )
    image.flat[rows] = 255
    assert remove_impulses(image)[0] is image


def test_corrupted_pixels_are_replaced(whole, noisy):
    true, image = (np.asarray(frame.image, dtype=int) for frame in (whole[1], noisy[1]))
    hit = np.abs(image - true) > 40
    filtered = remove_impulses(noisy[1].image)
    after = np.abs(filtered[0].astype(int) - true)
    assert filtered[1] == pytest.approx(hit.mean(), abs=0.003)
    assert np.sqrt(np.square(after[hit]).mean()) < 20.0 < 90.0 < np.abs(image - true)[hit].mean()
    assert (filtered[0] != image)[~hit].mean() < 0.01


def test_features_are_found_as_without(whole, noisy):
    """Nearly all of them; of the noisy images as they are half are left."""
    mending = StereoMatcher(pairs(2).rig)
    plain = StereoMatcher(pairs(2).rig, config=PairConfig(filter_impulses=False))
    clean = mending.measure(whole[1].image, whole[1].right)
    assert mending.remark == ""
    filtered = mending.measure(noisy[1].image, noisy[1].right)
    assert "% of the pixels have impulse noise" in mending.remark
    left = plain.measure(noisy[1].image, noisy[1].right)

    def again(features) -> float:
        gaps = np.linalg.norm(clean.z[:, None] - features.z[None], axis=-1)
        return float((gaps.min(axis=1) < 1.0).mean())

    assert again(filtered) > 0.7
    assert again(left) < 0.6 * again(filtered)
