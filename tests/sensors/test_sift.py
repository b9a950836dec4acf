"""Keypoints and descriptors."""

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.features.sift import Sift, SiftConfig, descriptors_from_histograms, pooled
from tests.sensors.stereo_scenes import room


def blob(place, std, size=(120, 160)):
    line, column = np.mgrid[: size[0], : size[1]].astype(float)
    bump = np.exp(-((column - place[0]) ** 2 + (line - place[1]) ** 2) / (2 * std**2))
    return np.rint(40 + 180 * bump).astype(np.uint8)


@pytest.mark.parametrize("ratio", [1.0, 0.5])
@pytest.mark.parametrize("std", [4.0, 7.0])
def test_a_blob_is_found_at_its_place_and_scale(std, ratio):
    # The scale-normalised Laplacian of a Gaussian blob is strongest at the blob's own scale; a difference of two
    # Gaussians, σ and 2^(1/3) σ, has its extremum where their product is the blob's variance.
    place = (75.3, 60.8)
    points = Sift(SiftConfig(working_scale=ratio)).extract(blob(place, std))
    best = points.take(np.arange(1))
    np.testing.assert_allclose(best.px[0], place, atol=0.05)
    assert best.scale[0] == pytest.approx(std * 2 ** (-1 / 6), rel=0.08)


def test_places_orientations_and_keys_turn_with_the_image():
    image = room()[0][0][0]
    sift = Sift(SiftConfig(working_scale=1.0, length=128))
    first, turned = sift.extract(image), sift.extract(np.ascontiguousarray(np.rot90(image)))
    # Turned anticlockwise, (u, v) comes to (v, W − 1 − u), and a direction loses a quarter.
    place = np.column_stack([first.px[:, 1], image.shape[1] - 1 - first.px[:, 0]])
    near = np.linalg.norm(place[:, None] - turned.px[None], axis=2) < 0.1
    change = first.orientation[:, None] - 0.5 * np.pi - turned.orientation[None]
    same = near & (np.cos(change) > np.cos(0.1))
    assert same.any(axis=1).mean() > 0.9
    k, m = np.nonzero(same)
    assert np.median(np.einsum("cd,cd->c", first.descriptors[k], turned.descriptors[m])) > 0.99


def test_pooling_adds_what_it_says():
    histograms = np.random.default_rng(0).random((5, 128))
    cells = histograms.reshape(5, 4, 4, 8)
    expected = np.zeros((5, 3, 3, 4))
    for line in range(3):
        for column in range(3):
            window = cells[:, line : line + 2, column : column + 2].sum(axis=(1, 2))
            for turn in range(4):
                sides = window[:, (2 * turn - 1) % 8] + window[:, (2 * turn + 1) % 8]
                expected[:, line, column, turn] = window[:, 2 * turn] + 0.5 * sides
    np.testing.assert_allclose(pooled(histograms), expected.reshape(5, 36), atol=1e-12)


def test_pooling_treats_a_mirror_image_alike():
    def mirrored(descriptors, side, turns):
        cells = descriptors.reshape(-1, side, side, turns)[:, ::-1]
        return cells[..., -np.arange(turns) % turns].reshape(descriptors.shape)

    histograms = np.random.default_rng(1).random((4, 128))
    np.testing.assert_allclose(
        pooled(mirrored(histograms, 4, 8)), mirrored(pooled(histograms), 3, 4), atol=1e-12
    )


@pytest.mark.parametrize("length", [36, 128])
def test_products_of_keys(length):
    histograms = np.random.default_rng(2).integers(0, 256, (6, 128)).astype(np.float32)
    plain = histograms if length == 128 else pooled(histograms)
    fractions = plain / plain.sum(axis=1, keepdims=True)
    root, sift = (
        descriptors_from_histograms(histograms, length, "root"),
        descriptors_from_histograms(histograms, length, "sift"),
    )
    assert root.dtype == sift.dtype == np.float32 and root.shape == (6, length)
    bhattacharyya = np.sqrt(fractions[:, None] * fractions[None]).sum(axis=2)
    np.testing.assert_allclose(root @ root.T, bhattacharyya, atol=1e-6)
    cosine = plain @ plain.T / np.linalg.norm(plain, axis=1)[:, None] / np.linalg.norm(plain, axis=1)
    np.testing.assert_allclose(sift @ sift.T, cosine, atol=1e-6)


def test_an_empty_histogram_is_no_division_by_zero():
    assert not descriptors_from_histograms(np.zeros((1, 128)), 36).any()


def test_the_strongest_come_first_and_are_kept():
    image = room()[0][0][0]
    everything = Sift(SiftConfig(0, working_scale=1.0)).extract(image)
    assert (np.diff(everything.score) <= 0.0).all() and len(everything) > 100
    some = Sift(SiftConfig(50, working_scale=1.0)).extract(image)
    assert len(some) == 50
    np.testing.assert_array_equal(some.score, everything.score[:50])


def test_threads_change_nothing():
    image, before = room()[0][0][0], cv2.getNumThreads()
    found = []
    try:
        for threads in (1, 4):
            cv2.setNumThreads(threads)
            found.append(Sift(SiftConfig(features=100)).extract(image))
    finally:
        cv2.setNumThreads(before)
    for name in ("px", "scale", "orientation", "score", "descriptors"):
        assert getattr(found[0], name).tobytes() == getattr(found[1], name).tobytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"features": -1}, "features"),
        ({"working_scale": 0.0}, "working_scale"),
        ({"working_scale": 1.5}, "working_scale"),
        ({"contrast": -0.1}, "contrast"),
        ({"layers": 0}, "layer"),
        ({"length": 64}, "36 or 128"),
        ({"norm": "l1"}, "norm"),
    ],
)
def test_settings_out_of_range(changes, message):
    with pytest.raises(InputError, match=message):
        SiftConfig(**changes)
