"""Every mistake in an observation model gets its sentence, and sound ones get none."""

from typing import Any

import numpy as np
import pytest

from rbpf.conformance import Example, check_model, require_sound
from rbpf.core.models import Jacobians, ObservationModel, Part, Records
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Euclidean
from rbpf.maps.mixture import MixturePoint, ring
from rbpf.maps.point import AnchoredPoint
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition
from tests.core.scripted import Polar, says

MOUNTED = SE3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.3]))


class Anchored(Polar):
    """The landmark lies in the frame of an anchor."""

    def predict(self, state, landmark=None, const=None, substate=None):
        return super().predict(state, SE2.transform(const, landmark))

    invert = ObservationModel.invert

    def initialise(self, state, z, cov):
        """The anchor is the pose of the first sighting."""
        point = np.stack([z[..., 0] * np.cos(z[..., 1]), z[..., 0] * np.sin(z[..., 1])], axis=-1)
        n, k = state.shape[0], z.shape[0]
        mean = np.broadcast_to(point, (n, k, 2)).copy()
        return Records(mean, np.broadcast_to(np.eye(2), (n, k, 2, 2)), np.repeat(state[:, None], k, axis=1))


class RangeOnly(Polar):
    """Starts landmarks as rings."""

    dim = 1

    def predict(self, state, landmark=None, const=None, substate=None):
        return super().predict(state, landmark)[..., :1]

    def residual(self, z, predicted):
        return z - predicted

    invert = ObservationModel.invert

    def initialise(self, state, z, cov):
        return ring(state[:, 1:], z[:, 0], float(np.sqrt(cov[0, 0, 0])), 6)


