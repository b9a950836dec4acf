"""A filter with a fixed lag runs for ever in the same memory."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.worlds import STD_ODOMETRY, STD_Z, Sightings, content

STEPS, N = 3000, 12
POINTS = np.array([[3.0, 0.0], [0.0, 4.0], [-5.0, -1.0], [2.0, -3.0]])


@pytest.mark.slow
def test_constant_memory_with_a_lag():
    """The robot stands among four landmarks, of which it sees each one in turn."""
    rng = np.random.default_rng(0)
    model = RangeBearing(SE2)
    filter_ = Filter(OdometryMotion(SE2), NamedLandmarkSensor(model, Point(2)), LandmarkMap(SE2), n=N, rng=rng, lag=20)
    control = Odometry(np.zeros(3), np.diag(STD_ODOMETRY**2))
    sizes, errors = [], []
    for t in range(STEPS):
        name = np.array([t // 25 % 4])
        z = model.predict(SE2.identity(), POINTS[name]) + STD_Z * rng.normal(size=(1, 2))
        report = filter_.step(Sightings(name, z, np.diag(STD_Z**2)[None]), control if t else None)
        errors.append(np.linalg.norm(report.estimate.mean[1:]))
        if t % 50 == 0:
            sizes.append(sum(array.nbytes for array in content(filter_).values()))
    assert filter_.lineage.generation > STEPS // 10
    assert max(sizes[30:]) <= 1.1 * max(sizes[:30])
    assert filter_.history.paths().shape == (20, N, 3)
    assert max(errors) < 2.0
