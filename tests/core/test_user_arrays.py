"""Arrays of a user's models and measurements in any type of number, byte order and layout give the same filter."""

import numpy as np
import pytest

from rbpf.conformance import check_model
from rbpf.core import models as core
from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.sensors.range_bearing import RangeBearing
from tests.exactness.models import Frame, Scripted

N = 12
INNER = RangeBearing(SE2)


def locked(array):
    array = array.copy()
    array.setflags(write=False)
    return array


FORMS = {
    "float32": lambda array: array.astype(np.float32),
    "big-endian": lambda array: array.astype(">f8"),
    "fortran": np.asfortranarray,
    "read-only": locked,
    "integer": lambda array: array.astype(int) if (array == np.rint(array)).all() else array,
}


class Moved(core.MotionModel):
    """Goes on by half a metre, and drives a substate that nothing depends on."""

    space = SE2

    def __init__(self, form):
        self.form = form

    def transition(self, state, control, dt):
        mean = SE2.retract(state, np.array([0.1, 0.5, 0.0]))
        noise = np.diag([0.02, 0.05, 0.05, 1.0])[None]
        blocks = np.zeros((1, 3, 1)), np.ones((1, 1, 1)), np.zeros((1, 1))
        return core.Transition(*map(self.form, (mean, noise, *blocks)))


class Seen(core.ObservationModel):
    """Range and bearing, with everything that it says in one form."""

    dim = INNER.dim
    reads = INNER.reads

    def __init__(self, form, fused):
        self.form, self.fused = form, fused

    def predict(self, state, landmark=None, const=None, substate=None):
        return self.form(INNER.predict(state, landmark))

    def jacobians(self, state, landmark=None, const=None, substate=None):
        found = INNER.jacobians(state, landmark)
        return core.Jacobians(*(None if block is None else self.form(np.array(block)) for block in found))

    def residual(self, z, predicted):
        return self.form(INNER.residual(z, predicted))

    def initialise(self, state, z, cov):
        first = INNER.initialise(state, z, cov)
        return core.Records(self.form(first.mean), self.form(first.cov))

    def kernel(self):
        kernel = INNER.kernel()
        return core.FusedKernel(kernel.function, self.form(kernel.params)) if self.fused else None


def drive(form, fused):
    model, rng = Seen(form, fused), np.random.default_rng(3)
    held = LandmarkMap(SE2, compiled=fused)
    substate = KalmanSubstate(SE2, form(np.zeros(1)), form(np.eye(1)))
    start = form(np.zeros((N, 3)))
    filter_ = Filter(Moved(form), Scripted(), [held, substate], n=N, rng=np.random.default_rng(1), start=start)
    points, pose = np.array([[4.0, 1.0], [3.0, -2.0], [6.0, 0.5]]), np.zeros(3)
    for step in range(6):
        pose = SE2.retract(pose, np.array([0.1, 0.5, 0.0]))
        z = INNER.predict(pose, points) + 0.05 * rng.normal(size=(3, 2))
        z, cov = form(z), form(np.tile(np.eye(2), (3, 1, 1)))
        old = [core.Observations(z, cov, model, None, np.arange(3, dtype=np.int32))] if step else []
        filter_.step(Frame(old, [] if step else [core.NewLandmarks(z, cov, model, Point(2))]))
    return filter_.particles, held.read(held.ids)


@pytest.mark.parametrize("fused", [True, False], ids=["compiled", "numpy"])
@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_any_form_of_array_will_do(form, fused, unchecked_shapes):
    plain, points = drive(np.copy, fused)
    other, their_points = drive(form, fused)
    atol = 1e-3 if form is FORMS["float32"] else 1e-12
    np.testing.assert_allclose(other.state, plain.state, atol=atol)
    np.testing.assert_allclose(other.log_weights, plain.log_weights, atol=10.0 * atol)
    np.testing.assert_allclose(their_points.mean, points.mean, atol=atol)
    assert other.state.dtype == their_points.mean.dtype == np.float64
    if form is not FORMS["float32"]:
        assert check_model(Seen(form, fused), SE2) == []


def test_what_is_no_real_number_is_named(unchecked_shapes):
    def imaginary(array):
        return array.astype(complex)

    with pytest.raises(InputError, match=r"Moved\.transition: mean must hold real numbers, got complex128"):
        Filter(Moved(imaginary), Scripted(), KalmanSubstate(SE2, np.zeros(1), np.eye(1)), n=N).step(Frame())
    assert "holds complex128, expected real numbers" in check_model(Seen(imaginary, False), SE2)[0]
