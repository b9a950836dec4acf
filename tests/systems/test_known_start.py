"""Known points that cannot be what a run starts from: one clear sentence each."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import KnownPixels
from rbpf.systems.mono.start.known import (
    ISOTROPIC,
    TRIANGULATED,
    KnownStart,
    constellation_records,
    require_texture,
    resect_known,
)

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
POSE = SE3.exp(np.array([0.2, -0.3, 0.1, 0.5, -0.2, 0.4]))


def points() -> KnownPixels:
    """Six in general position."""
    px = np.array([[40, 50], [280, 60], [60, 200], [260, 190], [150, 110], [100, 150]], dtype=float)
    depth = np.array([1.0, 1.6, 2.2, 1.3, 2.8, 1.1])[:, None]
    local = np.concatenate([CAMERA.unproject(px), np.ones((6, 1))], axis=1) * depth
    return KnownPixels(np.arange(1, 7), px, SE3.transform(POSE, local), np.full(6, 0.001))


def mirrored() -> KnownPixels:
    """Their mirror images in its centre project to the same pixels."""
    return replace(points(), positions=2.0 * SE3.translation(POSE) - points().positions)


def twice(column: str) -> KnownPixels:
    given = points()
    places = getattr(given, column)
    places[4] = places[1]
    return given


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (mirrored(), "known points"),
        (twice("px"), "known points 2 and 5 have the same pixel: keep one of the two"),
        (twice("positions"), "known points 2 and 5 have the same position: keep one of the two"),
        (replace(points(), positions=np.outer(np.arange(6.0), [0.1, 0.2, 0.3])), "lie on a line"),
        (
            KnownPixels(*(getattr(points(), name)[:3] for name in ("names", "px", "positions", "std_m"))),
            "at least four",
        ),
        (replace(points(), positions=points().positions + 5e6), "lie 5e.06 m from the origin but only 1.82 m"),
    ],
    ids=["behind", "one pixel", "one place", "on a line", "three", "far"],
)
def test_no_camera_is_found_by_them(given, words):
    with pytest.raises(InputError, match=words):
        resect_known(CAMERA, given, 1.0)


def test_what_is_given_of_a_point_is_uncertain_along_the_line_of_sight():
    given = replace(points(), std_m=np.linspace(0.01, 0.06, 6))
    start = KnownStart.from_pixels(CAMERA, given, noise_px=1.0)
    located, pose = start.points, start.world_from_camera
    assert np.abs(SE3.local(pose, POSE)).max() < 1e-6
    np.testing.assert_allclose(np.trace(located.cov, axis1=1, axis2=2), given.std_m**2)
    line = given.positions - POSE[4:]
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    along = np.sqrt(np.einsum("ma,mab,mb->m", line, located.cov, line))
    np.testing.assert_allclose(along, given.std_m * np.sqrt(1.0 - 2.0 * TRIANGULATED**2), rtol=1e-6)
    # Or as uncertain across it as is given: here alike in all directions.
    given = replace(given, across_m=given.std_m * ISOTROPIC)
    cov = KnownStart.from_pixels(CAMERA, given, noise_px=1.0).points.cov
    np.testing.assert_allclose(cov, (given.std_m**2 / 3.0)[:, None, None] * np.eye(3), atol=1e-12)


def test_the_first_image_shows_that_points_are_uncertain_across_the_line_of_sight_too():
    rng, std = np.random.default_rng(3), 0.03
    fractions = []
    for error in (0.0, 0.008, 0.03):
        given = replace(points(), std_m=np.full(6, std))
        across = error * rng.standard_normal((6, 3))
        across -= (across @ SE3.rotation(POSE)[:, 2])[:, None] * SE3.rotation(POSE)[:, 2]
        located = KnownStart.from_pixels(CAMERA, replace(given, positions=given.positions + across), 0.3).points
        fractions.append(np.sqrt(np.linalg.eigvalsh(located.cov)[:, 0]) / std)
    np.testing.assert_allclose(fractions[0], TRIANGULATED, rtol=1e-6)
    assert (fractions[1] > 1.5 * TRIANGULATED).all() and (fractions[1] < ISOTROPIC).all()
    np.testing.assert_allclose(fractions[2], ISOTROPIC, rtol=1e-6)


@pytest.mark.slow
def test_points_with_errors_along_the_line_of_sight_place_the_camera_honestly():
    """The squared error of their frame is what its covariance says, 6, but for the least fraction across the line."""
    rng, nees = np.random.default_rng(5), []
    exact, std_px, std_m = points(), 0.5, 0.03
    for _ in range(100):
        px = exact.px + std_px * rng.standard_normal(exact.px.shape)
        seen = np.concatenate([CAMERA.unproject(exact.px), np.ones((6, 1))], axis=1)
        line = seen / np.linalg.norm(seen, axis=1, keepdims=True) @ SE3.rotation(POSE).T
        placed = exact.positions + std_m * rng.standard_normal((6, 1)) * line
        given = replace(exact, px=px, positions=placed, std_m=np.full(6, std_m))
        start = KnownStart.from_pixels(CAMERA, given, std_px)
        group, cov_frame = Constellation(start.points.positions, start.points.cov), np.diag(np.repeat([0.25, 1.0], 3))
        records = constellation_records(CAMERA, start, group, 1, cov_frame)
        frame, factor = (part[0] for part in group.frame(records))
        error = SE3.local(frame, SE3.inverse(POSE))
        nees.append(error @ np.linalg.solve(factor @ factor.T, error))
    assert 4.0 < np.mean(nees) < 6.5


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
    with pytest.raises(InputError, match=r"known point 3 at \(60.0, 200.0\) px cannot be tracked"):
        require_texture(image, points())
