"""Drives of a robot on two wheels, smooth and without slipping sideways, and what the simulated odometer says of them."""

from dataclasses import replace

import numpy as np

from rbpf.lie import SE2, SE3
from rbpf.sensors.readers.wheel_odometry import WheelOdometry
from rbpf.validation.simulation.lab import RATE_HZ, ROBOT_FROM_CAMERA, LabDrive, world_from_camera
from rbpf.validation.simulation.paths import Drive, WheelOdometer, along_corners
from rbpf.validation.simulation.textured_scene import stamps_ns

CORNERS = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (1.0, 5.0)]


def test_a_polyline_is_followed_but_for_its_corners() -> None:
    start, moves = along_corners(CORNERS, 0.8)
    drive = Drive(start, moves, 40.0, 0.5, 1.0)
    x, y = drive.waypoints[:, 1:].T
    ends = [(0, 0), (3.2, 0), (4, 0.8), (4, 2.2)]
    np.testing.assert_allclose(np.stack([x, y], axis=-1)[:4], ends, atol=1e-12)
    side = np.array([-3.0, 2.0]) / np.hypot(3.0, 2.0)
    np.testing.assert_allclose([x[4], y[4]], np.array([4.0, 3.0]) + 0.8 * side, atol=1e-12)
    np.testing.assert_allclose([x[5], y[5]], [1.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(drive.waypoints[-1, 0], np.arctan2(2.0, -3.0), atol=1e-12)
    end = drive(np.array([40.0]))
    np.testing.assert_allclose(end.world_from_robot[0], drive.waypoints[-1], atol=1e-9)
    np.testing.assert_allclose(end.way_m, sum(move.length_m for move in moves), atol=1e-9)


EXACT = WheelOdometer(scale=0.0, inequality=0.0, wheelbase_error=0.0, slip_m=0.0)
TRAVELLED = LabDrive().travelled()
STAMPS = stamps_ns(len(TRAVELLED.way_m), RATE_HZ)


def measured(odometer: WheelOdometer, seed: int = 0, frames: int | None = None) -> WheelOdometry:
    travelled = TRAVELLED if frames is None else LabDrive(frames=frames).travelled()
    rng = np.random.default_rng(seed)
    return odometer.measure(travelled, STAMPS[: len(travelled.way_m)], ROBOT_FROM_CAMERA, rng)


def test_without_errors_dead_reckoning_is_the_path() -> None:
    truth = world_from_camera(TRAVELLED.world_from_robot)
    found = measured(EXACT).world_from_camera(truth[0])
    error = SE3.local(truth, found)
    assert np.abs(error).max() < 2e-4
    assert np.abs(SE3.translation(truth)[:, 2] - 1.0).max() < 1e-12


def test_wrong_wheels_err_as_they_should() -> None:
    odometer = replace(EXACT, scale=0.02, inequality=0.003, wheelbase_error=0.05)
    found = measured(odometer)
    steps = SE2.log(found.delta)
    way = TRAVELLED.way_m[-1]
    half = 0.5 * 0.003 * 0.5 * odometer.wheelbase_m * TRAVELLED.heading_rad[-1]
    np.testing.assert_allclose(steps[:, 1].sum(), 1.02 * way + half, atol=1e-9)
    turned = (1.02 * TRAVELLED.heading_rad[-1] + 0.003 * way / odometer.wheelbase_m) / 1.05
    np.testing.assert_allclose(steps[:, 0].sum(), turned, atol=1e-9)


def test_slip_is_as_great_as_stated() -> None:
    exact, noisy = measured(EXACT), measured(replace(EXACT, slip_m=0.004))
    moving = exact.delta[:, 1] > 1e-3
    score = (SE2.log(noisy.delta) - SE2.log(exact.delta))[moving, :2] / noisy.std[moving, :2]
    n = moving.sum()
    assert n > 3900
    np.testing.assert_allclose(score.var(axis=0), 1.0, atol=5.0 * np.sqrt(2.0 / n))
    assert np.abs(score.mean(axis=0)).max() < 5.0 / np.sqrt(n)
    assert abs(np.corrcoef(score.T)[0, 1]) < 5.0 / np.sqrt(n)
    # A random walk: after the whole way a wheel is wrong by slip · root of the way.
    seeds = [SE2.log(measured(replace(EXACT, slip_m=0.004), seed).delta)[:, 1].sum() for seed in range(60)]
    expected = 0.004 * np.sqrt(TRAVELLED.way_m[-1] / 2.0)
    assert 0.7 < np.std(seeds) / expected < 1.4
