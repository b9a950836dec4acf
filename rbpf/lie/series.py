"""Trigonometric coefficients of the closed-form Jacobians of the plane, exact down to angle zero.

With x = theta^2, and a series below x = 1 where the closed form cancels; `rbpf.kernels.series` has those of space:

    b = (1 - cos theta) / theta^2                       = sum_k (-x)^k / (2k + 2)!
    c = (theta - sin theta) / theta^3                   = sum_k (-x)^k / (2k + 3)!
"""

from math import factorial

import numpy as np

from rbpf.lie.base import Array

# Added to theta^2, so that no division sees zero: its root is far below any angle that changes a result.
TINY = 1e-300

_TERMS = 10
_C_SERIES = [(-1) ** k / factorial(2 * k + 3) for k in range(_TERMS)]


def _horner(coefficients: list[float], x: Array) -> Array:
    total = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _blend(series: list[float], x: Array, closed: Array) -> Array:
    # Clipping keeps the branch that is not taken from overflowing.
    return np.where(x < 1.0, _horner(series, np.minimum(x, 1.0)), closed)


def coefficient_b(theta_squared: Array) -> Array:
    """(1 - cos theta) / theta^2, from the half angle, which does not cancel."""
    theta = np.sqrt(theta_squared + TINY)
    return 2.0 * np.square(np.sin(0.5 * theta) / theta)


def coefficient_c(theta_squared: Array) -> Array:
    """(theta - sin theta) / theta^3."""
    x = np.maximum(theta_squared, 1.0)
    theta = np.sqrt(x)
    return _blend(_C_SERIES, theta_squared, (theta - np.sin(theta)) / (x * theta))
