"""Known points as one landmark: their frame, and the errors of each."""

import numpy as np
import pytest

from rbpf import gaussian
from rbpf.conformance import check_model
from rbpf.errors import InputError
from rbpf.genealogy import Lineage
from rbpf.lie import SE3
from rbpf.maps.constellation import MOST, Constellation
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.models import Records

POINTS = np.random.default_rng(0).normal(size=(4, 3))
HALF = np.random.default_rng(1).normal(scale=0.01, size=(4, 3, 4))
COVS = HALF @ np.swapaxes(HALF, -1, -2)
FRAME = SE3.exp(np.array([0.4, -0.8, 1.2, 2.0, -1.0, 0.5]))
COV_FRAME = np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]) ** 2


def exact(count: int) -> Constellation:
    return Constellation(np.zeros((count, 3)), np.zeros((count, 3, 3)))


@pytest.mark.parametrize("group", [Constellation(POINTS, COVS), exact(4)])
def test_sound_parametrisation(group):
    assert check_model(group, SE3) == []


def test_sizes():
    assert Constellation(POINTS, COVS).dim == 6 + 3 * 4
    assert exact(4).dim == 6
    assert exact(100).dim == 6
    some = COVS * np.array([0.0, 0.0, 1.0, 0.0])[:, None, None]
    assert Constellation(POINTS, some).dim == 6 + 3 * 4


def test_too_many_points_with_errors():
    covs = np.tile(np.eye(3), (MOST + 1, 1, 1))
    assert Constellation(np.zeros((MOST, 3)), covs[:MOST]).dim == 6 + 3 * MOST
    with pytest.raises(InputError, match=f"{MOST + 1} known points have errors of their own: give at most"):
        Constellation(np.zeros((MOST + 1, 3)), covs)


def test_first_records():
    group = Constellation(POINTS, COVS)
    records = group.started(3, FRAME, COV_FRAME)
    assert records.mean.shape == (3, 1, 18)
    np.testing.assert_array_equal(records.mean, 0.0)
    np.testing.assert_array_equal(records.const, np.tile(FRAME, (3, 1, 1)))
    expected = np.zeros((18, 18))
    expected[:6, :6] = COV_FRAME
    for m in range(4):
        expected[6 + 3 * m : 9 + 3 * m, 6 + 3 * m : 9 + 3 * m] = COVS[m]
    for cov in records.cov[:, 0]:
        np.testing.assert_array_equal(cov, expected)
    alone = exact(4).started(2, FRAME, COV_FRAME)
    np.testing.assert_array_equal(alone.cov, np.tile(COV_FRAME, (2, 1, 1, 1)))


def test_frame_is_moved_from_the_constant():
    group, xi = Constellation(POINTS, COVS), np.array([0.3, 0.1, -0.2, 1.0, 2.0, 3.0])
    mean = np.concatenate([xi, np.ones(12)])
    np.testing.assert_allclose(group.frame(mean, FRAME), SE3.compose(FRAME, SE3.exp(xi)), atol=1e-14)
    np.testing.assert_allclose(
        group.homogeneous(mean, FRAME), [*SE3.compose(FRAME, SE3.exp(xi))[4:], 1.0], atol=1e-14
    )


def test_factor_of_the_frame_is_in_the_chart_at_the_frame():
    """Samples of ξ, told as Log(frame⁻¹ G Exp(ξ)); the correlation with the errors does not matter."""
    group, n = Constellation(POINTS, COVS), 200_000
    rng = np.random.default_rng(5)
    half = rng.normal(scale=0.003, size=(18, 20))
    cov = half @ half.T
    mean = np.concatenate([[0.9, -0.7, 1.1, 2.0, 1.0, -3.0], np.zeros(12)])
    records = Records(mean[None, None], cov[None, None], FRAME[None, None])
    factor = group.frame_factor(records)[0]
    xi = mean[:6] + rng.standard_normal((n, 6)) @ gaussian.cholesky(cov[:6, :6]).T
    moved = SE3.local(group.frame(mean, FRAME), SE3.retract(FRAME, xi))
    expected = factor @ factor.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(moved.T @ moved / n - expected) / scale).max() < 0.02
    assert (np.abs(cov[:6, :6] - expected) / scale).max() > 0.2


def test_two_groups_in_one_map():
    """Equal groups share a layout, others get their own."""
    held = LandmarkMap(SE3)
    held.begin(2, Lineage(2))
    for points in (POINTS, POINTS.copy(), POINTS + 1.0):
        group = Constellation(points, COVS.copy())
        held.add_records(group.started(2, FRAME, COV_FRAME), group)
    assert len(held.layouts) == 2
    assert held.kinds[:3].tolist() == [0, 0, 1]
