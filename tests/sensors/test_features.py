"""What detectors, descriptors and extractors keep."""

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.features import CornerDetector, Extractor, Keypoints, Sift, SiftConfig
from rbpf.sensors.features.corners import WINDOW_PX
from rbpf.sensors.features.interface import WINDOW_SCALE_PX
from rbpf.sensors.features.sift import descriptors_from_histograms, pooled
from rbpf.sensors.patches.search import cut

DESCRIPTORS = {"sift": Sift(SiftConfig(working_scale=1.0, length=128)), "sift 36": Sift(SiftConfig(working_scale=1.0))}


def textured(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Blurred noise, grey."""
    noise = np.random.default_rng(seed).normal(size=shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128.0 + 45.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)


EXTRACTORS = {"sift": Sift(), "corners and sift": Extractor(CornerDetector(), DESCRIPTORS["sift 36"])}
every_descriptor = pytest.mark.parametrize("descriptor", DESCRIPTORS.values(), ids=DESCRIPTORS.keys())


def test_a_detector_gives_the_best_first_apart_and_inside():
    detector, image, mask = CornerDetector(), textured(), np.hypot(*np.ogrid[-120:120, -160:160]) < 110.0
    occupied = np.array([[160.0, 120.0], [np.nan, 3.0]])
    found = detector.detect(image, 30, occupied, 12.0, 20.0, mask)
    assert 10 < len(found) <= 30 and (np.diff(found.score) <= 0.0).all()
    apart = np.linalg.norm(found.px[:, None] - found.px, axis=2)[~np.eye(len(found), dtype=bool)]
    assert apart.min() >= 12.0 and np.linalg.norm(found.px - occupied[0], axis=1).min() >= 12.0
    assert (found.px >= 20.0).all() and (found.px <= np.array([319, 239]) - 20.0).all()
    assert mask[found.px[:, 1].astype(int), found.px[:, 0].astype(int)].all()
    assert np.array_equal(detector.detect(image, 7, occupied, 12.0, 20.0, mask).px, found.px[:7])


@pytest.mark.parametrize("shape", [(0, 0), (7, 300), (10, 10), (11, 11), (101, 97)])
def test_a_detector_finds_nothing_where_nothing_is(shape):
    image, detector = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8), CornerDetector()
    found = detector.detect(image, 10, border_px=5.0)
    assert found.px.shape == (len(found.score), 2) and (len(found) > 0) == (min(shape) >= 11)
    assert len(detector.detect(image, 0, border_px=5.0)) == len(detector.detect(np.full_like(image, 128), 10)) == 0


def test_what_a_detector_refuses():
    with pytest.raises(InputError, match="must be grey"):
        CornerDetector().detect(np.zeros((60, 80, 3), np.uint8), 10)
    with pytest.raises(InputError, match=r"must be \(M, 2\)"):
        CornerDetector().detect(textured(), 10, np.zeros(2))


@every_descriptor
def test_descriptors_are_unit_vectors_that_tell_keypoints_apart(descriptor):
    image = textured()
    found = CornerDetector().detect(image, 60, None, 12.0, 60.0)
    first = descriptor.describe(image, found)
    assert first.shape == (len(found), descriptor.length) and first.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1.0, atol=1e-4)
    noise = np.random.default_rng(0).normal(scale=3.0, size=image.shape)
    again = descriptor.describe(np.clip(image + noise, 0, 255).astype(np.uint8), found)
    assert ((first @ again.T).argmax(axis=1) == np.arange(len(found))).mean() > 0.95
    assert descriptor.describe(image, Keypoints.at(np.zeros((0, 2)))).shape == (0, descriptor.length)
    with pytest.raises(InputError, match="grey"):
        descriptor.describe(np.zeros((20, 20, 3), np.uint8), Keypoints.at(np.array([[10.0, 10.0]])))


@every_descriptor
def test_a_window_has_the_descriptor_of_its_place(descriptor):
    image = textured()
    px = CornerDetector().detect(image, 60, None, 12.0, 60.0).px
    windows = np.array([cut(image, place) for place in px])
    kept = descriptor.describe_windows(windows, np.full(len(px), WINDOW_SCALE_PX), np.zeros(len(px)))
    assert (kept * descriptor.describe(image, Keypoints.at(px))).sum(axis=1).min() > 0.98


@pytest.mark.parametrize(("degrees", "zoom"), [(30.0, 1.0), (-45.0, 1.2), (0.0, 0.7), (10.0, 1.4)])
def test_sift_descriptors_follow_turn_and_scale(degrees, zoom):
    image, sift = textured(), DESCRIPTORS["sift"]
    px = CornerDetector().detect(image, 60, None, 12.0, 60.0).px
    windows = np.array([cut(image, place) for place in px])
    motion = cv2.getRotationMatrix2D((159.5, 119.5), degrees, zoom)
    moved = cv2.warpAffine(image, motion, image.shape[::-1], flags=cv2.INTER_AREA)
    there = px @ motion[:, :2].T + motion[:, 2]
    inside = ((there > 25) & (there < [294, 214])).all(axis=1)
    source_from_now = np.linalg.inv(motion[:, :2])
    turn = np.full(len(px), np.arctan2(source_from_now[1, 0], source_from_now[0, 0]))
    kept = sift.describe_windows(windows, np.full(len(px), WINDOW_SCALE_PX / zoom), turn)[inside]
    alike = kept @ sift.describe(moved, Keypoints.at(there[inside])).T
    assert inside.sum() >= 15 and (alike.argmax(axis=1) == np.arange(inside.sum())).mean() > 0.9


@pytest.mark.parametrize("extractor", EXTRACTORS.values(), ids=EXTRACTORS.keys())
def test_an_extractor_finds_and_describes(extractor):
    features = extractor.extract(textured())
    assert len(features) > 50 and features.descriptors.shape == (len(features), extractor.length)
    assert features.descriptors.dtype == np.float32 and (np.diff(features.score) <= 0.0).all()
    some = features.take(np.arange(3))
    assert len(some) == 3 and np.array_equal(some.descriptors, features.descriptors[:3])
    nothing = extractor.extract(np.full((60, 80), 128, np.uint8))
    assert len(nothing) == 0 and nothing.descriptors.shape == (0, extractor.length)
    with pytest.raises(InputError, match="must be grey"):
        extractor.extract(np.zeros((10, 10, 3), dtype=np.uint8))


def squares(places, shape=(120, 160), level=200):
    """Bright squares of 12 px whose upper left corners lie at the places, on black."""
    image = np.zeros(shape, np.uint8)
    for u, v in places:
        image[v : v + 12, u : u + 12] = level
    return image


def texture(image, place):
    """The score at a whole pixel in plain NumPy."""
    u, v = (int(part) for part in place)
    reach = WINDOW_PX // 2 + 1
    grey = image[v - reach : v + reach + 1, u - reach : u + reach + 1].astype(float)
    across = (grey[:-2] + 2.0 * grey[1:-1] + grey[2:]) / 4.0
    down = (grey[:, :-2] + 2.0 * grey[:, 1:-1] + grey[:, 2:]) / 4.0
    slopes = np.stack([(across[:, 2:] - across[:, :-2]).ravel(), (down[2:] - down[:-2]).ravel()]) / 2.0
    return np.sqrt(np.linalg.eigvalsh(slopes @ slopes.T / WINDOW_PX**2)[0])


def test_scores_and_choice_equal_numpys():
    image, detector = textured(0, (80, 100)), CornerDetector()
    px, score = detector.candidates(image, 16, None)
    np.testing.assert_allclose(score, [texture(image, place) for place in px], rtol=1e-9)
    # Of FAST's corners those that no neighbour among them exceeds; of these the best first that are apart.
    fast = (
        np.array([point.pt for point in cv2.FastFeatureDetector.create(10, False).detect(image[13:-13, 13:-13])]) + 13.0
    )
    rated = np.array([texture(image, place) for place in fast])
    highest = [rated[np.abs(fast - place).max(axis=1) <= 1.0].max() for place in fast]
    assert np.array_equal(px, fast[(rated >= highest) & (rated >= detector.min_score)])
    kept = list[int]()
    for row in np.argsort(-score, kind="stable").tolist():
        if all(np.linalg.norm(px[row] - px[other]) >= 8.0 for other in kept):
            kept.append(row)
    assert len(kept) > 10 and np.array_equal(detector.detect(image, 10, None, 8.0).px, px[kept[:10]])


def test_corners_of_squares_and_not_their_edges():
    origins = [(30, 30), (90, 60)]
    px = CornerDetector().detect(squares(origins), 8, None, 6.0, 10.0).px
    truth = np.array([(u + i, v + j) for u, v in origins for i in (0, 11) for j in (0, 11)])
    assert len(px) == 8
    nearest = np.abs(px[:, None] - truth).max(axis=2)
    assert (nearest.min(axis=0) <= 2).all() and (nearest.min(axis=1) <= 2).all()


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
    assert not descriptors_from_histograms(np.zeros((1, 128)), length).any()
