"""The simulated laboratory: plan, drives, furniture, its twin in points, and its images."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tyro

from examples.studies.drives import Drive, along_corners
from examples.studies.lab import RATE_HZ, ROBOT_FROM_CAMERA, LabDrive, TexturedLab, simulate_lab, world_from_camera
from examples.studies.wheel_odometry import WheelOdometry, read_wheel_odometry, write_wheel_odometry
from rbpf.lie import SE2, SE3
from rbpf.runs.trajectory import in_space, read_tum
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import open_images, open_stereo, read_known_points, read_laser_log
from rbpf.validation.metrics.relations import read_relations, relation_errors
from rbpf.validation.simulation import laser
from rbpf.validation.simulation.laser import LaserWorld, WheelOdometer, floor_plan, simulate_laser
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import TexturedScene, cast, stamps_ns

CAMERA = Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)
TOUR = LabDrive().travelled()
EXACT = WheelOdometer(scale=0.0, inequality=0.0, wheelbase_error=0.0, slip_m=0.0)


@cache
def drawn() -> TexturedScene:
    return TexturedLab(LabDrive(every=400), texel_m=0.2).build(np.random.default_rng(0))


def test_the_tour_is_as_long_as_that_of_the_paper() -> None:
    assert len(TOUR.way_m) == 4000
    assert 67.0 < TOUR.way_m[-1] < 68.5
    step = SE2.local(TOUR.world_from_robot[:-1], TOUR.world_from_robot[1:])
    assert np.abs(step[:, 2]).max() < 1e-4
    assert np.diff(TOUR.way_m).max() < 0.02 and np.abs(step[:, 0]).max() < np.deg2rad(1.5)


def test_the_renderer_sees_what_single_rays_see() -> None:
    """Thousands of rectangles, most of them hidden: no tile may drop one that is seen."""
    scene = drawn()
    renderer = Renderer(scene.rectangles, CAMERA, grid=1)
    px = np.random.default_rng(0).uniform(0.0, 1.0, (400, 2)) * [319, 239]
    px = np.round(px)
    column, row = px.astype(int).T
    assert len(scene.rectangles) > 1500
    for pose in scene.world_from_camera[::5]:
        depth, seen = renderer.depth(pose)
        expected, rows = cast(scene.rectangles, pose, CAMERA.unproject(px))
        np.testing.assert_allclose(depth[row, column], expected, rtol=1e-12)
        # Where two boxes touch, two faces are at the same place.
        assert (seen[row, column] == rows).mean() > 0.99 and np.isfinite(expected).all()


def test_the_folder_holds_what_the_wheels_say(tmp_path: Path) -> None:
    world = TexturedLab(LabDrive(frames=9, every=6), texel_m=0.5)
    write_wheel_odometry(tmp_path, world.wheels(seed=0))
    odometry, scene = read_wheel_odometry(tmp_path), world.build(np.random.default_rng(0))
    assert len(odometry.stamps_ns) == 49
    np.testing.assert_array_equal(odometry.stamps_ns[::6], scene.stamps_ns)
    np.testing.assert_allclose(odometry.robot_from_camera, ROBOT_FROM_CAMERA)
    reckoned = odometry.world_from_camera(scene.world_from_camera[0])[::6]
    apart = np.linalg.norm(reckoned[:, 4:] - scene.world_from_camera[:, 4:], axis=1)
    assert 0.0 < apart[-1] < 0.08 * TOUR.way_m[48]


# The simulated scanner: distances against closed forms, and a log that agrees with its truth.


def test_distances_to_walls_are_those_of_triangles():
    square = np.array([(-2.0, -1.0), (3.0, -1.0), (3.0, 4.0), (-2.0, 4.0)])
    walls = np.stack([square, np.roll(square, -1, axis=0)], axis=1)
    here = np.array([np.pi / 2, 1.0, 1.0])  # looking along y
    found = laser.cast(walls, here, np.radians([0.0, -90.0, 90.0, 180.0, -30.0]))
    np.testing.assert_allclose(found, [3.0, 2.0, 3.0, 2.0, 3.0 / np.cos(np.radians(30.0))])
    # The nearest of several, and nothing where there is none.
    assert np.isinf(laser.cast(walls[:1], here, np.zeros(1)))
    np.testing.assert_allclose(laser.cast(np.concatenate([walls, walls * 0.5]), here, np.zeros(1)), 1.0)


def test_every_beam_of_the_corridor_meets_a_wall():
    beams = np.linspace(-np.pi, np.pi, 720)
    for place in ([1.0, 1.0], [15.0, 6.0], [8.0, 11.0]):
        found = laser.cast(floor_plan(), np.array([0.3, *place]), beams)
        assert found.min() > 0.5 and found.max() < 18.0


def test_a_log_agrees_with_its_truth(tmp_path):
    simulate_laser(LaserWorld(scans=60, std_range_m=0.0, dropouts=0.0, odometer=EXACT), tmp_path, seed=0)
    log, truth = read_laser_log(tmp_path / "robot.clf"), read_tum(tmp_path / "truth.tum")
    np.testing.assert_array_equal(log.stamps_ns, truth.stamps_ns)
    np.testing.assert_allclose(log.scanner.robot_from_sensor, [0.0, 0.2, 0.0], atol=1e-5)
    # Points of the scans lie on the walls: seen from where the truth says, they are where a ray ends.
    theta = np.arctan2(*(2 * truth.world_from_body[30, [2, 3]])) * 2
    sensor = SE2.compose(np.array([theta, *truth.positions[30, :2]]), log.scanner.robot_from_sensor)
    np.testing.assert_allclose(laser.cast(floor_plan(), sensor, log.scanner.angles), log.ranges[30], atol=1e-3)
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


# Drives of a robot on two wheels, smooth and without slipping sideways, and what the simulated odometer says of them.

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


STAMPS = stamps_ns(len(TOUR.way_m), RATE_HZ)


def measured(odometer: WheelOdometer, seed: int = 0, frames: int | None = None) -> WheelOdometry:
    travelled = TOUR if frames is None else LabDrive(frames=frames).travelled()
    rng = np.random.default_rng(seed)
    stamps_ns = STAMPS[: len(travelled.way_m)]
    return WheelOdometry(stamps_ns, *odometer.measure(travelled.way_m, travelled.heading_rad, rng), ROBOT_FROM_CAMERA)


def test_without_errors_dead_reckoning_is_the_path() -> None:
    truth = world_from_camera(TOUR.world_from_robot)
    found = measured(EXACT).world_from_camera(truth[0])
    assert np.abs(SE3.local(truth, found)).max() < 2e-4
    assert np.abs(SE3.translation(truth)[:, 2] - 1.0).max() < 1e-12


def test_wrong_wheels_err_as_they_should() -> None:
    odometer = replace(EXACT, scale=0.02, inequality=0.003, wheelbase_error=0.05)
    steps = SE2.log(measured(odometer).delta)
    way = TOUR.way_m[-1]
    half = 0.5 * 0.003 * 0.5 * odometer.wheelbase_m * TOUR.heading_rad[-1]
    np.testing.assert_allclose(steps[:, 1].sum(), 1.02 * way + half, atol=1e-9)
    turned = (1.02 * TOUR.heading_rad[-1] + 0.003 * way / odometer.wheelbase_m) / 1.05
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
    expected = 0.004 * np.sqrt(TOUR.way_m[-1] / 2.0)
    assert 0.7 < np.std(seeds) / expected < 1.4


# `python -m examples.studies.lab` from end to end, on a few tiny images.

SMALL = ["--width", "96", "--height", "72", "--texel-m", "0.05"]


def render_lab(out: Path, *arguments: str) -> None:
    tyro.cli(simulate_lab, args=["--out", str(out), *SMALL, *arguments])


@pytest.mark.slow
def test_a_tour_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    render_lab(tmp_path / "lab", "--every", "1000", "--noise-std", "0")
    sequence = open_stereo(tmp_path / "lab")
    assert sequence.truth is not None
    assert len(sequence) == 4 and sequence.baseline_m == 0.12
    assert sequence.camera.fx == 75.0
    assert len(read_wheel_odometry(tmp_path / "lab").stamps_ns) == 3001
    assert read_known_points(tmp_path / "lab" / "known_points.csv").names.size == 6
    places = sequence.truth.poses[:, 4:]
    assert np.ptp(places, axis=0)[0] > 4.0 and np.ptp(places, axis=0)[2] < 1e-9
    said = " ".join(capsys.readouterr().err.split())
    assert f"wrote {tmp_path / 'lab'}" in said.replace("lab,", "lab") and "MB" in said


@pytest.mark.slow
def test_options_reach_the_images(tmp_path: Path) -> None:
    options = ["--trajectory", "turn_back", "--frames", "3", "--known", "0", "--jpeg", "80", "--focal-px", "60"]
    render_lab(tmp_path / "mono", *options, "--baseline-m", "None")
    sequence = open_images(tmp_path / "mono")
    assert len(sequence) == 3 and sequence.camera.fx == 60.0 and sequence.baseline_m is None
    assert {path.suffix for path in (tmp_path / "mono" / "mav0" / "cam0" / "data").iterdir()} == {".jpg"}
