"""Odometry, landmark ids and first sightings that are wrong: one sentence each, and an unchanged filter."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.models import NewLandmarks, ObservationModel
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.scripted import Scripted, fails, seen
from tests.core.worlds import Recipe, drive, planar_world

N = 6


class TestOdometry:
    @pytest.mark.parametrize(
        ("control", "match"),
        [
            (Odometry(np.zeros(2), np.eye(3)), r"odometry needs delta \(3,\) and cov \(3, 3\), got \(2,\)"),
            (
                Odometry(np.zeros(3), np.eye(2)),
                r"odometry needs delta \(3,\) and cov \(3, 3\), got \(3,\) and \(2, 2\)",
            ),
            (
                Odometry(np.zeros(3), -np.eye(3)),
                "the covariance of the odometry is not one: .*negative eigenvalue",
            ),
            (
                Odometry(np.zeros(3), np.triu(np.ones((3, 3)))),
                "covariance of the odometry is not one: .*not symmetric",
            ),
            (
                Odometry(np.zeros(3), np.full((3, 3), np.nan)),
                "covariance of the odometry is not one: .*not finite",
            ),
            (
                Odometry(np.array([0.0, np.nan, 0.0]), np.eye(3)),
                "the odometry increment .* holds NaN or infinity",
            ),
        ],
    )
    def test_controls(self, control, match):
        fails(Filter(OdometryMotion(SE2), Scripted(), n=N), match, [], control)


class TestLandmarks:
    @pytest.fixture
    def filter_(self) -> Filter:
        """Two landmarks, of which the first was removed again, and a resampling on the way."""
        filter_ = Recipe(n=N).build()
        drive(filter_, planar_world(4, landmarks=5, seed=8))
        filter_.sensors = [Scripted()]
        filter_.belief().map.remove(np.array([3]))
        return filter_

    @pytest.mark.parametrize(
        ("ids", "match"),
        [
            (None, "RangeBearing reads a landmark: its observations need ids"),
            ([3], "names landmark 3, which the map does not hold"),
            ([77], "names landmark 77, which the map does not hold"),
            ([[4]] * (N - 1) + [[10**9]], "names landmark 1000000000, which the map does not hold"),
            ([1, 2], rf"ids of 1 measurements must be \(1,\) or \({N}, 1\), got \(2,\)"),
            ([[1]], r"got \(1, 1\)"),
            ([-3], "ids of RangeBearing must be integers: landmarks, NULL = -1 or NEW = -2"),
            ([1.0], "ids of RangeBearing must be integers"),
            ([True], "ids of RangeBearing must be integers"),
        ],
    )
    @pytest.mark.usefixtures("unchecked_shapes")
    def test_ids(self, filter_, ids, match):
        ids = None if ids is None else np.array(ids)
        fails(filter_, match, seen(RangeBearing(SE2), [[5.0, 0.0]], ids=ids))

    def test_ids_before_there_is_a_landmark(self):
        filter_ = Filter(OdometryMotion(SE2), Scripted(), LandmarkMap(SE2), n=N)
        groups = seen(RangeBearing(SE2), [[5.0, 0.0]], ids=np.zeros(1, dtype=int))
        fails(filter_, "names landmark 0, which the map does not hold", groups)

    def test_reading_the_map(self, filter_):
        landmark_map = filter_.belief().map
        for use in (landmark_map.read, landmark_map.remove):
            with pytest.raises(InputError, match="the map holds no landmark 3"):
                use(np.array([3]))
        with pytest.raises(InputError, match="the map holds no landmark -1"):
            landmark_map.landmark_of(-1)
        with pytest.raises(InputError, match="no landmark was named"):
            landmark_map.read(np.zeros(0, dtype=int))

    def test_a_map_that_is_not_there(self):
        with pytest.raises(InputError, match="needs a landmark map: give the filter a LandmarkMap"):
            _ = Filter(OdometryMotion(SE2), Scripted(), n=N).belief().map

    def test_landmarks_of_some_particles_in_a_map_without_evidence(self, filter_):
        new_landmarks = NewLandmarks(
            np.ones((1, 2)), np.eye(2)[None], RangeBearing(SE2), Point(2), np.ones((N, 1), dtype=bool)
        )
        with pytest.raises(InputError, match="only need a map with evidence=True"):
            filter_.belief().map.add(new_landmarks, filter_.particles.state)
        with pytest.raises(InputError, match="keeps no log-odds: build it with evidence=True"):
            filter_.belief().map.set_log_odds(np.array([4]), np.zeros((N, 1)))

    def test_first_sightings_that_are_not_finite(self, filter_):
        new_landmarks = NewLandmarks(np.array([[np.nan, 0.0]]), np.eye(2)[None], RangeBearing(SE2), Point(2))
        with pytest.raises(InputError, match="a new Point has a mean or covariance that is not finite"):
            filter_.belief().map.add(new_landmarks, filter_.particles.state)

    def test_a_model_that_cannot_start_landmarks(self, filter_):
        class Bearing(RangeBearing):  # type: ignore[misc]
            invert = ObservationModel.invert

        new_landmarks = NewLandmarks(np.ones((1, 2)), np.eye(2)[None], Bearing(SE2), Point(2))
        with pytest.raises(InputError, match=r"Bearing cannot start landmarks: override invert\(state, z\)"):
            filter_.belief().map.add(new_landmarks, filter_.particles.state)