class Speed(ObservationModel):
    """State and substate, with a constant Jacobian."""

    dim = 1
    space = Euclidean(2)
    reads = frozenset({Part.STATE, Part.SUBSTATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state[..., :1] + substate.sum(axis=-1, keepdims=True)

    def jacobians(self, state, landmark=None, const=None, substate=None):
        return Jacobians(np.array([[1.0, 0.0]]), None, np.ones((1, substate.shape[-1])))


@pytest.mark.parametrize(
    ("model", "example"),
    [
        (Polar(), None),
        (RangeBearing(SE2), None),
        (RangeBearing(SE2, np.array([0.3, 1.0, -0.5]), max_range=6.0, half_field_of_view=0.7), None),
        (RangeBearing(SE3, MOUNTED, pitch_sign=-1.0), None),
        (RelativePosition(SE2), None),
        (RelativePosition(SE3, MOUNTED), None),
        (Anchored(), Example(landmark=AnchoredPoint(SE2))),
        (RangeOnly(), Example(landmark=MixturePoint(6))),
        (Speed(), Example(substate=3)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_sound_models(model, example):
    assert check_model(model, example=example) == []
    require_sound(model, example=example)


def broken(**methods: Any) -> Polar:
    """A Polar with other methods."""
    for name, method in methods.items():
        method.__name__ = name
    return type("Broken", (Polar,), methods)()


def predicting(change) -> Polar:
    return broken(predict=lambda self, *args, **_: change(Polar.predict(self, *args)))


def with_jacobians(change) -> Polar:
    def jacobians(self, state, landmark=None, const=None, substate=None):
        return change(RangeBearing(SE2).jacobians(state, landmark))

    return broken(jacobians=jacobians)


def only_two_axes(self, state, landmark=None, const=None, substate=None):
    return Polar.predict(self, state.reshape(5, 1, 3), landmark.reshape(5, -1, 2))


CALLS = iter(range(10**9))

PREDICT = {
    r"Broken.predict for states \(5, 1, 3\) has shape \(5, 4, 1\), expected \(5, 4, 2\)": predicting(
        lambda z: z[..., :1]
    ),
    r"Broken.predict for states \(5, 1, 3\) holds NaN or infinity": predicting(lambda z: z * np.nan),
    r"Broken.predict for states \(5, 1, 3\) is a list, expected a NumPy array": predicting(
        lambda z: z.tolist()
    ),
    "Broken.predict raised ZeroDivisionError for arguments of shapes .*: integer division": predicting(
        lambda z: 1 // 0
    ),
    "Broken.predict raised ValueError for arguments of shapes": broken(predict=only_two_axes),
    r"Broken.predict does not broadcast, for a single state: expected .*, found .* at": predicting(
        lambda z: z + z.size
    ),
    r"Broken.predict does not broadcast, with two more leading axes: expected": predicting(
        lambda z: z + (z.ndim > 3)
    ),
    "Broken.predict returns different numbers for the same arguments": predicting(
        lambda z: z + 1e-9 * next(CALLS)
    ),
}
RESIDUAL = {
    r"Broken.residual jumps by 2π in component \[1\]: wrap angles": broken(
        residual=ObservationModel.residual
    ),
    r"Broken.residual of z \(4, 2\) and predictions \(5, 4, 2\) has shape \(5, 4\)": broken(
        residual=lambda self, z, h: (z - h)[..., 0]
    ),
    "Broken.residual of a prediction and itself: expected 0, found 1": broken(
        residual=lambda self, z, h: z - h + 1
    ),
    "Broken.residual of h [+] δ and h is not δ: expected 0.0002, found -0.0002": broken(
        residual=lambda self, z, h: Polar.residual(self, h, z)
    ),
    "Broken.residual changes its arguments in place": broken(
        residual=lambda self, z, h: np.subtract(z, h, out=h)
    ),
}
VISIBLE = {
    r"Broken.visible has shape \(5, 400\), expected \(5, 4\)": broken(
        visible=lambda self, state, landmark, const=None: np.ones((5, 400), dtype=bool)
    ),
    "Broken.visible returns float64, expected bool": broken(
        visible=lambda self, state, landmark, const=None: np.ones(
            Polar.predict(self, state, landmark).shape[:-1]
        )
    ),
}
JACOBIANS = {
    r"Broken.jacobians: block state has shape \(5, 4, 2, 2\), expected \(5, 4, 2, 3\)": with_jacobians(
        lambda j: Jacobians(j.state[..., :2], j.landmark)
    ),
    "Broken.jacobians: block state differs from the numeric derivative: expected": with_jacobians(
        lambda j: Jacobians(-j.state, j.landmark)
    ),
    "Broken.jacobians: block landmark differs from the numeric derivative: expected": with_jacobians(
        lambda j: Jacobians(j.state, j.landmark * 1.001)
    ),
    "Broken.jacobians: block landmark holds NaN": with_jacobians(
        lambda j: Jacobians(j.state, j.landmark * np.nan)
    ),
    "Broken.jacobians gives no derivative by the landmark, which the model reads": with_jacobians(
        lambda j: Jacobians(j.state)
    ),
    "Broken.jacobians returned a ndarray, expected Jacobians or None": with_jacobians(lambda j: j.state),
}
INVERSE = {
    "Broken.invert is not the inverse of predict, residual of .*: expected 0, found": broken(
        invert=lambda self, state, z: Polar.invert(self, state, z * np.array([1.0, -1.0]))
    ),
    r"Broken.invert for z \(5, 4, 2\) has shape \(5, 4, 3\), expected \(5, 4, 2\)": broken(
        invert=lambda self, state, z: np.zeros((*z.shape[:-1], 3))
    ),
}


def starting(change) -> Polar:
    def initialise(self, state, z, cov):
        return change(ObservationModel.initialise(self, state, z, cov))

    return broken(initialise=initialise)


INITIALISE = {
    "Broken.initialise returned a tuple, expected Records": starting(lambda r: (r.mean, r.cov)),
    r"Broken.initialise: mean has shape \(4, 5, 2\), expected \(5, 4, 2\)": starting(
        lambda r: Records(r.mean.swapaxes(0, 1), r.cov)
    ),
    r"Broken.initialise: cov has shape \(5, 4, 2\), expected \(5, 4, 2, 2\)": starting(
        lambda r: Records(r.mean, r.cov[..., 0])
    ),
    "Broken.initialise: cov is not positive semi-definite, its lowest eigenvalue is -": starting(
        lambda r: Records(r.mean, -r.cov)
    ),
    "Broken.initialise: cov is not symmetric, entries differ by 1": starting(
        lambda r: Records(r.mean, r.cov + np.array([[0.0, 1.0], [0.0, 0.0]]))
    ),
    "Broken.initialise gives estimates whose prediction is .* away from z, expected less": starting(
        lambda r: Records(1.1 * r.mean, r.cov)
    ),
}
FINDINGS = {**PREDICT, **RESIDUAL, **VISIBLE, **JACOBIANS, **INVERSE, **INITIALISE}


@pytest.mark.parametrize("sentence", FINDINGS)
def test_findings(sentence):
    findings = check_model(FINDINGS[sentence])
    assert len(findings) >= 1
    says(findings, sentence)
    with pytest.raises(InputError, match=sentence):
        require_sound(FINDINGS[sentence])


def test_a_sentence_is_all_that_is_said_about_one_mistake():
    for sentence in (
        "Broken.residual jumps",
        "Broken.visible returns",
        "Broken.jacobians gives no derivative",
    ):
        model = next(model for text, model in FINDINGS.items() if text.startswith(sentence))
        assert len(check_model(model)) == 1


class Components(RangeOnly):
    """Rings whose weights do not sum to one."""

    def initialise(self, state, z, cov):
        records = super().initialise(state, z, cov)
        return Records(records.mean, records.cov, None, 0.0 * records.log_weights)


class Forgetful(Anchored):
    """Rows without their constants."""

    def initialise(self, state, z, cov):
        records = super().initialise(state, z, cov)
        return Records(records.mean, records.cov)


def test_findings_about_what_a_parametrisation_needs():
    findings = check_model(Components(), example=Example(landmark=MixturePoint(6)))
    assert findings == ["Components.initialise: weights of the components: expected 1, found 6 at (0, 0)"]
    findings = check_model(Forgetful(), example=Example(landmark=AnchoredPoint(SE2)))
    assert findings == ["Forgetful.initialise: const is a NoneType, expected a NumPy array"]


def test_what_a_check_cannot_do_without():
    class Spaceless(Polar):
        space: Any = None

    with pytest.raises(InputError, match="Spaceless has no attribute space: tell check_model the group"):
        check_model(Spaceless())
    assert check_model(Spaceless(), SE2) == []
    with pytest.raises(InputError, match=r"Speed reads a substate: give Example\(substate=its size\)"):
        check_model(Speed())
    with pytest.raises(InputError, match="RangeBearing sees too few random landmarks"):
        check_model(RangeBearing(SE2, max_range=0.05))
    with pytest.raises(InputError, match=r"takes a model of rbpf\.core\.models, not a int"):
        check_model(7)


def test_states_and_landmarks_of_the_users_own():
    near = Example(
        state=np.zeros((2, 3)),
        records=Records(np.full((2, 3, 2), 0.03), np.broadcast_to(np.eye(2), (2, 3, 2, 2))),
    )
    assert check_model(RangeBearing(SE2, max_range=0.05), example=near) == []
