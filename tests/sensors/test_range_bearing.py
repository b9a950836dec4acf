"""Range-bearing and position sensors: round trips, derivatives, angles near the cut, visibility."""

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
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition, RigidPointModel, wrap_angle
from tests.core.scripted import ids_of
from tests.core.worlds import Sightings

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


def test_planar_measurement_by_hand():
    # Robot at (1, 2) looking along +y; the point is 3 m ahead and 4 m to the left.
    pose = np.array([np.pi / 2, 1.0, 2.0])
    z = RangeBearing(SE2).predict(pose, np.array([-3.0, 5.0]))
    np.testing.assert_allclose(z, [5.0, np.arctan2(4.0, 3.0)])


def test_covariance_of_a_first_estimate():
    """Across the line of sight r·σ_yaw, along it σ_r."""
    cov = np.diag([0.1, 0.02]) ** 2
    records = RangeBearing(SE2).initialise(np.zeros((1, 3)), np.array([[10.0, np.pi / 2]]), cov[None])
    np.testing.assert_allclose(records.mean[0, 0], [0.0, 10.0], atol=1e-12)
    np.testing.assert_allclose(records.cov[0, 0], np.diag([0.2, 0.1]) ** 2, atol=1e-9)


@given(st.floats(-50.0, 50.0))
def test_wrapped_angles(angle):
    wrapped = wrap_angle(np.array(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-13


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
    assert position.visible(np.zeros(3), np.array([[2.9, 0.0], [3.1, 0.0], [-1.1, 0.0]])).tolist() == [
        True,
        False,
        False,
    ]


# Landmarks that the recording numbers: which are observed, and which are started.

MODEL = RangeBearing(SE2)


def frame(*names: object) -> Sightings:
    z = np.stack([np.arange(3.0, 3.0 + len(names)), np.zeros(len(names))], axis=-1)
    return Sightings(np.array(names), z, np.repeat(np.diag([0.01, 0.01])[None], len(names), axis=0))


@pytest.fixture
def sensor() -> NamedLandmarkSensor:
    return NamedLandmarkSensor(MODEL, Point(2))


def filter_of(sensor: NamedLandmarkSensor) -> Filter:
    landmark_map = LandmarkMap(SE2)
    landmark_map.register(Point(2))
    return Filter(OdometryMotion(SE2), sensor, landmark_map, n=3, rng=np.random.default_rng(0))


def test_numbers_are_ids(sensor):
    filter_ = filter_of(sensor)
    report = filter_.step(frame(7, 3))
    assert report.new_landmarks.tolist() == [7, 3]
    assert report.groups == []
    report = filter_.step(frame(3, 20, 7))
    assert ids_of(report).tolist() == [3, 7]
    np.testing.assert_array_equal(report.groups[0].z[:, 0], [3.0, 5.0])
    assert report.new_landmarks.tolist() == [20]
    assert filter_.belief().map.ids.tolist() == [7, 3, 20]


@pytest.mark.parametrize(("name", "message"), [("oak", "got .*oak.*: number their names"), (-1, "from 0 up")])
def test_other_names_are_refused(name, message, sensor):
    with pytest.raises(InputError, match=message):
        filter_of(sensor).step(frame(name))


def test_a_name_seen_twice_in_its_first_frame_starts_one_landmark(sensor):
    filter_ = filter_of(sensor)
    assert filter_.step(frame(7, 7, 8)).new_landmarks.tolist() == [7, 8]
    report = filter_.step(frame(7, 7))
    assert ids_of(report).tolist() == [7, 7]
    assert report.new_landmarks.size == 0


def test_a_landmark_that_was_removed_starts_anew(sensor):
    filter_ = filter_of(sensor)
    filter_.step(frame(4, 5))
    filter_.belief().map.remove(np.array([4]))
    report = filter_.step(frame(5, 4))
    assert ids_of(report).tolist() == [5]
    assert report.new_landmarks.tolist() == [4]
