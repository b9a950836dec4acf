"""What every detector, descriptor and extractor keeps: those of the package, and one that a user might write."""

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.features import (
    CornerDetector,
    Descriptor,
    Detector,
    Extractor,
    FeatureExtractor,
    Keypoints,
    Sift,
    SiftConfig,
)
from rbpf.sensors.features.corners import WINDOW_PX
from rbpf.sensors.features.interface import WINDOW_SCALE_PX
from rbpf.sensors.features.sift import descriptors_from_histograms, pooled
from rbpf.sensors.patches.search import cut
from rbpf.sensors.stereo import StereoMatcher
from tests.sensors.patch_scenes import Waves
from tests.sensors.stereo_scenes import RIG, room, true_disparity


class Harris(Detector):
    """Strong responses of the Harris detector."""

    margin_px = 3

    def candidates(self, image, margin_px, mask):
        response = cv2.cornerHarris(image, 5, 3, 0.04)
        best = (response == cv2.dilate(response, np.ones((3, 3), np.uint8))) & (response > 1e-6)
        inside = np.zeros(image.shape, bool)
        inside[margin_px : image.shape[0] - margin_px, margin_px : image.shape[1] - margin_px] = True
        rows, columns = np.nonzero(best & inside & (True if mask is None else mask))
        return np.column_stack([columns, rows]), response[rows, columns].astype(float)


class Grey(Descriptor):
    """Normalised grey values around a keypoint."""

    length = 121

    def describe(self, image, keypoints):
        if image.ndim != 2:
            raise InputError("an image must be grey")
        windows = [cv2.getRectSubPix(image, (11, 11), (float(u), float(v))).ravel() for u, v in keypoints.px]
        values = np.array(windows, dtype=np.float32).reshape(-1, 121)
        values -= values.mean(axis=1, keepdims=True)
        return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), np.float32(1e-6))


DETECTORS = {"corners": CornerDetector(), "harris": Harris()}
DESCRIPTORS = {
    "sift": Sift(SiftConfig(working_scale=1.0, length=128)),
    "sift 36": Sift(SiftConfig(working_scale=1.0)),
    "grey": Grey(),
}
EXTRACTORS: dict[str, FeatureExtractor] = {
    "sift": Sift(),
    "corners and sift": Extractor(DETECTORS["corners"], DESCRIPTORS["sift 36"]),
    "harris and grey": Extractor(DETECTORS["harris"], DESCRIPTORS["grey"]),
}


def textured(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Blurred noise, grey."""
    noise = np.random.default_rng(seed).normal(size=shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128.0 + 45.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)


every_detector = pytest.mark.parametrize("detector", DETECTORS.values(), ids=DETECTORS.keys())
every_descriptor = pytest.mark.parametrize("descriptor", DESCRIPTORS.values(), ids=DESCRIPTORS.keys())
every_extractor = pytest.mark.parametrize("extractor", EXTRACTORS.values(), ids=EXTRACTORS.keys())


@every_detector
def test_a_detector_gives_the_best_first_apart_and_inside(detector):
    image, mask = textured(), np.hypot(*np.ogrid[-120:120, -160:160]) < 110.0
    occupied = np.array([[160.0, 120.0], [np.nan, 3.0]])
    found = detector.detect(image, 30, occupied, 12.0, 20.0, mask)
    assert 10 < len(found) <= 30 and (np.diff(found.score) <= 0.0).all()
    apart = np.linalg.norm(found.px[:, None] - found.px, axis=2)[~np.eye(len(found), dtype=bool)]
    assert apart.min() >= 12.0 and np.linalg.norm(found.px - occupied[0], axis=1).min() >= 12.0
    assert (found.px >= 20.0).all() and (found.px <= np.array([319, 239]) - 20.0).all()
    assert mask[found.px[:, 1].astype(int), found.px[:, 0].astype(int)].all()
    assert np.array_equal(detector.detect(image, 7, occupied, 12.0, 20.0, mask).px, found.px[:7])


@every_detector
def test_a_detector_finds_nothing_where_nothing_is(detector):
    for image in (np.full((60, 80), 128, np.uint8), textured(shape=(12, 300)), np.zeros((0, 0), np.uint8)):
        assert detector.detect(image, 10, border_px=16.0).px.shape == (0, 2)
    assert len(detector.detect(textured(), 0)) == len(detector.detect(textured(), -3)) == 0


@every_detector
def test_what_a_detector_refuses(detector):
    with pytest.raises(InputError, match="must be grey"):
        detector.detect(np.zeros((60, 80, 3), np.uint8), 10)
    with pytest.raises(InputError, match=r"must be \(M, 2\)"):
        detector.detect(textured(), 10, np.zeros(2))


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
    assert inside.sum() >= 15
    assert (alike.argmax(axis=1) == np.arange(inside.sum())).mean() > 0.9


@every_extractor
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


@every_extractor
def test_a_stereo_pair_is_matched_with_any_extractor(extractor):
    pairs, depths, _ = room()
    features = StereoMatcher(RIG, extractor).measure(*pairs[0])
    error = features.z[:, 0] - features.z[:, 2] - true_disparity(depths[0], features.z[:, :2])
    error = error[np.isfinite(error)]
    assert error.size > 20 and np.median(np.abs(error)) < 0.3


NONE = np.zeros((0, 2))


def corners(image, occupied, count, spacing_px=20.0, border_px=16.0, mask=None, **settings):
    """Pixels and scores."""
    found = CornerDetector(**settings).detect(image, count, occupied, spacing_px, border_px, mask)
    return found.px, found.score


@pytest.fixture(scope="module")
def image():
    return Waves(2).image((240, 320))


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


def test_scores_equal_numpys(image):
    px, scores = corners(image, NONE, 100, 8.0, 5.0)
    assert len(px) == 100
    np.testing.assert_allclose(scores, [texture(image, place) for place in px], rtol=1e-4)


def test_corners_of_squares_and_not_their_edges():
    origins = [(30, 30), (90, 60)]
    px, scores = corners(squares(origins), NONE, 8, 6.0, 10.0)
    truth = np.array([(u + i, v + j) for u, v in origins for i in (0, 11) for j in (0, 11)])
    assert len(px) == 8 and (np.diff(scores) <= 0.0).all()
    nearest = np.abs(px[:, None] - truth).max(axis=2)
    assert (nearest.min(axis=0) <= 2).all() and (nearest.min(axis=1) <= 2).all()


@pytest.mark.parametrize("shape", [(0, 0), (7, 300), (10, 10), (11, 11), (101, 97)])
def test_odd_sizes(shape):
    image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    px, scores = corners(image, NONE, 10, border_px=5.0)
    assert px.shape == (len(scores), 2)
    assert (len(px) > 0) == (min(shape) >= 11)


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
