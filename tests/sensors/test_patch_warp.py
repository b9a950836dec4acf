"""Cutting and warping of patches."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.patches.kernels import footprint
from rbpf.sensors.patches.search import cut, warp
from tests.sensors.patch_scenes import Waves, cubic, unit, window

TURN = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
MAPS = {
    "same": np.eye(2),
    "turned": TURN,
    "upside down": -np.eye(2),
    "larger": 0.6 * np.eye(2),
    "smaller": 1.5 * np.eye(2),
    "half": 2.0 * np.eye(2),
    "third": 2.6 * np.eye(2),
    "squeezed": np.diag([2.2, 1.0]),
    "sheared": np.array([[1.0, 0.6], [0.0, 1.2]]),
    "turned and smaller": 1.6 * TURN,
}
SAME = np.eye(2)[None]


@pytest.fixture(scope="module")
def image():
    return Waves(1).image((80, 100))


def test_cut_at_a_whole_pixel_is_the_image(image):
    assert np.array_equal(cut(image, np.array([40.0, 30.0])), window(image, (40, 30), 31))


def test_cut_between_pixels_is_numpys(image):
    v, u = np.indices((11, 11)) - 5
    expected = np.clip(np.floor(cubic(image, 40.3 + u, 30.8 + v) + 0.5), 0, 255)
    assert np.array_equal(cut(image, np.array([40.3, 30.8]), 5), expected)


def test_cut_between_pixels_stays_within_grey_levels():
    image = np.zeros((40, 40), np.uint8)
    image[:, 20:] = 255
    step = cut(image, np.array([19.5, 20.0]), 4)
    assert step.min() == 0 and step.max() == 255 and (np.diff(step.astype(int), axis=1) >= 0).all()


@pytest.mark.parametrize(
    "px", [(14.9, 30.0), (84.1, 30.0), (40.0, 14.0), (40.0, 64.5), (np.nan, 30.0), (np.inf, 9.0)]
)
def test_cut_does_not_reach_beyond(image, px):
    assert cut(image, np.array(px)) is None


@pytest.mark.parametrize("name", MAPS)
def test_warp_equals_numpys(image, name):
    source, affine = window(image, (45, 40), 61), MAPS[name]
    v, u = np.indices((11, 11)) - 5
    places = 30 + np.stack([u, v], axis=-1) @ affine.T
    samples = footprint(*affine.ravel(), 61)
    expected = np.mean([cubic(source, places[..., 0] + x, places[..., 1] + y) for x, y in samples], axis=0)
    found = warp(source[None], affine[None])[0]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("name", MAPS)
def test_samples_make_up_for_the_larger_pixel(name):
    """Their covariance is that of the new pixel's square in the source less that of the source's own pixel."""
    samples = footprint(*MAPS[name].ravel(), 61)
    values, vectors = np.linalg.eigh(MAPS[name] @ MAPS[name].T - np.eye(2))
    expected = vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T / 12.0
    np.testing.assert_allclose(samples.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(samples.T @ samples / len(samples), expected, atol=1e-6)
    assert (
        np.diff(np.unique(samples.round(9), axis=0), axis=0).max(initial=0.0)
        < 2.0 * np.abs(samples).max() + 1.0
    )


@pytest.mark.parametrize("name", MAPS)
def test_warp_is_what_the_other_view_shows(name):
    """The window of one view, warped, correlates with the image that the other view really takes.

    Not fully: the blur is the lens' and stays as wide in the smaller view, where the warp only widens the pixel.
    """
    waves, affine = Waves(7), MAPS[name]
    source = waves.image((61, 61))
    seen = waves.image((41, 41), affine)
    template = warp(source[None], affine[None])[0]
    assert (unit(template) * unit(window(seen, (20, 20), 11))).sum() > 0.96


def test_a_smaller_view_has_no_moire():
    """Stripes finer than the new view's pixels turn grey instead of into broad stripes."""
    u = np.arange(61)[None].repeat(61, axis=0)
    stripes = np.where(u % 3 == 0, 255, 0).astype(np.uint8)
    bare = stripes[30 - 25 : 30 + 26 : 5, 30 - 25 : 30 + 26 : 5].std()
    averaged = warp(stripes[None], 2.9 * SAME)[0].std()
    assert bare > 100.0 and averaged < 0.1 * bare


@pytest.mark.parametrize(
    "affine",
    [
        3.01 * np.eye(2),
        np.diag([3.5, 1.0]),
        np.full((2, 2), np.nan),
        np.diag([np.inf, 1.0]),
        1e200 * np.eye(2),
    ],
)
def test_a_view_of_more_than_the_source_has_no_template(image, affine):
    templates = warp(np.repeat(window(image, (45, 40), 31)[None], 2, axis=0), np.stack([affine, np.eye(2)]))
    assert np.isnan(templates[0]).all() and np.isfinite(templates[1]).all()


@pytest.mark.parametrize(
    ("sources", "affines", "size", "sentence"),
    [
        (np.zeros((1, 31, 31)), SAME, 11, "uint8"),
        (np.zeros((1, 30, 30), np.uint8), SAME, 11, "S odd"),
        (np.zeros((1, 31, 33), np.uint8), SAME, 11, "S odd"),
        (np.zeros(31, np.uint8), SAME, 11, "S odd"),
        (np.zeros((2, 31, 31), np.uint8), SAME, 11, "one for each source"),
        (np.zeros((1, 31, 31), np.uint8), SAME, 10, "must be odd"),
    ],
)
def test_wrong_arguments(sources, affines, size, sentence):
    with pytest.raises(InputError, match=sentence):
        warp(sources, affines, size)
