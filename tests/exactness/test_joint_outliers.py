"""Outliers in the joint map: decided once for all particles, weighed by each, against the sum over all choices."""

from copy import deepcopy
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.special import logsumexp

from rbpf import gaussian
from rbpf.core.filter import Filter
from rbpf.core.genealogy import Lineage
from rbpf.core.likelihoods import Gaussian, GaussianWithOutliers, TruncatedMahalanobis, squared_mahalanobis
from rbpf.core.models import Belief, Likelihood, Observations, Part, Records
from rbpf.core.particles import Prior, uniform_log_weights
from rbpf.core.resampling import Consolidation
from rbpf.lie import Euclidean
from rbpf.maps.joint_map import JointMap
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from tests.exactness.models import Frame, Kalman, Relative, Scripted
from tests.exactness.slam import NOISE, LinearSlam, Walk, walked

SPACE = Euclidean(2)
OUTLIERS = GaussianWithOutliers(0.1, 1e4)
AT = np.array([[0.0, 0.0], [5.0, 1.0], [-3.0, 4.0], [2.0, -6.0], [7.0, 7.0]])


def held(n: int = 6, correlated: bool = True) -> tuple[JointMap, np.ndarray]:
    """A map in the middle of a window and the states of its particles."""
    rng, joint = np.random.default_rng(0), JointMap(SPACE)
    joint.begin(n, Lineage(n))
    mean = AT + 0.1 * rng.normal(size=(n, *AT.shape))
    joint.add_records(Records(mean, np.broadcast_to(0.3 * np.eye(2), (*mean.shape, 2))), Point(2))
    root = 0.3 * rng.normal(size=joint.cov.shape)
    joint.cov = joint.cov + root @ root.T if correlated else block_diag(np.eye(2), joint.cov[2:, 2:])
    return joint, 0.1 * rng.normal(size=(n, 2))


def belief(joint: JointMap, state: np.ndarray) -> Belief:
    return Belief(uniform_log_weights(len(state)), Prior.exactly(SPACE, state), {Part.LANDMARK: joint})


def seen(likelihood: Likelihood | None, ids: list[int], errors: list[list[float]]) -> Observations:
    noises = np.repeat(NOISE[None], len(ids), axis=0)
    return Observations(AT[ids] + np.array(errors), noises, Relative(), likelihood, np.array(ids))


SOME = seen(OUTLIERS, [0, 1, 2, 3, 4, 0], [[0.1, 0.3], [30.0, 4.0], [-0.2, 0.1], [3.6, -3.2], [0.2, 0.0], [-9.0, 9.0]])
"""Two that are clearly wrong, one of a landmark that is seen twice, and one that is doubtful."""


def summed(joint: JointMap, state: np.ndarray, group: Observations) -> np.ndarray:
    """Log p(z | x) (N,): the sum over all choices of outliers."""
    columns = joint.held.of_one_kind(group.ids).columns.ravel()
    nu = (group.z - joint.mean[:, columns].reshape(len(state), -1, 2) + state[:, None]).reshape(len(state), -1)
    S = joint.cov[np.ix_(columns, columns)] + block_diag(*group.cov)
    terms = []
    for choice in product((True, False), repeat=len(group.z)):
        rows = np.repeat(choice, 2)
        found = np.zeros(len(nu))
        if rows.any():
            inside = nu[:, rows]
            found = -0.5 * np.einsum("nr,rs,ns->n", inside, np.linalg.inv(S[np.ix_(rows, rows)]), inside)
            found -= 0.5 * np.linalg.slogdet(2 * np.pi * S[np.ix_(rows, rows)])[1]
        count = sum(choice)
        terms.append(found + count * OUTLIERS.log_inlier() + (len(choice) - count) * OUTLIERS.log_outlier())
    return logsumexp(terms, axis=0)


def corrected(group: Observations) -> tuple[np.ndarray, np.ndarray, JointMap]:
    """Log-odds, log p(z | x) and the map after the update."""
    joint, state = held()
    decided = joint.decided([group], belief(joint, state))
    densities = joint.correct(state, np.zeros_like(state), decided)
    return decided[0].log_odds, densities.all, joint


def test_every_particle_is_weighed_by_the_sum_over_all_choices():
    log_odds, density, _ = corrected(SOME)
    assert (log_odds >= 0.0).tolist() == [True, False, True, True, True, False]
    assert 0.0 < log_odds[3] < 2.0
    np.testing.assert_allclose(density, summed(*held(), SOME), atol=1e-3)


def test_the_order_of_the_rows_and_groups_does_not_matter():
    log_odds, density, joint = corrected(SOME)
    order = np.array([5, 3, 0, 4, 2, 1])
    other = corrected(replace(SOME, z=SOME.z[order], ids=SOME.ids[order]))
    np.testing.assert_allclose(other[0], log_odds[order], rtol=1e-9)
    np.testing.assert_allclose(other[1], density, rtol=1e-9)
    np.testing.assert_allclose(other[2].mean, joint.mean, atol=1e-12)
    parts = [replace(SOME, z=SOME.z[rows], cov=SOME.cov[rows], ids=SOME.ids[rows]) for rows in ([3, 1], [0, 2, 4, 5])]
    held_, state = held()
    decided = held_.decided(parts, belief(held_, state))
    np.testing.assert_allclose(held_.correct(state, np.zeros_like(state), decided).all, density, rtol=1e-9)


