"""The simulated scanner: distances against closed forms, and a log that agrees with its truth."""

import numpy as np
import pytest

from rbpf.cli import main
from rbpf.lie import SE2
from rbpf.runs.trajectory import in_space, read_tum
from rbpf.sensors.readers import read_laser_log
from rbpf.validation.metrics.relations import read_relations, relation_errors
from rbpf.validation.simulation.laser import LaserWorld, cast, floor_plan, simulate_laser
from rbpf.validation.simulation.paths import WheelOdometer


def test_distances_to_walls_are_those_of_triangles():
    square = np.array([(-2.0, -1.0), (3.0, -1.0), (3.0, 4.0), (-2.0, 4.0)])
    walls = np.stack([square, np.roll(square, -1, axis=0)], axis=1)
    here = np.array([np.pi / 2, 1.0, 1.0])  # looking along y
    found = cast(walls, here, np.radians([0.0, -90.0, 90.0, 180.0, -30.0]))
    np.testing.assert_allclose(found, [3.0, 2.0, 3.0, 2.0, 3.0 / np.cos(np.radians(30.0))])
    # The nearest of several, and nothing where there is none.
    assert np.isinf(cast(walls[:1], here, np.zeros(1)))
    np.testing.assert_allclose(cast(np.concatenate([walls, walls * 0.5]), here, np.zeros(1)), 1.0)


def test_every_beam_of_the_corridor_meets_a_wall():
    beams = np.linspace(-np.pi, np.pi, 720)
    for place in ([1.0, 1.0], [15.0, 6.0], [8.0, 11.0]):
        found = cast(floor_plan(), np.array([0.3, *place]), beams)
        assert found.min() > 0.5 and found.max() < 18.0


def test_a_log_agrees_with_its_truth(tmp_path):
    exact = WheelOdometer(scale=0.0, inequality=0.0, wheelbase_error=0.0, slip_m=0.0)
    simulate_laser(LaserWorld(scans=60, std_range_m=0.0, dropouts=0.0, odometer=exact), tmp_path, seed=0)
    log, truth = read_laser_log(tmp_path / "robot.clf"), read_tum(tmp_path / "truth.tum")
    np.testing.assert_array_equal(log.stamps_ns, truth.stamps_ns)
    np.testing.assert_allclose(log.scanner.robot_from_sensor, [0.0, 0.2, 0.0], atol=1e-5)
    # Points of the scans lie on the walls: seen from where the truth says, they are where a ray ends.
    theta = np.arctan2(*(2 * truth.world_from_body[30, [2, 3]])) * 2
    sensor = SE2.compose(np.array([theta, *truth.positions[30, :2]]), log.scanner.robot_from_sensor)
    np.testing.assert_allclose(cast(floor_plan(), sensor, log.scanner.angles), log.ranges[30], atol=1e-3)
    # Odometry without error is the truth, and the relations are the truth's.
    relations = read_relations(tmp_path / "robot.relations")
    assert relation_errors(truth, relations).translations.max() < 1e-6
    assert relation_errors(in_space(log.stamps_ns, log.odometry), relations).translations.max() < 0.02


def test_noise_is_as_stated_and_follows_the_seed(tmp_path):
    for name, seed in {"a": 1, "again": 1, "b": 2}.items():
        simulate_laser(LaserWorld(scans=30), tmp_path / name, seed)
    files = {name: (tmp_path / name / "robot.clf").read_bytes() for name in ("a", "again", "b")}
    assert files["a"] == files["again"] != files["b"]
    a, b = (read_laser_log(tmp_path / name / "robot.clf") for name in "ab")
    assert np.isinf(a.ranges).mean() == pytest.approx(0.01, abs=0.005)
    both = np.isfinite(a.ranges) & np.isfinite(b.ranges)
    difference = a.ranges[both] - b.ranges[both]
    assert difference.std() == pytest.approx(0.01 * np.sqrt(2), rel=0.05)
    path = in_space(a.stamps_ns, a.odometry)
    drift = relation_errors(path, read_relations(tmp_path / "a" / "robot.relations")).translations.max()
    assert 1.0 < drift < 20.0


def test_the_command_writes_a_log(tmp_path, capsys):
    assert main(["simulate", "laser", "--out", str(tmp_path / "log"), "--scans", "5", "--laps", "1"]) == 0
    assert f"wrote {tmp_path}" in capsys.readouterr().err.replace("\n", "")
    assert len(read_laser_log(tmp_path / "log" / "robot.clf").stamps_ns) == 5
