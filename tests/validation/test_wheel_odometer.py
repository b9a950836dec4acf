"""The simulated odometer: its systematic errors in closed form, its random ones against the sigmas it states."""

from dataclasses import replace

import numpy as np

from rbpf.lie import SE2, SE3
from rbpf.sensors.readers.wheel_odometry import WheelOdometry
from rbpf.validation.simulation.lab import RATE_HZ, ROBOT_FROM_CAMERA, LabDrive, world_from_camera
from rbpf.validation.simulation.paths import WheelOdometer
from rbpf.validation.simulation.textured_scene import stamps_ns

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


def test_a_seed_gives_the_same_readings_and_a_shorter_drive_their_beginning() -> None:
    whole, again, short = (measured(WheelOdometer()), measured(WheelOdometer()), measured(WheelOdometer(), frames=50))
    np.testing.assert_array_equal(whole.delta, again.delta)
    np.testing.assert_array_equal(whole.delta[:49], short.delta)
    assert (measured(WheelOdometer(), seed=1).delta != whole.delta).all(axis=1).mean() > 0.9


def test_by_default_the_odometer_drifts_by_metres_but_not_by_tens() -> None:
    truth = world_from_camera(TRAVELLED.world_from_robot)
    found = measured(WheelOdometer()).world_from_camera(truth[0])
    apart = np.linalg.norm(SE3.translation(found) - SE3.translation(truth), axis=1)
    assert apart[150] < 0.1 and 0.5 < apart.max() < 5.0
