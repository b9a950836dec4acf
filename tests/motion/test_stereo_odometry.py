"""Visual odometry as a motion model: what particles are moved by, in six and in three degrees of freedom."""

import numpy as np
import pytest

from rbpf.conformance import Example, check_model
from rbpf.core.filter import Filter
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_odometry import StereoOdometry
from tests.core.scripted import Scripted

HALF = np.random.default_rng(0).normal(scale=0.02, size=(6, 6))
MEASURED = Odometry(SE3.exp(np.array([0.02, 0.3, -0.01, 0.1, 0.02, 0.5])), HALF @ HALF.T)
PLANAR, OTHER = [1, 3, 5], [0, 2, 4]


def test_six_degrees_of_freedom_are_the_increment_itself():
    law = StereoOdometry().law(MEASURED)
    np.testing.assert_array_equal(law.delta, MEASURED.delta)
    np.testing.assert_array_equal(law.cov, MEASURED.cov)


def test_injected_noise_is_added():
    added = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(StereoOdometry(6, added).law(MEASURED).cov, MEASURED.cov + np.diag(added**2))
    np.testing.assert_allclose(StereoOdometry(6, 0.1).law(MEASURED).cov, MEASURED.cov + 0.01 * np.eye(6))


def test_three_degrees_of_freedom_drop_the_others():
    law = StereoOdometry(3, 0.1).law(MEASURED)
    xi = SE3.log(law.delta)
    np.testing.assert_allclose(xi[PLANAR], SE3.log(MEASURED.delta)[PLANAR], atol=1e-12)
    np.testing.assert_allclose(xi[OTHER], 0.0, atol=1e-15)
    expected = (MEASURED.cov + 0.01 * np.eye(6))[np.ix_(PLANAR, PLANAR)]
    np.testing.assert_allclose(law.cov[np.ix_(PLANAR, PLANAR)], expected)
    np.testing.assert_array_equal(law.cov[OTHER], 0.0)


@pytest.mark.parametrize("dof", [3, 6])
def test_particles_spread_as_the_covariance_says(dof):
    filter_ = Filter(StereoOdometry(dof), Scripted(), n=4000, rng=np.random.default_rng(1))
    law = StereoOdometry(dof).law(MEASURED)
    filter_.step([], MEASURED)
    state = filter_.particles.state
    spread = SE3.local(law.delta, state)
    np.testing.assert_allclose(spread.T @ spread / 4000, law.cov, atol=0.1 * np.abs(law.cov).max())
    if dof == 3:
        for _ in range(20):
            filter_.step([], MEASURED)
        state = filter_.particles.state
        np.testing.assert_allclose(state[:, 5], 0.0, atol=1e-9)
        np.testing.assert_allclose(state[:, [0, 2]], 0.0, atol=1e-9)
        assert state[:, [4, 6]].std(axis=0).min() > 0.01


def test_without_a_control_the_camera_stands_still():
    state = SE3.exp(np.random.default_rng(2).normal(size=(4, 6)))
    transition = StereoOdometry(6, 0.1).transition(state, None, 0.1)
    np.testing.assert_array_equal(transition.mean, state)
    np.testing.assert_array_equal(transition.noise_factor, 0.0)


@pytest.mark.parametrize("dof", [3, 6])
def test_it_is_a_sound_model(dof):
    state = SE3.exp(np.random.default_rng(3).normal(size=(5, 6)))
    assert check_model(StereoOdometry(dof, 0.01), example=Example(state, control=MEASURED)) == []


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((4,), "dof 3 or 6, got 4"),
        ((6, -1.0), "std_added must be"),
        ((6, np.ones(3)), "std_added must be"),
        ((6, np.nan), "std_added must be"),
    ],
)
def test_wrong_arguments_are_refused(arguments, complaint):
    with pytest.raises(InputError, match=complaint):
        StereoOdometry(*arguments)


def test_a_failed_estimate_is_refused_as_a_control():
    state = SE3.identity((2,))
    with pytest.raises(InputError, match="covariance of the odometry is not one"):
        StereoOdometry().transition(state, Odometry(SE3.identity(), np.full((6, 6), np.nan)), 0.1)
