"""Every mistake in a motion model, a parametrisation, a likelihood or a sensor gets its sentence."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.conformance import Example, check_model, require_sound
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Euclidean
from rbpf.likelihoods import Gaussian, GaussianWithOutliers, TruncatedMahalanobis, squared_mahalanobis
from rbpf.maps.mixture import MixturePoint
from rbpf.maps.point import AnchoredPoint, Point
from rbpf.models import (
    Births,
    Landmark,
    Likelihood,
    MotionModel,
    ObservationModel,
    Observations,
    Records,
    Sensor,
    Transition,
)
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.worlds import Recipe, drive, planar_world

COUNTS = iter(range(10**9))


def says(findings: list[str], sentence: str) -> None:
    """The sentence is among the findings."""
    with pytest.raises(AssertionError, match=sentence):
        raise AssertionError("\n".join(findings))


class Driven(MotionModel):
    """A pose driven by a twist that is marginalised."""

    space = SE2

    def transition(self, state, control, dt):
        factor = np.diag([0.1, 0.2, 0.2, 0.3, 0.3, 0.3])[None]
        coupling = np.repeat(dt * np.eye(3)[None], state.shape[0], axis=0)
        return Transition(state, factor, coupling, np.eye(3)[None], np.zeros((1, 3)))


@pytest.mark.parametrize(
    ("motion", "example"),
    [
        (OdometryMotion(SE2), None),
        (OdometryMotion(SE3), None),
        (OdometryMotion(SE2), Example(control=Odometry(np.array([0.1, 1.0, 0.0]), np.diag([0.1, 0.0, 0.0])))),
        (OdometryMotion(Euclidean(2)), Example(state=np.zeros((1, 2)))),
        (Driven(), None),
    ],
)
def test_sound_motions(motion, example):
    assert check_model(motion, example=example) == []


def moving(change) -> MotionModel:
    class Broken(Driven):
        def transition(self, state, control, dt):
            return change(super().transition(state, control, dt))

    return Broken()


MOTIONS = {
    "Broken.transition returned a tuple, expected Transition": moving(lambda t: (t.mean, t.noise_factor)),
    r"Broken.transition: mean has shape \(5, 2\), expected \(5, 3\)": moving(lambda t: replace(t, mean=t.mean[:, :2])),
    "Broken.transition: mean holds NaN or infinity": moving(lambda t: replace(t, mean=t.mean / 0.0)),
    r"Broken.transition: noise_factor has shape \(6, 6\), expected \(5, 6, any\) or \(1, 6, any\)": moving(
        lambda t: replace(t, noise_factor=t.noise_factor[0])
    ),
    r"Broken.transition: noise_factor has shape \(1, 3, 6\)": moving(
        lambda t: replace(t, noise_factor=t.noise_factor[:, :3])
    ),
    "must give coupling, dynamics and drift together, or none of them": moving(lambda t: replace(t, drift=None)),
    r"Broken.transition: coupling has shape \(5, 2, 3\), expected \(5, 3, any\) or \(1, 3, any\)": moving(
        lambda t: replace(t, coupling=t.coupling[:, :2])
    ),
    r"Broken.transition: dynamics has shape \(1, 2, 2\), expected \(5, 3, 3\) or \(1, 3, 3\)": moving(
        lambda t: replace(t, dynamics=np.eye(2)[None])
    ),
    r"Broken.transition: drift has shape \(3,\), expected \(5, 3\) or \(1, 3\)": moving(
        lambda t: replace(t, drift=t.drift[0])
    ),
    "Broken.transition: mean leaves the group SE2, use its compose or retract: expected": moving(
        lambda t: replace(t, mean=t.mean + 7.0)
    ),
    "Broken.transition mixes particles, for one of them alone, mean: expected": moving(
        lambda t: replace(t, mean=t.mean - t.mean.mean(axis=0))
    ),
    "Broken.transition returns different numbers for the same arguments": moving(
        lambda t: replace(t, noise_factor=t.noise_factor + 1e-9 * next(COUNTS))
    ),
    "Broken.transition raised ZeroDivisionError": moving(lambda t: 1 // 0),
}


@pytest.mark.parametrize("sentence", MOTIONS)
def test_findings_about_motions(sentence):
    findings = check_model(MOTIONS[sentence])
    says(findings, sentence)
    with pytest.raises(InputError, match=sentence):
        require_sound(MOTIONS[sentence])


def test_a_motion_that_changes_its_argument():
    class Careless(OdometryMotion):  # type: ignore[misc]
        def transition(self, state, control, dt):
            state += 0.0 * state + 0.1
            return super().transition(state, control, dt)

    says(check_model(Careless(SE2)), "Careless.transition changes its arguments in place")


def test_a_quaternion_that_is_added_to():
    class Added(OdometryMotion):  # type: ignore[misc]
        def transition(self, state, control, dt):
            return super().transition(state + 0.1, control, dt)

    says(check_model(Added(SE3)), "Added.transition: mean leaves the group SE3")


@pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
def test_sound_landmarks(space):
    dim = 2 if space is SE2 else 3
    for landmark in (Point(dim), AnchoredPoint(space), MixturePoint(4, dim)):
        assert check_model(landmark, space) == []


def landmark_with(**attributes: object) -> Landmark:
    def homogeneous(self, mean, const=None):
        return np.concatenate([mean, np.ones((*mean.shape[:-1], 1))], axis=-1)

    base = {"dim": 2, "homogeneous": homogeneous}
    return type("Broken", (Landmark,), {**base, **attributes})()


def named(name: str, function):
    function.__name__ = name
    return function


LANDMARKS = {
    "Broken.dim is 0, expected an integer of at least 1": landmark_with(dim=0),
    "Broken.components is 1.0, expected an integer of at least 1": landmark_with(components=1.0),
    "Broken.constants is -1, expected an integer of at least 0": landmark_with(constants=-1),
    r"Broken.homogeneous for means \(5, 4, 2\) has shape \(5, 4, 2\), expected \(5, 4, 4\) or \(5, 4, 3\)": landmark_with(
        homogeneous=named("homogeneous", lambda self, mean, const=None: mean.copy())
    ),
    "Broken.homogeneous raised ValueError": landmark_with(
        homogeneous=named("homogeneous", lambda self, mean, const=None: mean.reshape(5, 4, 3))
    ),
    "Broken.homogeneous does not broadcast, for a single mean": landmark_with(
        homogeneous=named(
            "homogeneous", lambda self, mean, const=None: np.ones((*mean.shape[:-1], 3)) * mean.sum()
        )
    ),
    r"Broken.ready has shape \(5, 4, 2\), expected \(5, 4\)": landmark_with(
        ready=named("ready", lambda self, records: records.mean > 0)
    ),
    "Broken.ready returns int64, expected bool": landmark_with(
        ready=named("ready", lambda self, records: np.zeros(records.mean.shape[:2], dtype=int))
    ),
    r"Broken.promote: mean has shape \(5, 4, 1\), expected \(5, 4, 2\) or \(5, 4, 3\)": landmark_with(
        promote=named("promote", lambda self, records: Records(records.mean[..., :1], records.cov))
    ),
    "Broken.promote: cov is not positive semi-definite": landmark_with(
        promote=named("promote", lambda self, records: Records(records.mean, -records.cov))
    ),
    "Broken.promote returned a NoneType, expected Records": landmark_with(
        promote=named("promote", lambda self, records: None)
    ),
}


@pytest.mark.parametrize("sentence", LANDMARKS)
def test_findings_about_landmarks(sentence):
    says(check_model(LANDMARKS[sentence]), sentence)


class StudentT(Likelihood):
    """Two degrees of freedom: heavier tails than any Gaussian, and no compiled twin."""

    def log_density(self, nu, cov):
        p = nu.shape[-1]
        constant = 0.5 * np.linalg.slogdet(cov)[1] + p * np.log(np.sqrt(2 * np.pi))
        return -0.5 * (2 + p) * np.log1p(0.5 * squared_mahalanobis(nu, cov)) - constant


@pytest.mark.parametrize(
    "likelihood",
    [Gaussian(), TruncatedMahalanobis(), GaussianWithOutliers(0.1, 20.0), GaussianWithOutliers(0.5, 1e4)],
    ids=lambda likelihood: type(likelihood).__name__,
)
def test_sound_likelihoods(likelihood):
    assert check_model(likelihood) == []


def likelihood_with(**attributes: object) -> Likelihood:
    return type("Broken", (StudentT,), attributes)()


LIKELIHOODS = {
    "Broken.log_density integrates to .* at variance 0.3, expected 1: normalise it, or set": likelihood_with(
        log_density=named("log_density", lambda self, nu, cov: -0.5 * squared_mahalanobis(nu, cov))
    ),
    r"Broken.log_density for ν \(5, 4, 1\) has shape \(5,\), expected \(5, 4\)": likelihood_with(
        log_density=named("log_density", lambda self, nu, cov: -squared_mahalanobis(nu, cov).sum(axis=-1))
    ),
    r"Broken.log_density for ν \(5, 4, 1\) holds NaN": likelihood_with(
        log_density=named("log_density", lambda self, nu, cov: np.log(-squared_mahalanobis(nu, cov)))
    ),
    "Broken.log_density does not broadcast, for a single ν": likelihood_with(
        log_density=named("log_density", lambda self, nu, cov: StudentT.log_density(self, nu, cov) - nu.size)
    ),
    "Broken.inlier returns float64, expected bool": likelihood_with(
        inlier=named("inlier", lambda self, nu, cov: np.ones(nu.shape[:-1]))
    ),
    r"Broken.inlier for ν \(5, 4, 1\) has shape \(5, 4, 1\)": likelihood_with(
        inlier=named("inlier", lambda self, nu, cov: nu > 0)
    ),
    r"Broken.form is 7, expected one of \(-1, 0, 1, 2\)": likelihood_with(form=7),
    "Broken.params is not one axis of float64 numbers": likelihood_with(form=0, params=[0.0]),
    "Broken.log_density differs from its compiled form 0: expected": likelihood_with(form=0),
}


@pytest.mark.parametrize("sentence", LIKELIHOODS)
def test_findings_about_likelihoods(sentence):
    says(check_model(LIKELIHOODS[sentence]), sentence)


def test_an_inlier_that_differs_from_the_compiled_one():
    class Broken(Gaussian):  # type: ignore[misc]
        def inlier(self, nu, cov):
            return np.abs(nu[..., 0]) < 1.0

    assert check_model(Broken()) == ["Broken.inlier differs from its compiled form 0"]


def test_a_density_of_heavy_tails():
    """Student's t with 2 degrees of freedom integrates to one; the constant holds in one dimension."""

    class OneDimensional(StudentT):
        def log_density(self, nu, cov):
            scale = np.sqrt(cov[..., 0, 0])
            squared = np.square(nu[..., 0] / scale)
            return -1.5 * np.log1p(0.5 * squared) - np.log(2.0 * np.sqrt(2.0) * scale)

    assert check_model(OneDimensional()) == []


