"""The kernels' angle functions against NumPy's, over their whole range; bounds are absolute errors."""

from itertools import product

import numpy as np
from numba import njit

from rbpf.kernels.angles import arctan2, cos_sin

HALF_ULP_OF_ONE = 2.0**-53
ULP_OF_PI = np.spacing(np.pi)
MANY = 20_000


@njit(error_model="numpy")
def cos_sin_of(angles):
    cosine, sine = np.empty_like(angles), np.empty_like(angles)
    for i in range(angles.size):
        cosine[i], sine[i] = cos_sin(angles[i])
    return cosine, sine


@njit(error_model="numpy")
def arctan2_of(y, x):
    angle = np.empty_like(y)
    for i in range(y.size):
        angle[i] = arctan2(y[i], x[i])
    return angle


def test_cosine_and_sine_are_within_an_ulp_of_one(rng):
    """At all magnitudes, at and beside the octants; a huge angle is as good as its rounding."""
    octants = np.arange(-16, 17) * (np.pi / 4)
    beside = [octants, np.nextafter(octants, np.inf), np.nextafter(octants, -np.inf)]
    angles = np.concatenate([rng.uniform(-1.0, 1.0, MANY) * 10.0 ** rng.uniform(-8, 12, MANY), *beside])
    cosine, sine = cos_sin_of(angles)
    bound = 2 * HALF_ULP_OF_ONE + np.where(np.abs(angles) > 1e6, np.spacing(np.abs(angles)), 0.0)
    assert (np.abs(cosine - np.cos(angles)) <= bound).all()
    assert (np.abs(sine - np.sin(angles)) <= bound).all()


def test_a_small_angle_keeps_its_digits_and_its_sign():
    angles = np.array([0.0, -0.0, 5e-324, -5e-324, 1e-300, -1e-20, 1e-9])
    cosine, sine = cos_sin_of(angles)
    np.testing.assert_array_equal(cosine, 1.0)
    np.testing.assert_array_equal(sine, angles)
    np.testing.assert_array_equal(np.signbit(sine), np.signbit(angles))


def test_arctan2_is_within_an_ulp_of_pi_at_all_magnitudes(rng):
    """And all the way round."""
    around = np.linspace(-np.pi, np.pi, MANY + 1)
    y, x = rng.normal(size=(2, MANY)) * 10.0 ** rng.uniform(-150, 150, (2, MANY))
    y, x = np.append(y, np.sin(around)), np.append(x, np.cos(around))
    assert np.abs(arctan2_of(y, x) - np.arctan2(y, x)).max() <= ULP_OF_PI


def test_arctan2_of_a_small_angle_keeps_its_digits_at_the_origin_the_sign_of_y_and_hides_nothing(rng):
    y, x = rng.normal(size=MANY) * 1e-9, rng.uniform(0.1, 10.0, MANY)
    expected = np.arctan2(y, x)
    assert (np.abs(arctan2_of(y, x) - expected) <= 3 * np.spacing(np.abs(expected))).all()


def test_arctan2_on_the_axes_the_diagonals_and_at_the_limits():
    values = (0.0, -0.0, 1.0, -1.0, 5e-324, -5e-324, 8e307, -8e307, np.inf, -np.inf)
    cases = [
        (y, x) for y, x in product(values, values) if not (np.isinf(y) and np.isinf(x)) and not (y == 0.0 and x == 0.0)
    ]
    y, x = np.array(cases).T
    found, expected = arctan2_of(y, x), np.arctan2(y, x)
    assert np.abs(found - expected).max() <= ULP_OF_PI
    np.testing.assert_array_equal(np.signbit(found), np.signbit(expected))
    found = arctan2_of(np.array([0.0, -0.0, 0.0, -0.0]), np.array([0.0, 0.0, -0.0, -0.0]))
    np.testing.assert_array_equal(found, 0.0)
    np.testing.assert_array_equal(np.signbit(found), [False, True, False, True])
    assert not np.isfinite(cos_sin_of(np.array([np.nan, np.inf, -np.inf]))).any()
    others = (0.0, -0.0, 1.0, -1e300, np.inf, np.nan)
    cases = [(np.nan, other) for other in others] + [(other, np.nan) for other in others]
    y, x = np.array(cases).T
    assert np.isnan(arctan2_of(y, x)).all()
