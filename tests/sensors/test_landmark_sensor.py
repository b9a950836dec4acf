"""Which landmark a named sighting is of, and which sightings start one."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.models import NewLandmarks
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.scripted import ids_of
from tests.core.worlds import Sightings

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


def test_names_become_ids(sensor):
    filter_ = filter_of(sensor)
    report = filter_.step(frame("oak", "elm"))
    assert report.new_landmarks.tolist() == [0, 1]
    assert report.groups == []
    report = filter_.step(frame("elm", "ash", "oak"))
    assert ids_of(report).tolist() == [1, 0]
    np.testing.assert_array_equal(report.groups[0].z[:, 0], [3.0, 5.0])
    assert report.new_landmarks.tolist() == [2]
    assert filter_.belief().catalogue == {0: "oak", 1: "elm", 2: "ash"}


def test_a_name_seen_twice_in_its_first_frame_starts_one_landmark(sensor):
    filter_ = filter_of(sensor)
    assert filter_.step(frame(7, 7, 8)).new_landmarks.tolist() == [0, 1]
    report = filter_.step(frame(7, 7))
    assert ids_of(report).tolist() == [0, 0]
    assert report.new_landmarks.size == 0


def test_an_empty_frame(sensor):
    filter_ = filter_of(sensor)
    report = filter_.step(Sightings(np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros((0, 2, 2))))
    assert report.groups == []
    assert report.new_landmarks.size == 0


def test_a_landmark_that_is_replaced_by_another(sensor):
    """As many names as before, but not the same ones."""
    filter_ = filter_of(sensor)
    filter_.step(frame("oak", "elm"))
    filter_.step(frame("oak", "elm"))
    landmark_map = filter_.belief().map
    landmark_map.remove(np.array([0]))
    new_landmarks = NewLandmarks(
        np.array([[5.0, 1.0]]), np.diag([0.01, 0.01])[None], MODEL, Point(2), facts=["ash"]
    )
    landmark_map.add(new_landmarks, filter_.particles.state)
    report = filter_.step(frame("elm", "ash", "oak"))
    assert ids_of(report).tolist() == [1, 2]
    assert report.new_landmarks.tolist() == [3]


def test_one_sensor_in_two_filters(sensor):
    first, second = filter_of(sensor), filter_of(sensor)
    first.step(frame("oak", "elm"))
    second.step(frame("elm", "oak"))
    assert ids_of(first.step(frame("oak"))).tolist() == [0]
    assert ids_of(second.step(frame("oak"))).tolist() == [1]


def test_names_after_loading_an_earlier_state(sensor, tmp_path):
    filter_ = filter_of(sensor)
    filter_.step(frame("oak"))
    filter_.save(tmp_path / "run.npz")
    filter_.step(frame("elm"))
    filter_.load(tmp_path / "run.npz")
    filter_.step(frame("ash"))
    report = filter_.step(frame("ash", "elm", "oak"))
    assert ids_of(report).tolist() == [1, 0]
    assert report.new_landmarks.tolist() == [2]
