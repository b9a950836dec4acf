"""Trigonometry without calls or branches, so that a loop over lanes compiles to vector instructions."""

import math

from numba import njit

_STEEP = math.tan(math.pi / 8)
_QUARTER = 0.5 * math.pi
#: π/2 to 33 bits (W. Cody and W. Waite, 1980): its product with a whole number below 2²⁰ is exact.
_QUARTER_HIGH = 1.57079632673412561417
_QUARTER_REST = 6.07710050650619224932e-11  #: The remainder of π/2.
_PAIRS = 10  #: Pairs of terms of arctan: the first neglected one, z²⁰/41 with z ≤ tan²(π/8), is 1e−17.
_NESTED = 8  #: Terms of sine and cosine: the first neglected ones, (π/4)¹⁷/17! and (π/4)¹⁸/18!, are below 5e−17.


@njit(cache=True, error_model="numpy", forceinline=True)
def cos_sin(angle):
    """Cosine and sine, within 2e−16 up to a million radians and within the angle's own rounding beyond.

    The angle is reduced to [−π/4, π/4] by quarter turns, where both Taylor series are short. From 1e15 rad on, where
    neighbouring doubles are a radian apart, the result is meaningless; at infinity it is not finite.
    """
    quarters = math.floor(angle / _QUARTER + 0.5)
    rest = angle - quarters * _QUARTER_HIGH - quarters * _QUARTER_REST
    square = rest * rest
    c, s = 1.0, 1.0
    for k in range(_NESTED):
        n = 2.0 * (_NESTED - k)
        c = 1.0 - c * square * (1.0 / (n * (n - 1.0)))
        s = 1.0 - s * square * (1.0 / (n * (n + 1.0)))
    s *= rest
    turn = quarters - 4.0 * math.floor(0.25 * quarters)
    odd = turn == 1.0 or turn == 3.0
    cosine, sine = s if odd else c, c if odd else s
    return -cosine if turn == 1.0 or turn == 2.0 else cosine, -sine if turn >= 2.0 else sine


@njit(cache=True, error_model="numpy", forceinline=True)
def arctan2(y, x):
    """Angle of (x, y) in [−π, π], within 5e−16 of `math.atan2`; ±0 at the origin, NaN if x and y are infinite.

    The vector is reflected into the first octant and, above π/8, rotated by −π/4; then arctan t = t Σ (−t²)ᵏ/(2k + 1),
    with separate sums over even and odd k. Comparisons replace `min` and `max`, which would lose a NaN.
    """
    above = abs(y) > abs(x)
    low, high = abs(x) if above else abs(y), abs(y) if above else abs(x)
    steep = low > _STEEP * high
    high = 1.0 if high == 0.0 else high
    t = (low - high if steep else low) / (low + high if steep else high)
    z = t * t
    even, odd = 0.0, 0.0
    for k in range(_PAIRS):
        even = 1.0 / (4 * _PAIRS - 3 - 4 * k) + even * z * z
        odd = 1.0 / (4 * _PAIRS - 1 - 4 * k) + odd * z * z
    angle = t * (even - odd * z) + (0.25 * math.pi if steep else 0.0)
    angle = _QUARTER - angle if above else angle
    angle = math.pi - angle if x < 0.0 else angle
    return math.copysign(angle, y)
