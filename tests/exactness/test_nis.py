"""The normalised innovation squared and its degrees of freedom count the rows that took part, particle by particle."""

import numpy as np
import pytest

from rbpf.core.filter import Filter, StepReport
from rbpf.core.likelihoods import GaussianWithOutliers, TruncatedMahalanobis
from rbpf.core.models import NEW, NULL, Observations, Records
from rbpf.lie import Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from tests.exactness.models import Frame, LinearMotion, Relative, Scripted

N = 40
PLANE = Euclidean(2)
LANDMARKS = np.array([[3.0, 1.0], [3.2, 0.9]])
EVERY_PATH = pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "numpy"])
HALVES = np.arange(N)[:, None] % 2
"""Particles by which of two landmarks they take."""


def report(z, ids, likelihood=None, compiled=True, factor: float = 0.3, **costs) -> StepReport:
    """Of one step from the origin, with measurements z (K, 2) of landmarks."""
    held = LandmarkMap(PLANE, compiled=compiled)
    motion = LinearMotion(np.eye(2), factor * np.eye(2))
    filter_ = Filter(motion, Scripted(), held, n=N, rng=np.random.default_rng(15))
    held.add_records(Records(np.tile(LANDMARKS, (N, 1, 1)), np.tile(0.05 * np.eye(2), (N, 2, 1, 1))), Point(2))
    z = np.atleast_2d(z)
    group = Observations(z, np.tile(0.1 * np.eye(2), (len(z), 1, 1)), Relative(), likelihood, ids, **costs)
    return filter_.step(Frame([group]))


@EVERY_PATH
def test_two_associations_that_are_split_over_the_particles_are_one_measurement(compiled):
    z = np.array([3.1, 0.95])
    split, one = report(z, HALVES, compiled=compiled), report(z, np.array([0]), compiled=compiled)
    assert split.rows == one.rows == 2.0
    assert split.nis == pytest.approx(one.nis, rel=1e-12)


@EVERY_PATH
@pytest.mark.parametrize("likelihood", [TruncatedMahalanobis(4.0, 16.3), GaussianWithOutliers(0.1, 50.0)])
def test_what_is_gated_is_not_counted(likelihood, compiled):
    far, near = np.array([9.0, 9.0]), np.array([3.05, 1.0])
    gated = report(far, np.array([0]), likelihood, compiled)
    assert (gated.nis, gated.rows) == (0.0, 0.0)
    alone = report(near, np.array([1]), likelihood, compiled)
    both = report(np.stack([far, near]), np.array([0, 1]), likelihood, compiled)
    assert both.rows == alone.rows == 2.0
    assert both.nis == pytest.approx(alone.nis, rel=1e-12)
    twice = report(np.stack([far, near]), np.array([1, 1]), likelihood, compiled)
    assert twice.rows == 2.0


@EVERY_PATH
@pytest.mark.parametrize("outcome", [NEW, NULL])
def test_rows_count_by_the_weight_of_the_particles_that_use_them(outcome, compiled):
    """Those that do not pay a density for it, so that their weight is known."""
    z, density = np.array([3.1, 0.95]), {"log_new": -1.0, "log_clutter": -1.0}
    ids = np.where(np.arange(N)[:, None] % 4 == 0, outcome, 0)
    found, one = report(z, ids, compiled=compiled, **density), report(z, np.array([0]), compiled=compiled)
    known = 0.75 * np.exp(one.log_evidence)
    fraction = known / (known + 0.25 * np.exp(-1.0))
    assert found.rows == pytest.approx(2.0 * fraction, rel=1e-9)
    assert found.nis == pytest.approx(one.nis * fraction, rel=1e-9)