@pytest.mark.parametrize("n", [1, 6])
def test_nothing_but_outliers_updates_nothing(n):
    joint, state = held(n)
    mean, cov = joint.mean, joint.cov
    group = replace(SOME, z=SOME.z + 40.0)
    decided = joint.decided([group], belief(joint, state))
    assert (decided[0].log_odds < 0.0).all()
    found = joint.information(state, decided, Prior.exactly(SPACE, state))
    density = joint.correct(state, np.zeros_like(state), decided).all
    np.testing.assert_array_equal(found.info, 0.0)
    np.testing.assert_allclose(density, 6 * OUTLIERS.log_outlier())
    np.testing.assert_allclose(found.log_factor, density)
    np.testing.assert_array_equal(joint.mean, mean)
    np.testing.assert_array_equal(joint.cov, cov)


class StudentT(Likelihood):
    """One of a user's own, with heavy tails and no outliers: four degrees of freedom, not normalised."""

    normalised = False

    def log_density(self, nu, cov):
        return -3.0 * np.log1p(0.25 * squared_mahalanobis(nu, cov)) - 0.5 * gaussian.log_det(gaussian.cholesky(cov))


@pytest.mark.parametrize(
    "likelihood", [Gaussian(), OUTLIERS, TruncatedMahalanobis(), TruncatedMahalanobis(4.0, 16.0), StudentT()]
)
def test_landmarks_that_are_independent_weigh_as_in_a_map_of_the_particles_own(likelihood):
    joint, state = held(correlated=False)
    own = LandmarkMap(SPACE, compiled=False)
    own.begin(len(state), Lineage(len(state)))
    own.add_records(joint.read(joint.ids), Point(2))
    group = replace(SOME, z=SOME.z[:5], cov=SOME.cov[:5], ids=SOME.ids[:5], likelihood=likelihood)
    found = [
        held.correct(state, np.zeros_like(state), held.decided([group], belief(joint, state))).all
        for held in (joint, own)
    ]
    np.testing.assert_allclose(*found, rtol=1e-9)


def bank(world: LinearSlam, wrong: dict[tuple[int, int], np.ndarray]) -> list[tuple[float, Kalman]]:
    """A Kalman filter for every choice of outliers, with its log-probability and the measurements' density."""
    filters = [(0.0, Kalman(world.start.mean, world.start.cov))]
    for step, (names, z) in enumerate(world.measured):
        still = len(filters[0][1].mean) - 2
        for _, kalman in filters:
            padded = np.append(world.drift, np.zeros(still))
            kalman.predict(np.eye(2 + still), block_diag(world.Q, np.zeros((still, still))), padded)
        for row, landmark in enumerate(names):
            at, measured = 2 + 2 * landmark, z[row] + wrong.get((step, row), 0.0)
            H = np.zeros((2, 2 + still))
            H[:, :2] = -np.eye(2)
            if at >= len(filters[0][1].mean):
                for _, kalman in filters:
                    kalman.augment(measured, np.eye(2, len(kalman.mean)), NOISE)
                still += 2
                continue
            H[:, at : at + 2] = np.eye(2)
            others = [(log + OUTLIERS.log_outlier(), deepcopy(kalman)) for log, kalman in filters]
            for _, kalman in filters:
                kalman.update(measured, H, NOISE)
            filters = [(log + OUTLIERS.log_inlier(), kalman) for log, kalman in filters] + others
    return sorted(((log + kalman.log_evidence, kalman) for log, kalman in filters), key=lambda each: -each[0])


@pytest.mark.parametrize(
    ("wrong", "n", "tolerance"),
    [({}, 12, 1e-3), ({(1, 0): [25.0, -8.0], (3, 2): [-9.0, 14.0]}, 12, 1e-3), ({(3, 1): [3.2, 1.9]}, 2000, 0.08)],
    ids=["none", "two", "doubtful"],
)
def test_a_bank_of_kalman_filters(wrong, n, tolerance):
    """The most probable one's mean and covariance, and the evidence of all."""
    world = walked()
    exact = bank(world, {where: np.array(error) for where, error in wrong.items()})
    options = {"n": n, "lag": 1, "consolidation": Consolidation(1), "rng": np.random.default_rng(0)}
    joint = JointMap(SPACE)
    filter_ = Filter(Walk(), Scripted(), joint, **options)
    for step, frame in enumerate(world.frames(Relative())):
        rows = {row: np.array(error) for (when, row), error in wrong.items() if when == step}
        groups = [replace(group, z=group.z.copy(), likelihood=OUTLIERS) for group in frame.groups]
        for row, error in rows.items():
            groups[0].z[row] += error
        filter_.step(Frame(groups, frame.new_landmarks))
    assert filter_.log_evidence == pytest.approx(logsumexp([log for log, _ in exact]), abs=tolerance)
    if n > 12:
        return  # two filters of the bank are as probable
    best = exact[0][1]
    spread = np.sqrt(np.diag(best.cov))
    mean = np.append(joint.estimate(filter_.particles).mean, joint.moments(filter_.particles)[0])
    np.testing.assert_allclose(mean / spread, best.mean / spread, atol=tolerance)
    np.testing.assert_allclose(joint.estimate(filter_.particles).cov, best.cov[:2, :2], rtol=tolerance)
