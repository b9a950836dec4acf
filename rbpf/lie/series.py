"""Trigonometric coefficients of the closed-form Jacobians, exact down to angle zero.

With x = theta^2, and series below x = 1 where the closed forms cancel:

    b = (1 - cos theta) / theta^2                       = sum_k (-x)^k / (2k + 2)!
    c = (theta - sin theta) / theta^3                   = sum_k (-x)^k / (2k + 3)!
    d = (theta^2 / 2 + cos theta - 1) / theta^4         = sum_k (-x)^k / (2k + 4)!
    e = (2 theta - 3 sin theta + theta cos theta) / (2 theta^5)
                                                        = sum_k (-x)^k (k + 1) / (2k + 5)!
"""

from math import factorial

import numpy as np

from rbpf.lie.base import Array

# Added to theta^2, so that no division sees zero: its root is far below any angle that changes a result.
TINY = 1e-300

_TERMS = 10
_C_SERIES = [(-1) ** k / factorial(2 * k + 3) for k in range(_TERMS)]
_D_SERIES = [(-1) ** k / factorial(2 * k + 4) for k in range(_TERMS)]
_E_SERIES = [(-1) ** k * (k + 1) / factorial(2 * k + 5) for k in range(_TERMS)]


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


def coefficient_d(theta_squared: Array) -> Array:
    """(theta^2 / 2 + cos theta - 1) / theta^4."""
    x = np.maximum(theta_squared, 1.0)
    closed = (0.5 * x + np.cos(np.sqrt(x)) - 1.0) / np.square(x)
    return _blend(_D_SERIES, theta_squared, closed)


def coefficient_e(theta_squared: Array) -> Array:
    """(2 theta - 3 sin theta + theta cos theta) / (2 theta^5)."""
    x = np.maximum(theta_squared, 1.0)
    theta = np.sqrt(x)
    closed = (2.0 * theta - 3.0 * np.sin(theta) + theta * np.cos(theta)) / (2.0 * np.square(x) * theta)
    return _blend(_E_SERIES, theta_squared, closed)


def inverse_coefficient(theta_squared: Array) -> Array:
    """(1 - (theta / 2) cot(theta / 2)) / theta^2, singular at 2 pi.

    Its rounding error is that of 1 / theta^2, and every use multiplies it by theta^2.
    """
    x = theta_squared + TINY
    half = 0.5 * np.sqrt(x)
    return (1.0 - half * np.cos(half) / np.sin(half)) / x
