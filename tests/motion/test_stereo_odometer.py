"""A path by visual odometry alone, and what is assumed where a frame tells nothing."""

from typing import NamedTuple

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.motion.stereo_odometer import Prediction, StereoOdometer, chain, match_names, odometry_path
from rbpf.motion.stereo_vo import VoConfig
from rbpf.sensors.feature_log import FeatureFrame
from tests.motion.stereo_pairs import CAR, HAND, ROAD, ROOM, World, simulate

TWIST = np.array([0.1, 0.6, -0.05, 0.2, 0.1, 0.9])
DT = 0.1
COV = 0.25 * np.eye(3)


class Walk(NamedTuple):
    frames: list[FeatureFrame]
    path: np.ndarray


def walk(count=12, seed=0, noise_px=0.5) -> Walk:
    """A camera at constant velocity in a cloud of points around it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-6.0, -3.0, -6.0], [6.0, 3.0, 6.0], (3000, 3))
    path = SE3.exp(DT * np.arange(count)[:, None] * TWIST)
    frames = []
    for step, pose in enumerate(path):
        local = SE3.inverse_transform(pose, points)
        seen = np.flatnonzero(HAND.visible(local, 10.0) & (local[:, 2] > 0.8))[:150]
        z = HAND.project(local[seen]) + noise_px * rng.normal(size=(len(seen), 3))
        cov = np.tile(noise_px**2 * np.eye(3), (len(seen), 1, 1))
        frames.append(FeatureFrame(step * 100_000_000, seen.astype(np.int64), z, cov))
    return Walk(frames, path)


def odometer(camera=HAND, seed=0, **prediction) -> StereoOdometer:
    return StereoOdometer(camera, np.random.default_rng(seed), VoConfig(), Prediction(**prediction))


def test_names_are_matched_in_any_order():
    before, now = np.array([7, 3, 9, 1]), np.array([9, 2, 7])
    first, second = match_names(before, now)
    np.testing.assert_array_equal(before[first], now[second])
    np.testing.assert_array_equal(np.sort(before[first]), [7, 9])


def test_chain():
    increments = SE3.exp(np.random.default_rng(1).normal(size=(4, 6)))
    path = chain(increments)
    matrix = np.eye(4)
    for row, delta in zip(path[1:], increments, strict=True):
        matrix = matrix @ SE3.matrix(delta)
        np.testing.assert_allclose(SE3.matrix(row), matrix, atol=1e-12)
    np.testing.assert_array_equal(chain([]), SE3.identity((1,)))


def test_the_path():
    frames, path = walk()
    found, steps = odometry_path(odometer(), frames)
    assert found.shape == path.shape and len(steps) == len(path) - 1
    for row, step in enumerate(steps):
        assert (step.note, step.estimate.found) == ("", True)
        off = SE3.local(step.odometry.delta, SE3.between(path[row], path[row + 1]))
        assert off @ np.linalg.solve(step.odometry.cov, off) < 27.9  # χ²₆, 99.99 %
    assert np.linalg.norm(found[-1, 4:] - path[-1, 4:]) < 0.03
    np.testing.assert_array_equal(found, chain([step.odometry.delta for step in steps]))


def test_the_same_seed_gives_the_same_bytes():
    frames, _ = walk(4)
    one, two = (odometry_path(odometer(seed=3), frames)[0] for _ in range(2))
    assert one.tobytes() == two.tobytes()


@pytest.mark.parametrize("keep", [True, False])
def test_a_frame_without_texture_keeps_the_last_velocity_or_rests(keep):
    frames, path = walk(6)
    blind = FeatureFrame(frames[3].stamp_ns, np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
    frames[3] = blind
    tracker = odometer(std_turn=0.5, std_speed=2.0, keep_velocity=keep)
    found, steps = odometry_path(tracker, frames)
    assert [bool(step.note) for step in steps] == [False, False, True, True, False]
    what = "the last velocity" if keep else "a camera at rest"
    assert steps[2].note == f"0 matches are there, 8 are needed; {what} is assumed, widely"
    expected = np.diag(DT**2 * np.repeat([0.25, 4.0], 3))
    np.testing.assert_allclose(steps[2].odometry.cov, expected, rtol=1e-12)
    if keep:
        assert np.linalg.norm(found[-1, 4:] - path[-1, 4:]) < 0.03
    else:
        np.testing.assert_array_equal(steps[2].odometry.delta, SE3.identity())


def test_a_dropped_pair_is_a_longer_step():
    frames, path = walk(7)
    del frames[3]
    found, steps = odometry_path(odometer(), frames)
    assert not any(step.note for step in steps)
    np.testing.assert_allclose(found[-1, 4:], path[-1, 4:], atol=0.03)


def test_far_points_are_joined_with_the_expected_motion():
    """The turn is that of the points; along the way the prediction speaks."""
    pair = simulate(World(CAR, 1e5, 1e6, ROAD.xi), 200, np.random.default_rng(0), 0.5)
    tracker = odometer(CAR, std_speed=2.0)
    tracker.velocity = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 10.0])
    m = pair.matches
    step = tracker.step(m.z_prev, m.z_now, m.cov_prev, m.cov_now, DT)
    assert step.note.startswith("the matches leave the motion open (a standard deviation ")
    std = np.sqrt(np.diagonal(step.odometry.cov))
    assert std[:3].max() < 1e-3 and (std[3:] > 0.15).all() and (std[3:] <= 0.2).all()
    off = SE3.local(pair.delta, step.odometry.delta)
    assert (np.abs(off) < 4.0 * std).all()


def test_joining_is_a_product_of_gaussians():
    pair = simulate(World(CAR, 300.0, 3000.0, ROAD.xi), 60, np.random.default_rng(1), 0.5)
    tracker = odometer(CAR, std_speed=2.0)
    tracker.velocity = np.concatenate([np.array(ROAD.xi)[:3], [0.0, 0.0, 0.85]]) / DT
    expected = tracker.prediction.law(tracker.velocity, DT)
    m = pair.matches
    step = tracker.step(m.z_prev, m.z_now, m.cov_prev, m.cov_now, DT)
    info = np.linalg.inv(expected.cov) + np.linalg.inv(step.estimate.cov)
    np.testing.assert_allclose(step.odometry.cov, np.linalg.inv(info), rtol=1e-6, atol=1e-12)
    off = SE3.local(expected.delta, step.estimate.previous_camera_from_camera)
    mean = np.linalg.solve(info, np.linalg.solve(step.estimate.cov, off))
    np.testing.assert_allclose(SE3.local(expected.delta, step.odometry.delta), mean, atol=1e-9)


def test_points_in_one_place_are_joined_with_the_expected_motion():
    z = np.tile(HAND.project(np.array([0.1, 0.1, 3.0])), (20, 1))
    step = odometer().step(z, z, np.tile(COV, (20, 1, 1)), np.tile(COV, (20, 1, 1)), DT)
    assert step.note
    assert np.linalg.eigvalsh(step.odometry.cov).min() > 0.0
    assert (np.sqrt(np.diagonal(step.odometry.cov)) <= DT + 1e-12).all()


def test_what_makes_no_sense_is_refused():
    m = simulate(ROOM, 20, np.random.default_rng(0)).matches
    with pytest.raises(InputError, match=r"needs time between its frames, got 0\.0 s"):
        odometer().step(m.z_prev, m.z_now, m.cov_prev, m.cov_now, 0.0)
    with pytest.raises(InputError, match=r"must be positive, got 0\.0 and 1\.0"):
        Prediction(std_turn=0.0)
