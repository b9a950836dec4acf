"""Which corners are chosen."""

import numpy as np
import pytest

from rbpf.sensors.features import CornerDetector
from rbpf.sensors.features.corners import WINDOW_PX
from tests.sensors.patch_scenes import Waves

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


def test_none_is_beside_a_better_one(image):
    px, scores = corners(image[:120, :140], NONE, 10**6, 0.0, 16.0)
    beside = np.abs(px[:, None] - px).max(axis=2) == 1.0
    assert len(px) > 100 and not (beside & (scores[:, None] != scores)).any()


def test_corners_of_squares_and_not_their_edges():
    origins = [(30, 30), (90, 60)]
    px, scores = corners(squares(origins), NONE, 8, 6.0, 10.0)
    truth = np.array([(u + i, v + j) for u, v in origins for i in (0, 11) for j in (0, 11)])
    assert len(px) == 8 and (np.diff(scores) <= 0.0).all()
    nearest = np.abs(px[:, None] - truth).max(axis=2)
    assert (nearest.min(axis=0) <= 2).all() and (nearest.min(axis=1) <= 2).all()


@pytest.mark.parametrize("border_px", [0.0, 5.0, 16.0, 60.5])
def test_inside_the_border(image, border_px):
    px, _ = corners(image, NONE, 1000, 4.0, border_px)
    least = max(border_px, CornerDetector.margin_px)
    assert len(px) > 20 and px.min() >= least
    assert (px <= np.array([319, 239]) - least).all()
    assert px.min(axis=0).max() < least + 8 and (px.max(axis=0) > np.array([319, 239]) - least - 8).all()


def test_equal_squares_share_the_places():
    """Where scores tie there is still one corner for each, at the same place of each."""
    origins = np.array([(90, 30), (30, 30), (30, 70)])
    px, scores = corners(squares(origins), NONE, 3, 20.0, 10.0)
    np.testing.assert_allclose(scores, scores[0], rtol=1e-5)
    assert sorted(map(tuple, px - px.min(axis=0))) == [(0.0, 0.0), (0.0, 40.0), (60.0, 0.0)]


def test_the_threshold_on_texture(image):
    _, scores = corners(image, NONE, 1000, 5.0, 16.0, min_score=0.0)
    middle = float(np.median(scores))
    _, rich = corners(image, NONE, 1000, 5.0, 16.0, min_score=middle)
    assert scores.min() < middle <= rich.min()


def test_a_dark_image_gives_corners_once_asked_for_faint_ones():
    dark = squares([(30, 30), (90, 60)], level=8)
    assert len(corners(dark, NONE, 10)[0]) == 0
    assert len(corners(dark, NONE, 10, 6.0, fast_threshold=3, min_score=0.2)[0]) == 8


@pytest.mark.parametrize("shape", [(1, 1), (0, 0), (7, 300), (10, 10), (11, 11), (33, 33), (101, 97)])
def test_odd_sizes(shape):
    image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    px, scores = corners(image, NONE, 10, border_px=5.0)
    assert px.shape == (len(scores), 2)
    assert (len(px) > 0) == (min(shape) >= 11)
