"""Range-bearing and position sensors: round trips, derivatives, angles near the cut, visibility."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rbpf.core.filter import Filter
from rbpf.core.linearisation import numeric_jacobians
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion, wheel_errors
from rbpf.runs.recordings import filter_opened, open_robot_log
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition, RigidPointModel, wrap_angle
from rbpf.sensors.readers import RobotLog
from rbpf.systems.range_bearing.config import CalibrationConfig, RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.systems.system import FrameLog
from rbpf.validation.simulation.robot import RobotWorld, simulated_log
from tests.core.scripted import ids_of

MOUNTED_2D = np.array([0.4, 0.3, -0.2])
MOUNTED_3D = SE3.retract(SE3.identity(), np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.3]))
MODELS = {
    "planar": RangeBearing(SE2),
    "planar mounted": RangeBearing(SE2, MOUNTED_2D),
    "spatial": RangeBearing(SE3),
    "spatial mounted": RangeBearing(SE3, MOUNTED_3D),
    "pitch down": RangeBearing(SE3, MOUNTED_3D, pitch_sign=-1.0),
    "position": RelativePosition(SE2, MOUNTED_2D),
    "position in space": RelativePosition(SE3, MOUNTED_3D),
}
every_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS.keys())


@st.composite
def scenes(draw):
    """A tangent (6,) of the pose and a point (3,) in the sensor's frame; each model takes what it needs."""
    tangent = draw(arrays(float, 6, elements=st.floats(-3.0, 3.0)))
    distance, yaw, pitch = draw(st.floats(0.2, 50.0)), draw(st.floats(-3.2, 3.2)), draw(st.floats(-1.3, 1.3))
    flat = distance * np.cos(pitch)
    return tangent, np.array([flat * np.cos(yaw), flat * np.sin(yaw), distance * np.sin(pitch)])


def placed(model: RigidPointModel, scene) -> tuple[np.ndarray, np.ndarray]:
    """The pose, and the point in the world."""
    tangent, point = scene
    pose = model.space.exp(tangent[: model.space.dim])
    in_robot = model.space.transform(model.robot_from_sensor, point[: model.dim])
    return pose, model.space.transform(pose, in_robot)


@every_model
@settings(max_examples=40)
@example(scene=(np.zeros(6), np.array([-5.0, 0.0, 0.0])))  # behind the sensor, where the angle is cut
@given(scene=scenes())
def test_invert_undoes_predict_and_jacobians_are_the_numeric_ones(model, scene):
    pose, landmark = placed(model, scene)
    again = model.invert(pose, model.predict(pose, landmark))
    np.testing.assert_allclose(again, landmark, atol=1e-11)
    # Numeric derivatives of an angle lose digits where the point is near the sensor or its vertical axis.
    near = 1.0 + 1.0 / np.hypot(*scene[1][:2]) ** 3
    analytic = model.jacobians(pose, landmark)
    numeric = numeric_jacobians(model, model.space, pose, landmark)
    for found, expected in zip(analytic[:2], numeric[:2], strict=True):
        np.testing.assert_allclose(np.asarray(found), np.asarray(expected), rtol=1e-6, atol=1e-8 * near)
    # Of a sensor whose place is a substate, of which it is about zero: in what is seen, and in what is started.
    d, step, z = model.space.dim, 1e-6, model.predict(pose, landmark)
    tuned = model.tuned(np.zeros(d), np.eye(d))
    sides = [[model.tuned(sign * step * axis, np.eye(d)) for sign in (1.0, -1.0)] for axis in np.eye(d)]
    seen = [one.residual(one.predict(pose, landmark), other.predict(pose, landmark)) for one, other in sides]
    started = [one.invert(model.space.identity(), z) - other.invert(model.space.identity(), z) for one, other in sides]
    slope = tuned.jacobians(pose, landmark, None, np.zeros(d)).substate
    np.testing.assert_allclose(slope, np.transpose(seen) / (2.0 * step), rtol=1e-6, atol=1e-7 * near)
    np.testing.assert_allclose(tuned.new_by_substate(z[None])[0], np.transpose(started) / (2.0 * step), atol=1e-7)


