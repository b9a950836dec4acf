"""Descriptors tell places apart, and are the same from a kept window as from the image."""

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.features.corners import corners
from rbpf.sensors.features.sift import LENGTH, describe, describe_windows
from rbpf.sensors.patches.search import cut


def textured(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Blurred noise, grey."""
    noise = np.random.default_rng(seed).normal(size=shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128.0 + 45.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene():
    image = textured()
    px, _ = corners(image, np.zeros((0, 2)), 60, 12.0, 60.0)
    return image, px, np.array([cut(image, place) for place in px])


def test_a_window_has_the_descriptor_of_its_place(scene):
    image, px, windows = scene
    looks = describe_windows(windows, np.ones(len(px)), np.zeros(len(px)))
    assert np.square(looks).sum(axis=1) == pytest.approx(np.ones(len(px)), abs=1e-3)
    assert (looks * describe(image, px)).sum(axis=1).min() > 0.98


@pytest.mark.parametrize(("degrees", "zoom"), [(30.0, 1.0), (-45.0, 1.2), (0.0, 0.7), (10.0, 1.4)])
def test_descriptors_follow_turn_and_scale(scene, degrees, zoom):
    image, px, windows = scene
    motion = cv2.getRotationMatrix2D((159.5, 119.5), degrees, zoom)
    moved = cv2.warpAffine(image, motion, image.shape[::-1], flags=cv2.INTER_AREA)
    there = px @ motion[:, :2].T + motion[:, 2]
    inside = ((there > 25) & (there < [294, 214])).all(axis=1)
    source_from_now = np.linalg.inv(motion[:, :2])
    turn = np.full(len(px), np.arctan2(source_from_now[1, 0], source_from_now[0, 0]))
    looks = describe_windows(windows, np.full(len(px), 1.0 / zoom), turn)[inside]
    alike = looks @ describe(moved, there[inside]).T
    assert inside.sum() >= 15
    assert (alike.argmax(axis=1) == np.arange(inside.sum())).mean() > 0.9


def test_no_place_has_no_descriptor(scene):
    assert describe(scene[0], np.zeros((0, 2))).shape == (0, LENGTH)


def test_a_colour_image_is_refused():
    with pytest.raises(InputError, match="grey"):
        describe(np.zeros((20, 20, 3), dtype=np.uint8), np.array([[10.0, 10.0]]))
