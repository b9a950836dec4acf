"""Pixels after a motion, the innovation of matches, and the consensus of triples: derivatives, infinity, false matches."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.motion.stereo_consensus import RansacConfig, _Search, consensus, triples
from rbpf.motion.stereo_geometry import Matches, linearised, reproject, residuals, squared_distances, white_rows
from tests.motion.stereo_pairs import CAR, LEAP, ROAD, ROOM, World, correlated, mistaken, noiseless, simulate

worlds = pytest.mark.parametrize("world", [ROAD, LEAP], ids=["road", "leap"])


@worlds
def test_points_are_seen_where_the_camera_projects_them(world):
    before, now, delta = noiseless(world, 50, np.random.default_rng(0))
    seen = reproject(world.camera, delta, before)
    np.testing.assert_allclose(seen.pixels, now, atol=1e-9)
    np.testing.assert_allclose(seen.inverse_depth, 1.0 / world.camera.triangulate(before)[:, 2], rtol=1e-9)
    assert seen.front.all()


def test_infinity_is_nowhere_special():
    """Pixels and derivatives go on smoothly where the disparity becomes negative."""
    delta = SE3.exp(np.array(ROAD.xi))
    disparity = np.array([0.02, 0.01, 0.0, -0.01, -0.02])
    pixels = np.stack([np.full(5, 700.0), np.full(5, 100.0), 700.0 - disparity], axis=1)
    seen = reproject(CAR, delta, pixels)
    assert seen.front.all()
    np.testing.assert_allclose(np.diff(seen.pixels, n=2, axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(np.diff(seen.by_motion, n=2, axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(seen.by_motion[2, :, 3:], 0.0, atol=1e-11)
    # A direction alone, turned.
    ray = SE3.rotation(delta).T @ [*CAR.camera.unproject(pixels[2, :2]), 1.0]
    np.testing.assert_allclose(seen.pixels[2, :2], CAR.camera.project(ray), rtol=1e-12)


every_kind = pytest.mark.parametrize("points", ["adjusted", "propagated", "exact"])


@every_kind
def test_points_behind_the_camera(points):
    matches, _ = correlated(LEAP, 150, np.random.default_rng(1))
    past = SE3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.0]))
    behind = LEAP.camera.triangulate(matches.z_prev)[:, 2] < 2.9
    rows, front, _ = white_rows(matches, past, points)
    distances = squared_distances(matches, past, points)
    assert behind.any() and not front[behind].any()
    np.testing.assert_array_equal(rows[~front], 0.0)
    np.testing.assert_array_equal(np.isinf(distances), ~front)
    np.testing.assert_array_equal(distances[front], np.square(rows[front, :, 0]).sum(axis=1))
    assert np.isinf(residuals(matches, past, points)[0]).all()


def test_the_earlier_points_covariance_in_space():
    """A R⁻ Aᵀ = J_P C J_Pᵀ, with the derivatives of the camera itself."""
    matches, delta = correlated(ROAD, 20, np.random.default_rng(2))
    camera = matches.camera
    before = camera.triangulate(matches.z_prev)
    by_z = np.linalg.inv(camera.jacobian(before))
    cov_points = by_z @ matches.cov_prev @ by_z.mT
    by_point = camera.jacobian(SE3.inverse_transform(delta, before)) @ SE3.rotation(delta).T
    expected = matches.cov_now + by_point @ cov_points @ by_point.mT
    np.testing.assert_allclose(linearised(matches, delta, matches.z_prev, "propagated")[0], expected, rtol=1e-8)
    np.testing.assert_array_equal(linearised(matches, delta, matches.z_prev, "exact")[0], matches.cov_now)


GATE = 11.345


def test_triples_are_three_and_equally_likely():
    drawn = triples(5, 60_000, np.random.default_rng(0))
    assert (np.diff(np.sort(drawn, axis=1), axis=1) > 0).all()
    code = drawn @ [25, 5, 1]
    counts = np.unique(code, return_counts=True)[1]
    assert len(counts) == 60
    assert np.square(counts - 1000.0).sum() / 1000.0 < 105.0  # χ² with 59 degrees of freedom, 99.98 %
    np.testing.assert_array_equal(np.sort(triples(3, 20, np.random.default_rng(1)), axis=1), [[0, 1, 2]] * 20)


def test_a_motion_of_any_size():
    """Half a turn about the optical axis and a metre, which no iteration from rest would find."""
    world = World(ROOM.camera, 2.0, 6.0, (0.0, 0.0, 3.0, 0.3, -0.2, 0.5))
    rng = np.random.default_rng(4)
    pair = simulate(world, 150, rng)
    matches, _ = mistaken(pair, 0.3, rng)
    found = consensus(matches, SE3.identity(), GATE, rng)
    assert np.abs(SE3.local(pair.delta, found)).max() < 0.1


def test_a_good_guess_takes_part():
    """So few matches are true that no triple of the first batch is."""
    rng = np.random.default_rng(8)
    pair = simulate(ROOM, 300, rng)
    matches, _ = mistaken(pair, 0.97, rng)
    blind, guided = (
        consensus(matches, start, GATE, np.random.default_rng(9), RansacConfig(max_triples=32))
        for start in (SE3.identity(), SE3.retract(pair.delta, 1e-3 * np.ones(6)))
    )
    assert np.abs(SE3.local(pair.delta, blind)).max() > 0.05
    assert np.abs(SE3.local(pair.delta, guided)).max() < 0.05


@pytest.mark.parametrize(("fraction", "needed"), [(0.5, 68.98), (0.3, 336.4)])
def test_how_many_triples_it_takes(fraction, needed):
    """log(1 − p) / log(1 − w³), Fischler and Bolles (1981)."""
    assert RansacConfig().needed(fraction) == pytest.approx(needed, rel=1e-3)
    assert RansacConfig().needed(1.0) <= 1.0
    assert RansacConfig().needed(0.0) == np.inf


@pytest.mark.parametrize("world", [ROAD, ROOM, LEAP], ids=["road", "room", "leap"])
@pytest.mark.parametrize("start", [SE3.identity(), SE3.exp(np.full(6, 0.1))], ids=["at rest", "guessed"])
def test_every_triple_without_noise_proposes_the_motion(world, start):
    rng = np.random.default_rng(11)
    before, now, delta = noiseless(world, 60, rng)
    cov = np.tile(np.eye(3), (60, 1, 1))
    found = _Search(Matches(world.camera, before, now, cov, cov), start).candidates(triples(60, 300, rng))
    # Of triples that lie nearly on a line rounding makes something else.
    off = np.abs(SE3.local(delta, found)).max(axis=1)
    assert np.quantile(off, 0.95) < 1e-6


def test_a_score_counts_what_is_within_the_gate_and_in_front():
    rng = np.random.default_rng(10)
    matches = correlated(LEAP, 50, rng).matches
    search = _Search(matches, SE3.identity())
    motions = SE3.exp(rng.normal(scale=[0.1] * 3 + [0.5, 0.5, 2.0], size=(20, 6)))
    motions[0] = SE3.exp(np.array(LEAP.xi))
    seen = reproject(matches.camera, motions, np.broadcast_to(matches.z_prev, (20, 50, 3)))
    miss = (search.white @ (matches.z_now - seen.pixels)[..., None])[..., 0]
    squared = np.where(seen.front, np.square(miss).sum(axis=-1), np.inf)
    score, fraction = search.scores(motions, GATE)
    assert np.isinf(squared).any() and (squared <= GATE).any()
    np.testing.assert_allclose(score, np.minimum(squared, GATE).sum(axis=1), rtol=1e-9)
    np.testing.assert_array_equal(fraction, (squared <= GATE).mean(axis=1))


def test_triples_that_coincide_or_lie_on_a_line_propose_something():
    rng = np.random.default_rng(12)
    matches = simulate(ROOM, 9, rng).matches
    for array in (matches.z_prev, matches.z_now):
        array[1:3] = array[0]
        array[3:6] = array[0] + np.outer([1.0, 2.0, 3.0], [9.0, 2.0, 9.0])
    rows = np.array([[0, 1, 2], [3, 4, 5], [0, 1, 7]])
    assert np.isfinite(_Search(matches, SE3.identity()).candidates(rows)).all()