def test_planar_measurement_by_hand():
    # Robot at (1, 2) looking along +y; the point is 3 m ahead and 4 m to the left.
    z = RangeBearing(SE2).predict(np.array([np.pi / 2, 1.0, 2.0]), np.array([-3.0, 5.0]))
    np.testing.assert_allclose(z, [5.0, np.arctan2(4.0, 3.0)])
    # A first estimate has r·σ_yaw across the line of sight, along it σ_r.
    cov = np.diag([0.1, 0.02]) ** 2
    records = RangeBearing(SE2).initialise(np.zeros((1, 3)), np.array([[10.0, np.pi / 2]]), cov[None])
    np.testing.assert_allclose(records.mean[0, 0], [0.0, 10.0], atol=1e-12)
    np.testing.assert_allclose(records.cov[0, 0], np.diag([0.2, 0.1]) ** 2, atol=1e-9)


@given(st.floats(-50.0, 50.0))
def test_wrapped_angles(angle):
    wrapped = wrap_angle(np.array(angle))
    assert -np.pi <= wrapped < np.pi and np.abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-13


@pytest.mark.parametrize("model", [RangeBearing(SE2), RangeBearing(SE3)], ids=["planar", "spatial"])
@given(near=st.floats(-0.01, 0.01), step=st.floats(-0.01, 0.01))
def test_residual_across_the_cut(model, near, step):
    before, after = np.zeros(model.dim), np.zeros(model.dim)
    before[1], after[1] = wrap_angle(np.array([np.pi + near, np.pi + near + step]))
    np.testing.assert_allclose(model.residual(after, before)[1], step, atol=1e-14)


def test_visible():
    model = RangeBearing(SE2, max_range=5.0, half_field_of_view=np.pi / 4)
    points = np.array([[4.0, 0.0], [6.0, 0.0], [2.0, 1.9], [2.0, 2.1], [-4.0, 0.0]])
    assert model.visible(np.zeros(3), points).tolist() == [True, False, True, False, False]
    turned = np.array([np.pi, 0.0, 0.0])
    assert model.visible(turned, points).tolist() == [False, False, False, False, True]
    states = np.stack([np.zeros(3), turned])[:, None]
    assert model.visible(states, points[None].repeat(2, axis=0)).shape == (2, 5)
    position = RelativePosition(SE2, np.array([0.0, 1.0, 0.0]), max_range=2.0)
    points = np.array([[2.9, 0.0], [3.1, 0.0], [-1.1, 0.0]])
    assert position.visible(np.zeros(3), points).tolist() == [True, False, False]


# Landmarks that the recording numbers: which are observed, and which are started.

MODEL = RangeBearing(SE2)


def frame(*names: object) -> FeatureFrame:
    z = np.stack([np.arange(3.0, 3.0 + len(names)), np.zeros(len(names))], axis=-1)
    return FeatureFrame(0, np.array(names), z, np.repeat(np.diag([0.01, 0.01])[None], len(names), axis=0))


def named() -> Filter:
    landmark_map = LandmarkMap(SE2)
    landmark_map.register(Point(2))
    sensor = NamedLandmarkSensor(MODEL, Point(2))
    return Filter(OdometryMotion(SE2), sensor, landmark_map, n=3, rng=np.random.default_rng(0))


def test_numbers_are_ids():
    """A name that is seen twice in its first frame starts one landmark; one that was removed starts anew."""
    filter_ = named()
    report = filter_.step(frame(7, 3, 7))
    assert report.new_landmarks.tolist() == [7, 3]
    assert report.groups == []
    report = filter_.step(frame(3, 20, 7))
    assert ids_of(report).tolist() == [3, 7]
    np.testing.assert_array_equal(report.groups[0].z[:, 0], [3.0, 5.0])
    assert report.new_landmarks.tolist() == [20]
    assert filter_.belief().map.ids.tolist() == [7, 3, 20]
    filter_.belief().map.remove(np.array([7]))
    report = filter_.step(frame(3, 7, 3))
    assert ids_of(report).tolist() == [3, 3]
    assert report.new_landmarks.tolist() == [7]


