"""Coefficients of the closed-form Jacobians of SE(3), exact down to angle zero.

With x = θ², and series below x = 1 where the closed forms cancel:

    b = (1 − cos θ)/θ²                       = Σ_k (−x)^k / (2k + 2)!
    c = (θ − sin θ)/θ³                       = Σ_k (−x)^k / (2k + 3)!
    d = (θ²/2 + cos θ − 1)/θ⁴                = Σ_k (−x)^k / (2k + 4)!
    e = (2θ − 3 sin θ + θ cos θ)/(2θ⁵)       = Σ_k (−x)^k (k + 1) / (2k + 5)!
"""

import math

from numba import njit

TINY = 1e-300
"""Added to θ², so that no division sees zero: its root is far below any angle that changes a result."""

_TERMS = 10
_C = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(_TERMS))
_D = tuple((-1) ** k / math.factorial(2 * k + 4) for k in range(_TERMS))
_E = tuple((-1) ** k * (k + 1) / math.factorial(2 * k + 5) for k in range(_TERMS))


@njit(cache=True, error_model="numpy")
def _horner(coefficients, x):
    total = coefficients[_TERMS - 1]
    for k in range(_TERMS - 2, -1, -1):
        total = total * x + coefficients[k]
    return total


@njit(cache=True, error_model="numpy")
def coefficient_b(x):
    """(1 − cos θ)/θ², from the half angle, which does not cancel."""
    theta = math.sqrt(x + TINY)
    fraction = math.sin(0.5 * theta) / theta
    return 2.0 * (fraction * fraction)


@njit(cache=True, error_model="numpy")
def coefficient_c(x):
    """(θ − sin θ)/θ³."""
    if x < 1.0:
        return _horner(_C, x)
    theta = math.sqrt(x)
    return (theta - math.sin(theta)) / (x * theta)


@njit(cache=True, error_model="numpy")
def coefficient_d(x):
    """(θ²/2 + cos θ − 1)/θ⁴."""
    if x < 1.0:
        return _horner(_D, x)
    return (0.5 * x + math.cos(math.sqrt(x)) - 1.0) / (x * x)


@njit(cache=True, error_model="numpy")
def coefficient_e(x):
    """(2θ − 3 sin θ + θ cos θ)/(2θ⁵)."""
    if x < 1.0:
        return _horner(_E, x)
    theta = math.sqrt(x)
    return (2.0 * theta - 3.0 * math.sin(theta) + theta * math.cos(theta)) / (2.0 * (x * x) * theta)


@njit(cache=True, error_model="numpy")
def inverse_coefficient(x):
    """(1 − (θ/2) cot(θ/2))/θ², singular at 2π.

    Its rounding error is that of 1/θ², and every use multiplies it by θ².
    """
    squared = x + TINY
    half = 0.5 * math.sqrt(squared)
    return (1.0 - half * math.cos(half) / math.sin(half)) / squared
