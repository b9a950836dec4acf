"""Known points that cannot be what a run starts from: one clear sentence each."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.pinhole import Pinhole
from rbpf.sensors.readers.images import KnownPixels
from rbpf.systems.mono.known_start import require_texture, resect_known

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
POSE = SE3.exp(np.array([0.2, -0.3, 0.1, 0.5, -0.2, 0.4]))


def points() -> KnownPixels:
    """Six in general position."""
    px = np.array([[40, 50], [280, 60], [60, 200], [260, 190], [150, 110], [100, 150]], dtype=float)
    depth = np.array([1.0, 1.6, 2.2, 1.3, 2.8, 1.1])[:, None]
    local = np.concatenate([CAMERA.unproject(px), np.ones((6, 1))], axis=1) * depth
    return KnownPixels(np.arange(1, 7), px, SE3.transform(POSE, local), np.full(6, 0.001))


def test_the_camera_is_found():
    assert np.abs(SE3.local(resect_known(CAMERA, points(), 1.0), POSE)).max() < 1e-6


def test_points_behind_the_camera():
    """Their mirror images in its centre project to the same pixels."""
    mirrored = 2.0 * SE3.translation(POSE) - points().positions
    with pytest.raises(InputError, match="known points"):
        resect_known(CAMERA, replace(points(), positions=mirrored), 1.0)


@pytest.mark.parametrize("what", ["pixel", "position"])
def test_two_points_at_one_place(what):
    given = points()
    places = given.px if what == "pixel" else given.positions
    places[4] = places[1]
    with pytest.raises(InputError, match=f"known points 2 and 5 have the same {what}: keep one of the two"):
        resect_known(CAMERA, given, 1.0)


def test_points_on_a_line():
    line = np.outer(np.arange(6.0), [0.1, 0.2, 0.3])
    with pytest.raises(InputError, match="lie on a line"):
        resect_known(CAMERA, replace(points(), positions=line), 1.0)


def test_three_points():
    given = points()
    three = KnownPixels(*(column[:3] for column in (given.names, given.px, given.positions, given.std_m)))
    with pytest.raises(InputError, match="at least four"):
        resect_known(CAMERA, three, 1.0)


@pytest.mark.parametrize("shown", ["nothing", "an edge", "a corner"])
def test_a_point_where_the_image_shows_no_corner(shown):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (240, 320)).astype(float)
    u, v = points().px[2].astype(int)
    window = image[v - 10 : v + 11, u - 10 : u + 11]
    window[...] = 120.0
    if shown != "nothing":
        window[:, 10:] = 200.0
    if shown == "a corner":
        window[10:] = 120.0
    window += rng.normal(0.0, 1.0, window.shape)
    image = np.clip(image, 0, 255).astype(np.uint8)
    if shown == "a corner":
        require_texture(image, points())
        return
    with pytest.raises(InputError, match=r"known point 3 at \(60.0, 200.0\) px cannot be found again"):
        require_texture(image, points())
