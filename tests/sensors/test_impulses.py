"""Salt and pepper is taken out, and nothing else is touched."""

import numpy as np
import pytest

from rbpf.sensors.impulses import SPECKS, without_impulses
from rbpf.sensors.stereo_matching import StereoConfig, StereoSift
from rbpf.validation.image_faults import salt_and_pepper
from tests.systems.stereo_sequences import pairs


@pytest.fixture(scope="module")
def whole():
    return list(pairs(2).frames())


@pytest.fixture(scope="module")
def struck():
    return list(salt_and_pepper(0.02)(pairs(2)).frames())


def test_other_images_stay_as_they_are(whole):
    """Also with noise of 8 grey levels, with a black frame and with lines of one pixel."""
    rng = np.random.default_rng(0)
    lines = np.full((240, 320), 90, dtype=np.uint8)
    lines[::7], lines[:, ::9] = 250, 5
    noisy = np.clip(whole[0].image + rng.normal(scale=8.0, size=(240, 320)), 0, 255).astype(np.uint8)
    for image in (whole[0].image, noisy, np.zeros((240, 320), np.uint8), lines):
        mended = without_impulses(image)
        assert mended.image is image and mended.struck == 0.0


def test_a_few_specks_stay(whole):
    image = whole[0].image.copy()
    rows = np.random.default_rng(0).choice(image.size, int(0.8 * SPECKS * image.size), replace=False)
    image.flat[rows] = 255
    assert without_impulses(image).image is image


def test_struck_pixels_are_replaced(whole, struck):
    true, image = (np.asarray(frame.image, dtype=int) for frame in (whole[1], struck[1]))
    hit = np.abs(image - true) > 40
    mended = without_impulses(struck[1].image)
    after = np.abs(mended.image.astype(int) - true)
    assert mended.struck == pytest.approx(hit.mean(), abs=0.003)
    assert np.sqrt(np.square(after[hit]).mean()) < 20.0 < 90.0 < np.abs(image - true)[hit].mean()
    assert (mended.image != image)[~hit].mean() < 0.01


def test_features_are_found_as_without(whole, struck):
    """Nearly all of them; of the struck images as they are half are left."""
    mending = StereoSift(pairs(2).rig)
    plain = StereoSift(pairs(2).rig, stereo=StereoConfig(mend=False))
    clean = mending.measure(whole[1].image, whole[1].right)
    assert mending.remark == ""
    mended = mending.measure(struck[1].image, struck[1].right)
    assert "% of the pixels are struck" in mending.remark
    left = plain.measure(struck[1].image, struck[1].right)

    def again(features) -> float:
        gaps = np.linalg.norm(clean.z[:, None] - features.z[None], axis=-1)
        return float((gaps.min(axis=1) < 1.0).mean())

    assert again(mended) > 0.7
    assert again(left) < 0.6 * again(mended)