class Watching(Sensor):
    """Hands out what it was built with."""

    def __init__(self, groups=(), births=()) -> None:
        self.groups, self.born = groups, births

    def observe(self, frame, belief):
        return self.groups

    def births(self, frame, belief, observed):
        return self.born


@pytest.fixture
def example() -> Example:
    """Six landmarks, of which the first was removed, in forty particles."""
    filter_ = Recipe().build()
    drive(filter_, planar_world(5, landmarks=6, seed=8))
    filter_.belief().map.remove(np.array([0]))
    return Example(frame=planar_world(6, landmarks=6, seed=8).frames[5], belief=filter_.belief())


@pytest.mark.parametrize("known", [True, False])
def test_sound_sensors(known):
    filter_, world = Recipe(known=known).build(), planar_world(6, seed=8)
    drive(filter_, world, 0, 5)
    (sensor,) = filter_.sensors
    assert check_model(sensor, example=Example(frame=world.frames[5], belief=filter_.belief())) == []


Z, COV = np.array([[3.0, 0.1], [4.0, 0.2]]), np.repeat(np.diag([0.1, 0.1])[None], 2, axis=0)
GROUP = Observations(Z, COV, RangeBearing(SE2), ids=np.array([1, 2]))
BIRTHS = Births(Z, COV, RangeBearing(SE2), Point(2))
SENSORS = {
    "Watching.observe, for a group, returned a str, expected Observations": Watching(["seen"]),
    r"Watching.observe: z of RangeBearing has shape \(2, 1\), expected \(any, 2\)": Watching(
        [replace(GROUP, z=Z[:, :1])]
    ),
    "Watching.observe: z of RangeBearing holds NaN": Watching([replace(GROUP, z=Z * np.nan)]),
    r"Watching.observe: cov of RangeBearing has shape \(1, 2, 2\), expected \(2, 2, 2\)": Watching(
        [replace(GROUP, cov=COV[:1])]
    ),
    "Watching.observe: cov of RangeBearing is not positive semi-definite": Watching([replace(GROUP, cov=-COV)]),
    "Watching.observe gives no ids, but RangeBearing reads a landmark": Watching([replace(GROUP, ids=None)]),
    r"Watching.observe: ids has shape \(3,\), expected \(2,\) or \(40, 2\)": Watching(
        [replace(GROUP, ids=np.array([1, 2, 3]))]
    ),
    "Watching.observe: ids are float64, expected integers": Watching([replace(GROUP, ids=np.array([1.0, 2.0]))]),
    r"Watching.observe names landmarks \[0, 99\], which the map does not hold": Watching(
        [replace(GROUP, ids=np.array([99, 0]))]
    ),
    "Watching.observe: ids below -2 mean nothing": Watching([replace(GROUP, ids=np.array([-3, 1]))]),
    "Watching.births, for a group, returned a Observations, expected Births": Watching([], [GROUP]),
    r"Watching.births: mask has shape \(2,\), expected \(40, 2\)": Watching(
        [], [replace(BIRTHS, mask=np.ones(2, dtype=bool))]
    ),
    "Watching.births gives 1 facts for 2 landmarks, expected one each or none": Watching(
        [], [replace(BIRTHS, facts=["oak"])]
    ),
}


@pytest.mark.parametrize("sentence", SENSORS)
def test_findings_about_sensors(sentence, example):
    findings = check_model(SENSORS[sentence], example=example)
    assert len(findings) == 1
    says(findings, sentence)


def test_a_sensor_answers_for_its_models(example):
    class Unwrapped(RangeBearing):  # type: ignore[misc]
        residual = ObservationModel.residual

    sensor = Watching([replace(GROUP, model=Unwrapped(SE2), likelihood=LIKELIHOODS[next(iter(LIKELIHOODS))])])
    findings = check_model(sensor, example=example)
    says(findings, r"Unwrapped.residual jumps by 2π in component \[1\]")
    says(findings, "Broken.log_density integrates to")


def test_a_sensor_that_draws(example):
    class Drawing(Sensor):
        def observe(self, frame, belief):
            return [replace(GROUP, z=Z + 1e-6 * next(COUNTS))]

    says(check_model(Drawing(), example=example), "Drawing.observe returns different numbers")


def test_a_sensor_needs_a_frame():
    with pytest.raises(InputError, match=r"Watching is tried on a frame and a belief: give Example\(frame=…, belief"):
        check_model(Watching())
