"""Whether GTSAM's factors are what their residuals say."""

from typing import Any

import gtsam
import numpy as np


def check_derivatives(factor: Any, values: Any, rtol: float, step: float = 1e-6) -> None:
    """GTSAM's linearisation of a factor is the numeric derivative of its whitened residual."""
    slope, offset = factor.linearize(values).jacobian()
    np.testing.assert_allclose(-offset, factor.whitenedError(values), atol=1e-9)
    zero, columns = values.zeroVectors(), []
    for key in factor.keys():  # noqa: SIM118, no mapping
        for axis in step * np.eye(len(zero.at(key))):
            errors = [factor.whitenedError(_moved(values, zero, key, sign * axis)) for sign in (1, -1)]
            columns.append((errors[0] - errors[1]) / (2 * step))
    atol = 1e-6 * np.abs(slope).max()
    np.testing.assert_allclose(slope, np.stack(columns, axis=1), rtol=rtol, atol=atol)


def _moved(values: Any, zero: Any, key: int, by: np.ndarray) -> Any:
    """The values, with one of them moved in its tangent space."""
    one, moved = gtsam.VectorValues(), gtsam.VectorValues(zero)
    one.insert(key, by)
    moved.update(one)
    return values.retract(moved)
