"""Every mistake in a motion model, a parametrisation or a likelihood gets its sentence."""

from dataclasses import replace
from math import lgamma

import numpy as np
import pytest

from rbpf.conformance import Example, check_model, require_sound
from rbpf.core.likelihoods import Gaussian, GaussianWithOutliers, TruncatedMahalanobis, squared_mahalanobis
from rbpf.core.models import (
    Landmark,
    Likelihood,
    MotionModel,
    Records,
    Transition,
)
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Euclidean
from rbpf.maps.mixture import MixturePoint
from rbpf.maps.point import AnchoredPoint, Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from tests.core.scripted import says

COUNTS = iter(range(10**9))


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
    r"Broken.transition: mean has shape \(5, 2\), expected \(5, 3\)": moving(
        lambda t: replace(t, mean=t.mean[:, :2])
    ),
    "Broken.transition: mean holds NaN or infinity": moving(lambda t: replace(t, mean=t.mean / 0.0)),
    r"Broken.transition: noise_factor has shape \(6, 6\), expected \(5, 6, any\) or \(1, 6, any\)": moving(
        lambda t: replace(t, noise_factor=t.noise_factor[0])
    ),
    r"Broken.transition: noise_factor has shape \(1, 3, 6\)": moving(
        lambda t: replace(t, noise_factor=t.noise_factor[:, :3])
    ),
    "must give coupling, dynamics and drift together, or none of them": moving(
        lambda t: replace(t, drift=None)
    ),
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
    r"Broken.homogeneous for means \(5, 4, 2\) has shape \(5, 4, 2\), expected \(5, 4, 4\) or": landmark_with(
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
    findings = check_model(LANDMARKS[sentence])
    assert len(findings) == 1
    says(findings, sentence)


class StudentT(Likelihood):
    """Two degrees of freedom: heavier tails than any Gaussian, and no compiled twin."""

    def log_density(self, nu, cov):
        p = nu.shape[-1]
        constant = lgamma(1.0 + 0.5 * p) - 0.5 * (np.linalg.slogdet(cov)[1] + p * np.log(2.0 * np.pi))
        return constant - (1.0 + 0.5 * p) * np.log1p(0.5 * squared_mahalanobis(nu, cov))


@pytest.mark.parametrize(
    "likelihood",
    [
        Gaussian(),
        TruncatedMahalanobis(),
        GaussianWithOutliers(0.1, 20.0),
        GaussianWithOutliers(0.5, 1e4),
        StudentT(),
    ],
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
    r"Broken.kernel_id is 7, expected one of \(-1, 0, 1, 2\)": likelihood_with(kernel_id=7),
    "Broken.params is not one axis of float64 numbers": likelihood_with(kernel_id=0, params=[0.0]),
    "Broken.log_density differs from its compiled kernel 0: expected": likelihood_with(kernel_id=0),
}


@pytest.mark.parametrize("sentence", LIKELIHOODS)
def test_findings_about_likelihoods(sentence):
    findings = check_model(LIKELIHOODS[sentence])
    assert len(findings) == 1
    says(findings, sentence)


def test_an_inlier_that_differs_from_the_compiled_one():
    class Broken(Gaussian):  # type: ignore[misc]
        def inlier(self, nu, cov):
            return np.abs(nu[..., 0]) < 1.0

    assert check_model(Broken()) == ["Broken.inlier differs from its compiled kernel 0"]
