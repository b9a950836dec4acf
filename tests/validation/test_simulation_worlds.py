"""Simulated cameras in a hand: their paths, and what their worlds hold."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, PointWorld, Scene, hidden, simulate_features
from rbpf.lie import SE3
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.simulation.paths import HandHeld, looking, slowed, speeds

DESK = DeskWorld()
SEEDS = range(2)


def built(world: PointWorld, seed: int) -> Scene:
    return world.build(np.random.default_rng(seed))


@cache
def measured(world: PointWorld) -> FeatureLog:
    return simulate_features(world, Measuring(), MONO, seed=0)


def derivatives(world: DeskWorld, seed: int) -> list[np.ndarray]:
    """Speed, acceleration and jerk of the camera's centre, from differences."""
    values, out = built(world, seed).world_from_camera[:, 4:], []
    for _ in range(3):
        values = np.diff(values, axis=0) * world.rate_hz
        out.append(np.linalg.norm(values, axis=1))
    return out


@pytest.mark.parametrize("seed", SEEDS)
def test_paths_are_those_of_a_hand(seed: int) -> None:
    world = DESK
    scene = built(world, seed)
    turn, speed = speeds(scene.world_from_camera, scene.stamps_ns * 1e-9)
    assert 0.1 < turn.max() < 0.9
    assert 0.5 * world.hand.speed_m_s < speed.max() < world.hand.speed_m_s + 0.4
    _, acceleration, jerk = derivatives(world, seed)
    assert acceleration.max() < 4.0
    assert jerk.max() < 30.0


def test_paths_are_smooth() -> None:
    """A jump in speed or acceleration would make the differences ten times as large at ten times the rate."""
    world = DESK
    slow = replace(world, frames=600)
    fast = replace(slow, frames=6000, rate_hz=300.0)
    for coarse, fine in zip(derivatives(slow, 0), derivatives(fast, 0), strict=True):
        assert fine.max() < 1.3 * coarse.max() + 0.05


@pytest.mark.parametrize("seed", SEEDS)
def test_a_desk_is_seen_from_its_distance(seed: int) -> None:
    world = DeskWorld(hand=HandHeld(wander=0.0, wrist_deg=0.0, tremor_m=0.0, tremor_deg=0.0))
    scene = built(world, seed)
    middle = SE3.inverse_transform(scene.world_from_camera, [0.0, 0.0, 0.5])
    assert (middle[:, 2] > 1.0).all() and (middle[:, 2] < 1.5).all()
    np.testing.assert_allclose(middle[:, :2], 0.0, atol=1e-12)
    turn, speed = speeds(scene.world_from_camera, scene.stamps_ns * 1e-9)
    # The limits are kept between the images of the path before it is slowed down.
    assert turn.max() < 1.01 * world.hand.turn_rad_s and speed.max() < 1.01 * world.hand.speed_m_s


def test_the_desk_stays_in_view() -> None:
    log = measured(DESK)
    assert min(len(frame.landmarks) for frame in log.frames) >= 15
    depth = [SE3.inverse_transform(pose, [0.0, 0.0, 0.5])[2] for pose in log.truth.world_from_camera]
    assert 0.9 < np.median(depth) < 1.6


@pytest.mark.parametrize("seed", SEEDS)
def test_neither_camera_nor_points_are_in_a_block(seed: int) -> None:
    world = DESK
    scene = built(world, seed)
    assert len(scene.blocks) > 2
    assert (scene.blocks[:, 0] < scene.blocks[:, 1]).all()
    for points in (scene.world_from_camera[:, 4:], scene.points):
        within = (points[:, None] > scene.blocks[:, 0]) & (points[:, None] < scene.blocks[:, 1])
        assert not within.all(axis=-1).any()


def test_a_camera_looks_at_what_it_should() -> None:
    eye, target = np.array([[1.0, -2.0, 0.5]]), np.array([-0.3, 1.0, 0.2])
    pose = looking(eye, target - eye)
    np.testing.assert_allclose(SE3.inverse_transform(pose, target)[0, :2], 0.0, atol=1e-12)
    above = SE3.inverse_transform(pose, target + np.array([0.0, 0.0, 0.1]))[0]
    assert abs(above[0]) < 1e-12 and above[1] < 0.0 < above[2]


@pytest.mark.parametrize(("limits", "pace"), [((0.5, 9.0), 0.25), ((9.0, 0.5), 0.5), ((9.0, 9.0), 1.0)])
def test_a_path_is_slowed_down_and_never_sped_up(limits: tuple[float, float], pace: float) -> None:
    def path(time: np.ndarray) -> np.ndarray:
        return SE3.exp(time[:, None] * np.array([0.0, 0.0, 1.0, 0.0, 0.0, 2.0]))

    seconds = np.linspace(0.0, 2.0, 50)
    np.testing.assert_allclose(slowed(path, seconds, *limits)(seconds), path(pace * seconds), atol=1e-12)


def test_blocks_hide_from_behind_and_show_their_faces() -> None:
    block = np.array([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]])
    eye = np.array([-1.0, 0.5, 0.4])
    behind, before, beside, front, back = ([2, 0.5, 0.5], [-0.1, 0.5, 0.5], [2, 3, 0.5], [0, 0.7, 0.3], [1, 0.7, 0.3])
    points = np.array([behind, before, beside, front, back, [-3.0, 0.5, 0.4]])
    assert hidden(eye, points, block).tolist() == [True, False, False, False, True, False]
