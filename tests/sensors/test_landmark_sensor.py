"""Landmarks that the recording numbers: which are observed, and which are started."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.errors import InputError
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
