"""Every mistake in what a sensor hands out gets its sentence."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf import gaussian
from rbpf.conformance import Example, check_model
from rbpf.core.models import Likelihood, NewLandmarks, ObservationModel, Observations, Sensor
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.maps.point import Point
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.scripted import says
from tests.core.worlds import Recipe, drive, planar_world

COUNTS = iter(range(10**9))


class Watching(Sensor):
    """Hands out what it was built with."""

    def __init__(self, groups=(), new_landmarks=()) -> None:
        self.groups, self.born = groups, new_landmarks

    def observe(self, frame, belief):
        return self.groups

    def new_landmarks(self, frame, belief, observed):
        return self.born


@pytest.fixture
def example() -> Example:
    """Six landmarks, of which the first was removed, in forty particles."""
    filter_ = Recipe().build()
    drive(filter_, planar_world(5, landmarks=6, seed=8))
    filter_.belief().map.remove(np.array([4]))
    return Example(frame=planar_world(6, landmarks=6, seed=8).frames[5], belief=filter_.belief())


@pytest.mark.parametrize("known", [True, False])
def test_sound_sensors(known):
    filter_, world = Recipe(known=known).build(), planar_world(6, seed=8)
    drive(filter_, world, 0, 5)
    (sensor,) = filter_.sensors
    assert check_model(sensor, example=Example(frame=world.frames[5], belief=filter_.belief())) == []


Z, COV = np.array([[3.0, 0.1], [4.0, 0.2]]), np.repeat(np.diag([0.1, 0.1])[None], 2, axis=0)
GROUP = Observations(Z, COV, RangeBearing(SE2), ids=np.array([2, 5]))
BIRTHS = NewLandmarks(Z, COV, RangeBearing(SE2), Point(2))
SENSORS = {
    "Watching.observe, for a group, returned a str, expected Observations": Watching(["seen"]),
    r"Watching.observe: z of RangeBearing has shape \(2, 1\), expected \(any, 2\)": Watching(
        [replace(GROUP, z=Z[:, :1])]
    ),
    "Watching.observe: z of RangeBearing holds NaN": Watching([replace(GROUP, z=Z * np.nan)]),
    r"Watching.observe: cov of RangeBearing has shape \(1, 2, 2\), expected \(2, 2, 2\)": Watching(
        [replace(GROUP, cov=COV[:1])]
    ),
    "Watching.observe: cov of RangeBearing is not positive semi-definite": Watching(
        [replace(GROUP, cov=-COV)]
    ),
    "Watching.observe gives no ids, but RangeBearing reads a landmark": Watching([replace(GROUP, ids=None)]),
    r"Watching.observe: ids has shape \(3,\), expected \(2,\) or \(40, 2\)": Watching(
        [replace(GROUP, ids=np.array([2, 3, 5]))]
    ),
    "Watching.observe: ids are float64, expected integers": Watching(
        [replace(GROUP, ids=np.array([2.0, 5.0]))]
    ),
    r"Watching.observe names landmarks \[4, 99\], which the map does not hold": Watching(
        [replace(GROUP, ids=np.array([99, 4]))]
    ),
    "Watching.observe: ids below -2 mean nothing": Watching([replace(GROUP, ids=np.array([-3, 2]))]),
    "Watching.new_landmarks, for a group, returned a Observations, expected NewLandmarks": Watching(
        [], [GROUP]
    ),
    r"Watching.new_landmarks: mask has shape \(2,\), expected \(40, 2\)": Watching(
        [], [replace(BIRTHS, mask=np.ones(2, dtype=bool))]
    ),
    r"Watching.new_landmarks: ids has shape \(1,\), expected \(2,\)": Watching(
        [], [replace(BIRTHS, ids=np.array([7]))]
    ),
    r"Watching.new_landmarks starts landmarks \[2\], which the map holds already": Watching(
        [], [replace(BIRTHS, ids=np.array([2, 7]))]
    ),
    "Watching.new_landmarks gives 1 facts for 2 landmarks, expected one each or none": Watching(
        [], [replace(BIRTHS, facts=["oak"])]
    ),
}


@pytest.mark.parametrize("sentence", SENSORS)
def test_findings_about_sensors(sentence, example):
    findings = check_model(SENSORS[sentence], example=example)
    assert len(findings) == 1
    says(findings, sentence)


class Unnormalised(Likelihood):
    """Twice a density."""

    def log_density(self, nu, cov):
        return gaussian.log_density(nu, cov) + np.log(2.0)


def test_a_sensor_answers_for_its_models(example):
    class Unwrapped(RangeBearing):  # type: ignore[misc]
        residual = ObservationModel.residual

    sensor = Watching([replace(GROUP, model=Unwrapped(SE2), likelihood=Unnormalised())])
    findings = check_model(sensor, example=example)
    says(findings, r"Unwrapped.residual jumps by 2π in component \[1\]")
    says(findings, "Unnormalised.log_density integrates to")


def test_a_sensor_that_draws(example):
    class Drawing(Sensor):
        def observe(self, frame, belief):
            return [replace(GROUP, z=Z + 1e-6 * next(COUNTS))]

    says(check_model(Drawing(), example=example), "Drawing.observe returns different numbers")


def test_a_sensor_needs_a_frame():
    with pytest.raises(
        InputError, match=r"Watching is tried on a frame and a belief: give Example\(frame=…, belief"
    ):
        check_model(Watching())
