"""Chained motions and what is assumed between them."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_odometer import StereoOdometer
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.systems.stereo.config import TriggerConfig
from rbpf.systems.stereo.dead_reckoning import DeadReckoning, Pixels, chained, standstill
from rbpf.systems.stereo.run import triggered

RIG = RectifiedStereo(Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5), 0.12)
SECOND = 1_000_000_000


def spread(seed: int, scale: float) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return scale**2 * (root @ root.T)


def test_chained_covariance_against_samples():
    rng = np.random.default_rng(0)
    first, second = (Odometry(SE3.exp(rng.normal(size=6)), spread(seed, 1e-3)) for seed in (1, 2))
    both = chained(first, second)
    n = 40_000
    errors = [rng.multivariate_normal(np.zeros(6), motion.cov, n) for motion in (first, second)]
    moved = SE3.compose(SE3.retract(first.delta, errors[0]), SE3.retract(second.delta, errors[1]))
    np.testing.assert_allclose(both.delta, SE3.compose(first.delta, second.delta))
    sampled = np.cov(SE3.local(both.delta, moved).T)
    size = np.sqrt(np.diagonal(both.cov))
    np.testing.assert_allclose(sampled / np.outer(size, size), both.cov / np.outer(size, size), atol=0.03)


def scene(moves: list[np.ndarray], count: int = 60) -> list[np.ndarray]:
    """Pixels (K, 3) of the same points from cameras that are moved one after the other."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-1.5, -1.0, 3.0], [1.5, 1.0, 6.0], size=(count, 3))
    pose, seen = SE3.identity(), []
    for move in moves:
        pose = SE3.compose(pose, SE3.exp(move))
        seen.append(RIG.project(SE3.inverse_transform(pose, points)))
    return seen


def reckoned(dof: int, late: bool) -> tuple[DeadReckoning, list]:
    """Three pairs; the middle one is missing where `late`."""
    step = np.array([0.01, 0.03, -0.02, 0.05, 0.02, 0.04])
    seen = scene([np.zeros(6), step, step])
    cov = np.tile(0.01 * np.eye(3), (60, 1, 1))
    chain = DeadReckoning(StereoOdometer(RIG, np.random.default_rng(0)), dof)
    out = [chain.begin(0)]
    rng = np.random.default_rng(1)
    if late:
        out.append(chain.assumed(SECOND))
        out.append(chain.measured(2 * SECOND, Pixels(seen[0], seen[2], cov, cov), rng))
    else:
        out.append(chain.measured(SECOND, Pixels(seen[0], seen[1], cov, cov), rng))
        out.append(chain.measured(2 * SECOND, Pixels(seen[1], seen[2], cov, cov), rng))
    return chain, out


def test_over_a_missing_pair():
    """Exact pixels: the motion is found, whether in two steps or in one over the missing pair."""
    step = SE3.exp(np.array([0.01, 0.03, -0.02, 0.05, 0.02, 0.04]))
    for late in (False, True):
        _, at = reckoned(6, late)
        np.testing.assert_allclose(at[2].world_from_camera, SE3.compose(step, step), atol=1e-6)
        np.testing.assert_allclose(at[2].since_update.delta, at[2].world_from_camera, atol=1e-12)
        assert at[2].agreeing == 60
    _, at = reckoned(6, True)
    np.testing.assert_array_equal(at[1].world_from_camera, SE3.identity())
    assert np.sqrt(at[1].since_update.cov[3, 3]) == 1.0  # the expected speed's deviation, after a second
    assert at[2].since_update.cov.diagonal().max() < 1e-2


def test_an_update_takes_the_motion_and_leaves_the_path():
    chain, at = reckoned(6, False)
    chain.updated()
    ahead = chain.assumed(3 * SECOND)
    np.testing.assert_array_equal(at[2].world_from_camera, chain._at.world_from_camera)
    expected = SE3.exp(chain.odometer.velocity)
    np.testing.assert_allclose(ahead.since_update.delta, expected, atol=1e-12)
    np.testing.assert_allclose(
        ahead.world_from_camera, SE3.compose(at[2].world_from_camera, expected), atol=1e-12
    )


def test_in_the_plane():
    _, at = reckoned(3, False)
    turned = SE3.log(at[2].world_from_camera)
    np.testing.assert_allclose(turned[[0, 2, 4]], 0.0, atol=1e-12)
    assert abs(turned[1]) > 0.05
    np.testing.assert_allclose(at[2].since_update.cov[[0, 2, 4]], 0.0, atol=1e-12)


def test_pairs_that_were_passed_over_are_counted_until_the_motion_is_found():
    chain, at = reckoned(6, True)
    assert [each.assumed for each in at] == [0, 1, 0]
    assert [chain.assumed(t * SECOND).assumed for t in (3, 4)] == [1, 2]


def test_time_has_to_pass():
    chain, _ = reckoned(6, False)
    assert [chain.is_later(t * SECOND) for t in (1, 2, 3)] == [False, False, True]


def test_before_the_first_pair_nothing_moves():
    chain = DeadReckoning(StereoOdometer(RIG, np.random.default_rng(0)), 6)
    np.testing.assert_array_equal(chain.assumed(SECOND).world_from_camera, SE3.identity())
    assert not chain.begun


def test_state_is_kept():
    chain, _ = reckoned(6, False)
    other = DeadReckoning(StereoOdometer(RIG, np.random.default_rng(9)), 6)
    other.restore(chain.arrays())
    one, two = chain.assumed(3 * SECOND), other.assumed(3 * SECOND)
    np.testing.assert_array_equal(one.world_from_camera, two.world_from_camera)
    np.testing.assert_array_equal(one.since_update.cov, two.since_update.cov)


def test_what_triggers():
    config = TriggerConfig(moved_m=0.1, turned_rad=0.2, frames=5)
    assert not triggered(standstill(), config, 1)
    assert triggered(standstill(), config, 5)
    assert not triggered(standstill(), TriggerConfig(0.1, 0.2), 500)
    assert triggered(standstill(), TriggerConfig(0.0, 1.0), 1)
    for axis, size, enough in ((4, 0.09, False), (4, 0.11, True), (0, 0.19, False), (1, 0.21, True)):
        motion = Odometry(SE3.exp(size * np.eye(6)[axis]), np.zeros((6, 6)))
        assert triggered(motion, config, 1) == enough
    doubt = Odometry(SE3.identity(), np.diag([0.0, 0.0, 0.0, 0.01, 0.0, 1e-4]))
    assert triggered(doubt, config, 1)


@pytest.mark.parametrize(
    ("name", "damaged"), [("velocity", np.zeros(5)), ("cov", np.zeros(6)), ("missed", np.zeros(4))]
)
def test_a_damaged_checkpoint_is_refused(name, damaged):
    chain, _ = reckoned(6, False)
    with pytest.raises(InputError, match=name):
        chain.restore(chain.arrays() | {f"reckoning/{name}": damaged})