@pytest.mark.parametrize(("name", "message"), [("oak", "got .*oak.*: number their names"), (-1, "from 0 up")])
def test_other_names_are_refused(name, message):
    with pytest.raises(InputError, match=message):
        named().step(frame(name))


# A sensor whose place on the robot is not known for certain: a member of the joint map.

SENSOR = RangeBearingConfig(particles=30, window=1, calibrate="sensor")


def elsewhere(log: RobotLog, mount: np.ndarray) -> RobotLog:
    """The log of a robot that carries its sensor at `mount` (E,), and does not say so."""
    space, back, turn = log.space, log.space.inverse(mount), log.space.adjoint(mount)
    frames = log.frames[:1]
    for each in log.frames[1:]:
        delta = space.compose(space.compose(mount, each.delta), back)
        frames.append(replace(each, delta=delta, cov_delta=turn @ each.cov_delta @ turn.T))
    poses = space.compose(mount, space.compose(log.truth.poses, back))
    return replace(log, frames=frames, truth=replace(log.truth, poses=poses))


def run(log: RobotLog, config: RangeBearingConfig) -> tuple[float, RangeBearingSlam, FrameLog]:
    """Error of the path, not aligned, and what made it."""
    done = filter_opened(open_robot_log(log, config))
    shift = log.space.translation(done.log.poses) - log.space.translation(log.truth.poses)
    return np.sqrt(np.square(shift).sum(axis=1).mean()), done.system, done.log


@pytest.mark.slow
@pytest.mark.parametrize("spatial", [False, True])
def test_where_a_sensor_stands_is_found_while_running(spatial, tmp_path):
    """To within what is stated, with sub-maps, too; a run that does not ask is off by more, one that need not by little."""
    world = RobotWorld(120, 40, spatial, std_translation_m=0.005, std_rotation_deg=0.1)
    there = simulated_log(world, 1)
    space, dim = there.space, 3 if spatial else 2
    mount = space.exp(np.append(np.zeros(space.dim - dim), [0.15, -0.1, 0.05][:dim]))
    log = elsewhere(there, mount)

    off, given = replace(SENSOR, calibrate="off"), []
    unasked = run(log, off)[0]
    for submap in (150, 10):
        config = replace(SENSOR, submap=submap)
        path, slam, steps = run(log, config)
        assert path < 0.7 * unasked and bool(slam.joint.old.maps) == (submap == 10)
        pose, cov = slam.calibration.sensor_pose(slam.filter)
        error, within = space.local(pose, mount)[-dim:], cov[-dim:, -dim:]
        assert error @ np.linalg.solve(within, error) < 4.0 * dim and np.trace(within) < dim * 0.01**2
        given.append(pose)
    assert np.linalg.norm(space.local(*given)[-dim:]) < 0.5 * np.sqrt(np.trace(within))
    assert RangeBearingConfig.defaults({"calibrate": "online"}).window == SENSOR.window
    entries = slam.summary(steps)["calibration"]
    assert entries["x_m"] == space.translation(pose)[0] and entries["std_x_m"] == np.sqrt(within[0, 0])
    np.testing.assert_array_equal(slam.measurements("log", steps).robot_from_sensor, pose)
    slam.save(tmp_path / "checkpoint.npz")
    again = RangeBearingSlam.of_log(log, config)
    again.load(tmp_path / "checkpoint.npz")
    np.testing.assert_array_equal(again.calibration.sensor_pose(again.filter)[0], pose)
    turned = RangeBearingSlam.of_log(log, replace(SENSOR, self_calibration=CalibrationConfig(yaw_deg=2.0)))
    assert turned.summary(steps)["calibration"]["std_yaw_deg"] == pytest.approx(2.0)
    assert run(there, SENSOR)[0] < 1.5 * run(there, off)[0]


