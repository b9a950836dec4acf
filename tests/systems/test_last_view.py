"""Corners of the last view before a loss: on what lines they are, and that other places do not show them."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera.resection import GATE, squared_distances
from rbpf.sensors.features import CornerDetector, Sift, SiftConfig
from rbpf.systems.mono.config import RelocalisationConfig
from rbpf.systems.mono.last_view import LEAST, LastView, mutual
from rbpf.systems.mono.likeness import described
from rbpf.systems.mono.relocalise import agrees, confirmed
from tests.systems.plane_sequences import CAMERA, known_points, texture, view

HERE = SE3.retract(SE3.identity(), np.array([0.02, 0.01, 0.03, 0.05, 0.02, -0.03]))
MOTIONS = {
    "sideways": [0.0, -0.15, 0.05, 0.4, 0.05, 0.0],
    "turning": [0.1, 0.15, 0.1, 0.0, 0.0, 0.0],
    "nearer": [0.0, 0.0, 0.1, 0.05, 0.0, 0.3],
}
SIFT = Sift(SiftConfig(working_scale=1.0, length=128))


@pytest.fixture(scope="module")
def last():
    return LastView(CAMERA, view(texture(), HERE), HERE, CornerDetector(), SIFT, 500, 6.0, 16.0)


def compared(last, image):
    """What is seen again in an image."""
    px = CornerDetector().detect(image, 500, None, 6.0, 16.0).px
    return last.seen_again(described(SIFT, image, px), px, known_points().positions)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_corners_are_found_again_on_their_lines(last, motion):
    there = SE3.retract(HERE, np.array(motion))
    image = view(texture(), there)
    again = compared(last, image)
    assert again is not None
    rows, sights = again
    assert rows.size >= LEAST
    right = squared_distances(CAMERA, there[None], sights)[0] <= GATE
    assert right.mean() > 0.9
    sharp = last.sharpened(image, rows, sights, there)
    # Across its line: what is left of the depth is along it.
    before, after = (
        np.median(squared_distances(CAMERA, there[None], s)[0] * s.std_px**2) for s in (sights, sharp)
    )
    assert after < 0.5 * before
    assert (squared_distances(CAMERA, there[None], sharp)[0][right] <= GATE).mean() > 0.8


def test_another_place_does_not_show_them(last):
    assert compared(last, view(texture(seed=7), HERE)) is None
    assert compared(last, np.full((240, 320), 90, dtype=np.uint8)) is None


def test_without_landmarks_in_view_no_depth_is_known(last):
    image = view(texture(), HERE)
    px = CornerDetector().detect(image, 500, None, 6.0, 16.0).px
    assert last.seen_again(described(SIFT, image, px), px, np.array([[0.0, 0.0, -3.0]])) is None


def test_a_view_without_corners_is_never_seen_again():
    bare = LastView(
        CAMERA, np.full((240, 320), 90, dtype=np.uint8), HERE, CornerDetector(), SIFT, 500, 6.0, 16.0
    )
    assert compared(bare, view(texture(), HERE)) is None


def test_pairs_are_the_most_alike_both_ways():
    alike = np.array([[0.9, 0.1, 0.0], [0.95, 0.2, 0.1], [0.1, 0.8, 0.79]])
    px = np.array([[0.0, 0.0], [50.0, 0.0], [100.0, 0.0]])
    assert [pair.tolist() for pair in mutual(alike, px)] == [[1], [0]]
    px[2] = [55.0, 0.0]  # the rival of the third is the same thing
    assert [pair.tolist() for pair in mutual(alike, px)] == [[1, 2], [0, 1]]


def test_few_landmarks_are_enough_where_most_corners_agree():
    config = RelocalisationConfig()
    assert confirmed(config.few, 90, 100, config)
    assert not confirmed(config.few - 1, 100, 100, config)  # these give the scale
    assert not confirmed(30, 60, 100, config)  # most show another motion
    assert not confirmed(30, LEAST - 1, LEAST - 1, config)
    assert agrees(np.arange(100) < 90)
    assert not agrees(np.arange(100) < 60)
    assert not agrees(np.ones(LEAST - 1, dtype=bool))
