"""Every mistake in a user's class gets its sentence, and sound classes get none."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rbpf import gaussian
from rbpf.conformance import Example, check_model
from rbpf.core.likelihoods import Gaussian, GaussianWithOutliers, StudentT, TruncatedMahalanobis, squared_mahalanobis
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import (
    FusedKernel,
    Jacobians,
    Landmark,
    MotionModel,
    NewLandmarks,
    ObservationModel,
    Observations,
    Part,
    Records,
    Sensor,
    Transition,
)
from rbpf.errors import InputError
from rbpf.kernels.signature import BLOCK, observation_kernel
from rbpf.lie import SE2, SE3, Euclidean, Product
from rbpf.maps.constellation import Constellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import AnchoredPoint, MixturePoint, Point, ring
from rbpf.motion.constant_velocity import MarginalVelocity, PosePrior, SampledVelocity
from rbpf.motion.odometry import CAMERA_PLANE, Odometry, OdometryMotion
from rbpf.sensors.camera.points import CameraPoint, CameraRay, EpipolarRay
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition
from tests.core.scripted import Polar, says
from tests.core.worlds import Recipe, drive, planar_world
from tests.exactness.models import Frame, Scripted
from tests.sensors.camera_scenes import CAMERAS

RING = 24
COUNTS = iter(range(10**9))
CORNERS = np.random.default_rng(0).normal(size=(4, 3))
MOUNTED = SE3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.3]))


def broken(base: type, **attributes: Any) -> Any:
    """An object of a class like another one, with other attributes."""
    for name, value in attributes.items():
        if callable(value):
            value.__name__ = name
    return type("Broken", (base,), attributes)()


class Driven(MotionModel):
    """A pose driven by a twist that is marginalised."""

    space = SE2

    def transition(self, state, control, dt):
        factor = np.diag([0.1, 0.2, 0.2, 0.3, 0.3, 0.3])[None]
        coupling = np.repeat(dt * np.eye(3)[None], state.shape[0], axis=0)
        return Transition(state, factor, coupling, np.eye(3)[None], np.zeros((1, 3)))


class Anchored(Polar):
    """The landmark lies in the frame of an anchor, which is the pose of its first observation."""

    invert = ObservationModel.invert

    def predict(self, state, landmark=None, const=None, substate=None):
        return super().predict(state, SE2.transform(const, landmark))

    def initialise(self, state, z, cov):
        point = np.stack([z[..., 0] * np.cos(z[..., 1]), z[..., 0] * np.sin(z[..., 1])], axis=-1)
        n, k = state.shape[0], z.shape[0]
        mean = np.broadcast_to(point, (n, k, 2)).copy()
        return Records(mean, np.broadcast_to(np.eye(2), (n, k, 2, 2)), np.repeat(state[:, None], k, axis=1))


class FromPose(Polar):
    """The state holds more than the pose that points are seen from."""

    space = Product(SE2, Euclidean(1))  # type: ignore[assignment]

    def predict(self, state, landmark=None, const=None, substate=None):
        return super().predict(state[..., :3], landmark)

    def invert(self, state, z):
        return super().invert(state[..., :3], z)


class RangeOnly(Polar):
    """Starts landmarks as rings."""

    dim = 1
    invert = ObservationModel.invert
    residual = ObservationModel.residual

    def predict(self, state, landmark=None, const=None, substate=None):
        return super().predict(state, landmark)[..., :1]

    def initialise(self, state, z, cov):
        return ring(state[:, 1:], z[:, 0], 0.5, RING)


class Speed(ObservationModel):
    """State and substate, with a constant Jacobian."""

    dim = 1
    space = Euclidean(2)
    reads = frozenset({Part.STATE, Part.SUBSTATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state[..., :1] + substate.sum(axis=-1, keepdims=True)

    def jacobians(self, state, landmark=None, const=None, substate=None):
        return Jacobians(np.array([[1.0, 0.0]]), None, np.ones((1, substate.shape[-1])))


class Flat(Landmark):
    """A point in the plane."""

    dim = 2

    def homogeneous(self, mean, const=None):
        return np.concatenate([mean, np.ones((*mean.shape[:-1], 1))], axis=-1)


NEAR = Example(
    state=np.zeros((2, 3)), records=Records(np.full((2, 3, 2), 0.03), np.broadcast_to(np.eye(2), (2, 3, 2, 2)))
)
SOUND: list[tuple[Any, Any, Example | None]] = [
    (OdometryMotion(SE2), None, None),
    (OdometryMotion(SE3), None, None),
    (OdometryMotion(SE2), None, Example(control=Odometry(np.array([0.1, 1, 0]), np.diag([0.1, 0, 0])))),
    (Driven(), None, None),
    (Polar(), None, None),
    (FromPose(), None, None),
    (RangeBearing(SE2), None, None),
    (RangeBearing(SE2, np.array([0.3, 1.0, -0.5]), max_range=6.0, half_field_of_view=0.7), None, None),
    (RangeBearing(SE2, max_range=0.05), None, NEAR),
    (RangeBearing(SE3, MOUNTED, pitch_sign=-1.0), None, None),
    (RelativePosition(SE2), None, None),
    (RelativePosition(SE3, MOUNTED), None, None),
    (Anchored(), None, Example(landmark=AnchoredPoint(SE2))),
    (RangeOnly(), None, Example(landmark=MixturePoint(RING))),
    (Speed(), None, Example(substate=3)),
    *((landmark, SE2, None) for landmark in (Point(2), AnchoredPoint(SE2), MixturePoint(4, 2))),
    *((landmark, SE3, None) for landmark in (Point(3), AnchoredPoint(SE3), MixturePoint(4, 3))),
    (OdometryMotion(SE3, 0.01, CAMERA_PLANE), None, Example(control=Odometry(MOUNTED, 0.01 * np.eye(6)))),
    *(
        (motion, None, Example(control=prior and replace(prior, std_velocity=forgotten)))
        for motion in (MarginalVelocity(0.5), SampledVelocity(0.5), SampledVelocity(0.1, "paper"))
        for prior, forgotten in (
            (None, None),
            (PosePrior(MOUNTED, np.eye(6)), None),
            (PosePrior(MOUNTED, np.eye(6)), 0.3),
        )
    ),
    *((CameraPoint(camera), SE3, None) for camera in CAMERAS.values()),
    *(
        (ray(camera), SE3, Example(landmark=InverseDepth()))
        for camera in CAMERAS.values()
        for ray in (CameraRay, EpipolarRay)
    ),
    *((landmark, SE3, None) for landmark in (InverseDepth(), Constellation(CORNERS, np.zeros((4, 3, 3))))),
    (Constellation(CORNERS, np.tile(1e-4 * np.eye(3), (4, 1, 1))), SE3, None),
    (LandmarkMap(SE2), None, None),
    (KalmanSubstate(SE2, np.zeros(1), np.eye(1), moves=lambda dt: (np.eye(1), np.zeros(1), np.eye(1))), None, None),
    (Gaussian(), None, None),
    (TruncatedMahalanobis(), None, None),
    (GaussianWithOutliers(0.1, 20.0), None, None),
    (GaussianWithOutliers(0.5, 1e4), None, None),
    (StudentT(), None, None),
]


@pytest.mark.parametrize(("model", "space", "example"), SOUND, ids=[type(model).__name__ for model, *_ in SOUND])
def test_sound_models(model, space, example):
    assert check_model(model, space, example=example) == []


def moving(change) -> MotionModel:
    return broken(Driven, transition=lambda self, *args: change(Driven.transition(self, *args)))


class Careless(OdometryMotion):  # type: ignore[misc]
    def transition(self, state, control, dt):
        state += 0.0 * state + 0.1
        return super().transition(state, control, dt)


def predicting(change) -> Polar:
    return broken(Polar, predict=lambda self, *args, **_: change(Polar.predict(self, *args)))


def with_jacobians(change) -> Polar:
    def jacobians(self, state, landmark=None, const=None, substate=None):
        return change(RangeBearing(SE2).jacobians(state, landmark))

    return broken(Polar, jacobians=jacobians)


def starting(change) -> Polar:
    def initialise(self, state, z, cov):
        return change(ObservationModel.initialise(self, state, z, cov))

    return broken(Polar, initialise=initialise)


# fmt: off
MISTAKES: dict[str, Any] = {
    "Broken.transition returned a tuple, expected Transition": moving(lambda t: (t.mean, t.noise_factor)),
    r"Broken.transition: mean has shape \(5, 2\), expected \(5, 3\)": moving(lambda t: replace(t, mean=t.mean[:, :2])),
    "Broken.transition: mean holds NaN or infinity": moving(lambda t: replace(t, mean=t.mean / 0.0)),
    "must give coupling, dynamics and drift together, or none of them": moving(lambda t: replace(t, drift=None)),
    "Broken.transition: mean leaves the group SE2": moving(lambda t: replace(t, mean=t.mean + 7.0)),
    "Broken.transition mixes particles": moving(lambda t: replace(t, mean=t.mean - t.mean.mean(axis=0))),
    "Careless.transition changes its arguments in place": Careless(SE2),
    r"Broken.predict for states \(5, 1, 3\) has shape \(5, 4, 1\)": predicting(lambda z: z[..., :1]),
    r"Broken.predict for states \(5, 1, 3\) is a list, expected a NumPy array": predicting(lambda z: z.tolist()),
    "Broken.predict raised ZeroDivisionError for arguments of shapes .*: integer division":
        predicting(lambda z: 1 // 0),
    r"Broken.predict does not broadcast, for a single state": predicting(lambda z: z + z.size),
    "Broken.residual of a prediction and itself": broken(Polar, residual=lambda self, z, h: z - h + 1),
    "Broken.residual of h [+] δ and h is not δ": broken(Polar, residual=lambda self, z, h: Polar.residual(self, h, z)),
    "Broken.jacobians: block state differs from the numeric derivative: expected":
        with_jacobians(lambda j: Jacobians(-j.state, j.landmark)),
    "Broken.jacobians: block landmark differs from the numeric derivative: expected":
        with_jacobians(lambda j: Jacobians(j.state, j.landmark * 1.001)),
    "Broken.invert is not the inverse of predict, residual of .*: expected 0, found":
        broken(Polar, invert=lambda self, state, z: Polar.invert(self, state, z * np.array([1.0, -1.0]))),
    "Broken.initialise: cov is not positive semi-definite": starting(lambda r: Records(r.mean, -r.cov)),
    "Broken.initialise gives estimates whose prediction is .* away from z, expected less":
        starting(lambda r: Records(1.1 * r.mean, r.cov)),
}
ALONE: dict[str, Any] = {
    r"Broken.residual jumps by 2π in component \[1\]: wrap angles": broken(Polar, residual=ObservationModel.residual),
    "Broken.visible returns float64, expected bool":
        broken(Polar, visible=lambda self, x, landmark, const=None: np.ones(
            Polar.predict(self, x, landmark).shape[:-1]
        )),
    "Broken.jacobians gives no derivative by the landmark": with_jacobians(lambda j: Jacobians(j.state)),
    "Broken.dim is 0, expected an integer of at least 1": broken(Flat, dim=0),
    r"Broken.homogeneous for means \(5, 4, 2\) has shape \(5, 4, 2\), expected \(5, 4, 4\) or":
        broken(Flat, homogeneous=lambda self, mean, const=None: mean.copy()),
    "Broken.ready returns int64": broken(Flat, ready=lambda self, records: np.zeros(records.mean.shape[:2], dtype=int)),
    "Broken.log_density integrates to .* at variance 0.3, expected 1: normalise it, or set":
        broken(StudentT, log_density=lambda self, nu, cov: -0.5 * squared_mahalanobis(nu, cov)),
}
"""Mistakes about which nothing else is said."""
# fmt: on


@pytest.mark.parametrize("sentence", [*MISTAKES, *ALONE])
def test_findings(sentence):
    findings = check_model((MISTAKES | ALONE)[sentence])
    says(findings, sentence)
    assert len(findings) == 1 or sentence in MISTAKES


def test_findings_about_what_a_parametrisation_needs():
    class Components(RangeOnly):
        """Rings whose weights do not sum to one."""

        def initialise(self, state, z, cov):
            records = super().initialise(state, z, cov)
            return replace(records, log_weights=0.0 * records.log_weights)

    class Forgetful(Anchored):
        """Rows without their constants."""

        def initialise(self, state, z, cov):
            return replace(super().initialise(state, z, cov), const=None)

    findings = check_model(Components(), example=Example(landmark=MixturePoint(RING)))
    assert findings == ["Components.initialise: weights of the components: expected 1, found 24 at (0, 0)"]
    findings = check_model(Forgetful(), example=Example(landmark=AnchoredPoint(SE2)))
    assert findings == ["Forgetful.initialise: const is a NoneType, expected a NumPy array"]


def test_what_a_check_cannot_do_without():
    class Spaceless(Polar):
        space: Any = None

    assert check_model(Spaceless(), SE2) == []
    missing: dict[Any, str] = {
        Spaceless(): "Spaceless has no attribute space: tell check_model the group",
        Speed(): r"Speed reads a substate: give Example\(substate=its size\)",
        RangeBearing(SE2, max_range=0.05): "RangeBearing sees too few random landmarks",
        7: r"Landmark, Likelihood, Sensor or Conditional, not a int",
        Scripted(): r"Scripted is tried on a frame and a belief: give Example\(frame=…, belief=…\)",
    }
    for model, message in missing.items():
        with pytest.raises(InputError, match=message):
            check_model(model)


class Kerneled(Polar):
    """A Polar with a compiled twin."""

    def __init__(self, function, params=None) -> None:
        self.function = function
        self.params = RangeBearing(SE2).mounting if params is None else params

    def jacobians(self, state, landmark=None, const=None, substate=None):
        return RangeBearing(SE2).jacobians(state, landmark)

    def kernel(self):
        return FusedKernel(self.function, self.params)


@observation_kernel
def half_filled(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    for i in range(n):
        nu[0, i] = 0.0


@observation_kernel
def beyond_the_end(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    for i in range(n):
        jac_landmark[2, 0, i] = 0.0


def plain(*args):
    """Not compiled."""


def kernels() -> dict[str, Kerneled]:
    sound = RangeBearing(SE2).kernel().function
    turned = RangeBearing(SE2, np.array([0.5, 0.0, 0.0])).mounting
    outside = rf"Kerneled.kernel writes outside jac_landmark, which has shape \(2, 2, {BLOCK}\)"
    return {
        "Kerneled.kernel gives no fused kernel: decorate it with @observation_kernel": Kerneled(plain),
        "Kerneled.kernel gives params that are not one axis of numbers": Kerneled(sound, np.zeros((2, 3))),
        "Kerneled.kernel leaves entries of nu unfilled": Kerneled(half_filled),
        outside: Kerneled(beyond_the_end),
        r"Kerneled.kernel: nu differs from residual\(z, predict\): expected": Kerneled(sound, turned),
    }


@pytest.mark.parametrize("sentence", kernels())
@pytest.mark.usefixtures("unchecked_shapes")
def test_findings_about_kernels(sentence):
    findings = check_model(kernels()[sentence])
    assert len(findings) == 1
    says(findings, sentence)


@pytest.fixture
def example() -> Example:
    """Landmarks 2, 3 and 5 in forty particles."""
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
STARTED = NewLandmarks(Z, COV, RangeBearing(SE2), Point(2))
# fmt: off
OBSERVED: dict[str, Any] = {
    ", for a group, returned a str, expected Observations": "seen",
    r": z of RangeBearing has shape \(2, 1\), expected \(any, 2\)": replace(GROUP, z=Z[:, :1]),
    r": cov of RangeBearing has shape \(1, 2, 2\), expected \(2, 2, 2\)": replace(GROUP, cov=COV[:1]),
    " gives no ids, but RangeBearing reads a landmark": replace(GROUP, ids=None),
    ": ids are float64, expected integers": replace(GROUP, ids=np.array([2.0, 5.0])),
    r" names landmarks \[4, 99\], which the map does not hold": replace(GROUP, ids=np.array([99, 4])),
    ": ids below -2 mean nothing": replace(GROUP, ids=np.array([-3, 2])),
}
NEW: dict[str, Any] = {
    ", for a group, returned a Observations, expected NewLandmarks": GROUP,
    r": mask has shape \(2,\), expected \(40, 2\)": replace(STARTED, mask=np.ones(2, dtype=bool)),
    r" starts landmarks \[2\], which the map holds already": replace(STARTED, ids=np.array([2, 7])),
}
# fmt: on


@pytest.mark.parametrize("sentence", [*OBSERVED, *NEW])
def test_findings_about_sensors(sentence, example):
    observed = sentence in OBSERVED
    frame = Frame([OBSERVED[sentence]]) if observed else Frame([], [NEW[sentence]])
    findings = check_model(Scripted(), example=replace(example, frame=frame))
    assert len(findings) == 1
    says(findings, f"Scripted.{'observe' if observed else 'new_landmarks'}{sentence}")


def test_a_sensor_answers_for_its_models(example):
    class Unwrapped(RangeBearing):  # type: ignore[misc]
        residual = ObservationModel.residual

    twice = broken(StudentT, log_density=lambda self, nu, cov: gaussian.log_density(nu, cov) + np.log(2.0))
    frame = Frame([replace(GROUP, model=Unwrapped(SE2), likelihood=twice)])
    findings = check_model(Scripted(), example=replace(example, frame=frame))
    says(findings, r"Unwrapped.residual jumps by 2π in component \[1\]")
    says(findings, "Broken.log_density integrates to")


def test_a_sensor_that_draws(example):
    class Drawing(Sensor):
        def observe(self, frame, belief):
            return [replace(GROUP, z=Z + 1e-6 * next(COUNTS))]

    says(check_model(Drawing(), example=example), "Drawing.observe returns different numbers")
