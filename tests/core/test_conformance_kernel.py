"""Every mistake in a fused kernel gets its sentence."""

import numpy as np
import pytest

from rbpf.conformance import check_model
from rbpf.core.models import FusedKernel, ObservationModel
from rbpf.kernels.signature import BLOCK, observation_kernel
from rbpf.lie import SE2
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.scripted import Polar, says


class Kerneled(Polar):
    """A Polar with a compiled twin."""

    def __init__(self, function, params=None) -> None:
        self.function = function
        self.params = RangeBearing(SE2).mounting() if params is None else params

    def jacobians(self, state, landmark=None, const=None, substate=None):
        return RangeBearing(SE2).jacobians(state, landmark)

    def kernel(self):
        return FusedKernel(self.function, self.params)


@observation_kernel
def wrong_sign(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    for i in range(n):
        for a in range(2):
            nu[a, i] = -z[a]
            for e in range(3):
                jac_state[a, e, i] = 0.0
            for e in range(2):
                jac_landmark[a, e, i] = 0.0


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
    turned = RangeBearing(SE2, np.array([0.5, 0.0, 0.0])).mounting()
    return {
        "Kerneled.kernel gives no fused kernel: decorate it with @observation_kernel": Kerneled(plain),
        "Kerneled.kernel gives params that are not one axis of float64": Kerneled(sound, np.arange(6)),
        r"Kerneled.kernel: nu differs from residual\(z, predict\): expected": Kerneled(wrong_sign),
        "Kerneled.kernel leaves entries of nu unfilled": Kerneled(half_filled),
        rf"Kerneled.kernel writes outside jac_landmark, which has shape \(2, 2, {BLOCK}\)": Kerneled(
            beyond_the_end
        ),
        "Kerneled.kernel: nu differs": Kerneled(sound, turned),
    }


@pytest.mark.parametrize("sentence", kernels())
@pytest.mark.usefixtures("unchecked_shapes")
def test_findings_about_kernels(sentence):
    findings = check_model(kernels()[sentence])
    assert len(findings) == 1
    says(findings, sentence)


def test_kernels_are_compared_with_numeric_derivatives_where_there_are_no_others():
    class Numeric(Kerneled):
        jacobians = ObservationModel.jacobians

    assert check_model(Numeric(RangeBearing(SE2).kernel().function)) == []
    shifted = RangeBearing(SE2, np.array([0.0, 0.0, 1e-3])).kernel()
    assert check_model(Numeric(*shifted))


def test_a_jacobian_that_the_kernel_gets_wrong():
    class Scaled(Kerneled):
        def jacobians(self, state, landmark=None, const=None, substate=None):
            exact = super().jacobians(state, landmark)
            return exact._replace(landmark=exact.landmark * (1.0 + 1e-7))

    findings = check_model(Scaled(RangeBearing(SE2).kernel().function))
    assert len(findings) == 1
    assert findings[0].startswith("Scaled.kernel: jac_landmark differs from NumPy's: expected")
