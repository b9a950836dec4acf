"""Known points, exact or uncertain, as one landmark."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from rbpf import gaussian
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Records
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import MOST, Constellation
from rbpf.maps.landmark_map import LandmarkMap

POINTS = np.random.default_rng(0).normal(size=(4, 3))
HALF = np.random.default_rng(1).normal(scale=0.01, size=(4, 3, 4))
COVS = HALF @ np.swapaxes(HALF, -1, -2)
FRAME = SE3.exp(np.array([0.4, -0.8, 1.2, 2.0, -1.0, 0.5]))
COV_FRAME = np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]) ** 2


def shape_and_records(n: int, seed: int, scale: float = 0.01) -> tuple[Constellation, Records]:
    """Points of n particles, each near the given shape in a frame of its own, with a joint covariance."""
    rng = np.random.default_rng(seed)
    frames = SE3.retract(FRAME, rng.normal(scale=0.5, size=(n, 6)))
    points = SE3.transform(frames[:, None], POINTS + rng.normal(scale=scale, size=(n, 4, 3)))
    half = rng.normal(scale=0.003, size=(12, 14))
    cov = np.broadcast_to(half @ half.T, (n, 1, 12, 12))
    return Constellation(POINTS, COVS), Records(points.reshape(n, 1, 12), cov)


def test_only_so_many_points_are_one_landmark():
    covs = np.tile(np.eye(3), (MOST + 1, 1, 1))
    assert Constellation(np.zeros((MOST, 3)), covs[:MOST]).dim == 3 * MOST
    with pytest.raises(InputError, match="give 30, or set known=points"):
        Constellation(np.zeros((MOST + 1, 3)), covs)


def test_exact_points_are_as_uncertain_as_their_frame():
    group = Constellation(POINTS, np.zeros((4, 3, 3)))
    by_frame = SE3.rotation(FRAME) @ SE3.transform_jacobian(POINTS)
    slope = by_frame.reshape(12, 6)
    records = group.started(2, SE3.transform(FRAME, POINTS), slope @ COV_FRAME @ slope.T)
    frame, factor = group.frame(records)
    np.testing.assert_allclose(frame, np.tile(FRAME, (2, 1)), atol=1e-9)
    np.testing.assert_allclose(factor[0] @ factor[0].T, COV_FRAME, atol=1e-9)
    places, covs = group.in_group(records)
    np.testing.assert_allclose(places[0], POINTS, atol=1e-9)
    assert np.abs(covs).max() < 1e-9


def test_frame_of_uncertain_points_is_the_best_fit():
    """SciPy finds the same from another start."""
    group, records = shape_and_records(5, seed=2, scale=0.05)
    whiten = np.linalg.inv(gaussian.cholesky(COVS))
    found, _ = group.frame(records)
    for frame, points in zip(found, group.in_world(records), strict=True):

        def misfit(xi: np.ndarray, frame=frame, points=points) -> np.ndarray:
            local = SE3.inverse_transform(SE3.retract(frame, xi), points)
            return (whiten @ (local - POINTS)[..., None]).ravel()

        best = least_squares(misfit, np.full(6, 0.05), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        np.testing.assert_allclose(best, 0.0, atol=1e-7)


def test_covariance_of_the_frame_of_uncertain_points():
    """Drawn points and drawn errors of the shape, fitted one by one: the frame varies by as much as is told."""
    group, records = shape_and_records(1, seed=3, scale=0.0)
    frame, factor = group.frame(records)
    rng, n = np.random.default_rng(4), 20_000
    drawn = records.mean[0] + rng.standard_normal((n, 12)) @ gaussian.psd_factor(records.cov[0, 0]).T
    errors = (gaussian.cholesky(COVS) @ rng.standard_normal((n, 4, 3, 1)))[..., 0]
    drawn = drawn + (SE3.rotation(frame[0]) @ errors[..., None])[..., 0].reshape(n, 12)
    fits, _ = group.frame(Records(drawn[:, None], np.broadcast_to(records.cov, (n, 1, 12, 12))))
    moved = SE3.local(frame[0], fits)
    expected = factor[0] @ factor[0].T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(moved.T @ moved / n - expected) / scale).max() < 0.04


def test_two_groups_in_one_map():
    """Equal groups share a layout, others get their own."""
    held = LandmarkMap(SE3)
    held.begin(2, Lineage(2))
    for points in (POINTS, POINTS.copy(), POINTS + 1.0):
        group = Constellation(points, COVS.copy())
        held.add_records(group.started(2, points, 1e-4 * np.eye(12)), group)
    assert len(held.layouts) == 2
    assert held.store.columns.kinds(np.arange(3)).tolist() == [0, 0, 1]