@pytest.mark.slow
@pytest.mark.parametrize(("submap", "costs"), [(150, {"online": 2.5}), (10, {"odometry": 1.3, "auto": 1.001})])
def test_what_wheels_get_wrong_is_found_while_running(submap, costs, tmp_path):
    """To within what is stated, with sub-maps, too; what asking costs a robot whose wheels are right."""
    right = simulated_log(RobotWorld(300, 40, std_translation_m=0.01, std_rotation_deg=0.1), 1)
    frames, wrong = right.frames[:1], [0.02, 0.04, 0.0, 0.0 if "online" in costs else 0.03]
    for each in right.frames[1:]:
        frames.append(replace(each, delta=SE2.compose(each.delta, SE2.exp(-wheel_errors(each.delta) @ wrong))))
    log, off = replace(right, frames=frames), replace(SENSOR, window=5, calibrate="off", submap=submap)
    unasked, needless = run(log, off)[0], run(right, off)[0]
    # On a circle only how far the heading drifts in all is told, and nothing of turns to the right.
    told = wheel_errors(right.frames[1].delta)[0]
    for calibrate, most in costs.items():
        config = replace(off, calibrate=calibrate)
        path, slam, steps = run(log, config)
        found, std = slam.calibration.wheels(slam.filter)
        assert abs(told @ (found - wrong)) < 0.1 * told @ wrong and std[2] == pytest.approx(0.05)
        assert abs(found[3] - wrong[3]) <= 3.0 * std[3] < 0.02
        assert path < 0.5 * unasked and run(right, config)[0] < most * needless
        told_as = slam.summary(steps)["calibration"]
        assert told_as["turn_left"] == found[1] and ("distance" in told_as) == (calibrate != "online")
        before, after = np.array([each.delta for each in frames[1:]]), slam.measurements("log", steps).deltas
        np.testing.assert_allclose(SE2.local(before, after), wheel_errors(before) @ found, atol=1e-12)
        slam.save(tmp_path / "checkpoint.npz")
        again = RangeBearingSlam.of_log(log, config)
        again.load(tmp_path / "checkpoint.npz")
        np.testing.assert_array_equal(again.calibration.wheels(again.filter), (found, std))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_of_steps_is_not_taken_for_what_wheels_get_wrong(seed):
    """Steps of 8 cm with 3 cm of noise: what the odometry says has that noise in it."""
    calibration = run(simulated_log(RobotWorld(250, laps=0.625), seed), RangeBearingConfig(particles=20))[1].calibration
    assert (calibration.score[1] > 0.0).any() and not calibration.is_estimated


def test_odometry_may_claim_to_be_exact():
    """So that the first step tells, to rounding, what the wheels get wrong."""
    rng, slam = np.random.default_rng(0), RangeBearingSlam(RangeBearingConfig(particles=20), measurement="position")
    points, names, step = rng.uniform(-5.0, 5.0, (6, 2)), np.arange(6), np.array([0.0, 0.1, 0.0])
    for t in range(20):
        z = points - [0.1 * t, 0.0] + rng.normal(0.0, 0.02, (6, 2))
        odometry = Odometry(step.tolist(), np.zeros((3, 3)).tolist()) if t else None  # lists are taken, too
        pose = slam.track(z.tolist(), np.tile(4e-4 * np.eye(2), (6, 1, 1)), names.tolist(), odometry).pose
    np.testing.assert_allclose(pose, 19 * step, atol=1e-6)
    with pytest.raises(InputError, match="the array delta must hold finite numbers"):
        slam.track(z, np.tile(4e-4 * np.eye(2), (6, 1, 1)), names, Odometry(step * np.nan, np.zeros((3, 3))))
    with pytest.raises(InputError, match="odometry must be an Odometry with delta and cov, got a tuple"):
        slam.track([], [], [], (step, np.zeros((3, 3))))  # type: ignore[arg-type]
