"""Unknown association on a joint map: against every explanation, enumerated, and the Kalman filter of each."""

from itertools import product

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_normal

from rbpf.core.filter import Filter
from rbpf.core.likelihoods import Gates, associations
from rbpf.core.models import NEW, NULL
from rbpf.core.resampling import Consolidation
from rbpf.lie import SE2
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RelativePosition
from rbpf.systems.range_bearing.config import AssociationConfig
from rbpf.systems.range_bearing.hypotheses import Hypotheses
from tests.exactness.models import Kalman

NEVER = Gates(accept=1e9, isolate=0.0, log_new=-4.0, log_clutter=-9.0)
"""No gate, and whatever is no landmark's is new."""


def test_the_explanations_are_the_most_probable_ones_of_all_in_their_order():
    """Of correlated landmarks, by their joint density: judged one by one, another explanation would come first."""
    rng = np.random.default_rng(3)
    root = np.concatenate([np.tile(np.eye(2), (4, 1)), 0.15 * rng.normal(size=(8, 3))], axis=1)
    mean, cov = np.array([[0.0, 0.0], [1.5, 0.2], [3.0, 0.0], [4.4, 0.3]]), root @ root.T
    noise, unit = np.repeat(0.01 * np.eye(2)[None], 3, axis=0), np.array([0.0, 0.5, -0.5])
    z = mean[:3] + [1.4, 0.1] + 0.1 * rng.normal(size=(3, 2))
    expected = dict[tuple[int, ...], float]()
    for chosen in product(range(-1, 4), repeat=3):
        took = [k for k in range(3) if chosen[k] >= 0]
        if len({chosen[k] for k in took}) < len(took):
            continue
        rows = [2 * chosen[k] + i for k in took for i in range(2)]
        own = cov[np.ix_(rows, rows)] + block_diag(*noise[took]) if took else np.eye(0)
        fits = multivariate_normal(mean.ravel()[rows], own).logpdf(z[took].ravel()) if took else 0.0
        names = tuple(NEW if one < 0 else one for one in chosen)
        expected[names] = fits + sum(NEVER.log_new - unit[k] for k in range(3) if chosen[k] < 0)
    best = sorted(expected, key=lambda one: -expected[one])[:4]
    found = associations(z, noise, mean, cov, NEVER, unit, 20.0)
    assert [tuple(one.chosen.tolist()) for one in found[:4]] == best
    np.testing.assert_allclose([one.log_density for one in found[:4]], [expected[one] for one in best], 1e-9)
    alone = [((z[k] - mean) ** 2).sum(axis=1).argmin() for k in range(3)]
    assert tuple(alone) != best[0]


def test_what_is_neither_known_nor_alone_is_clutter():
    gates = Gates(9.0, 25.0, -4.0, -9.0)
    mean, noise, unit = np.array([[0.0, 0.0]]), np.repeat(0.5 * np.eye(2)[None], 3, axis=0), np.zeros(3)
    z = np.array([[0.1, 0.0], [3.4, 0.0], [8.0, 0.0]])
    best = associations(z, noise, mean, 0.5 * np.eye(2), gates, unit, 5.0)[0]
    assert best.chosen.tolist() == [0, NULL, NEW]
    nothing = associations(z, noise, np.zeros((0, 2)), np.zeros((0, 0)), gates, unit, 5.0)
    assert len(nothing) == 1 and (nothing[0].chosen == NEW).all()


def test_two_hypotheses_are_the_mixture_of_two_kalman_filters():
    """A robot of known heading loses its place along a wall, and sees one of two landmarks, twice: either may be meant."""
    wide, narrow, R = np.diag([4.0, 0.01]), np.diag([0.01, 0.01]), 0.01 * np.eye(2)
    step, readings = np.array([1.0, 0.0]), [[[3.0, 1.0], [7.0, 1.0]], [[4.3, 1.02]], [[3.25, 0.99]]]
    joint = JointMap(SE2)
    filter_ = Filter(
        OdometryMotion(SE2), NamedLandmarkSensor(RelativePosition(SE2), Point(2)), joint, n=12, lag=1,
        rng=np.random.default_rng(0), consolidation=Consolidation(1),
    )  # fmt: skip
    config = AssociationConfig(new_density=np.exp(-60.0), clutter_density=np.exp(-70.0))
    found = Hypotheses(filter_, RelativePosition(SE2), config)
    evidence = 0.0
    for t, z in enumerate(readings):
        control = None if not t else Odometry(np.append(0.0, step), block_diag(0.0, (None, wide, narrow)[t]))
        evidence += found.step(np.array(z), np.repeat(R[None], len(z), axis=0), control, t)[1].log_evidence

    exact = []
    for landmark in (0, 1):
        kalman = Kalman(np.zeros(2), np.zeros((2, 2)))
        for z in readings[0]:
            kalman.augment(np.array(z), np.eye(2, kalman.mean.size), R)
        for z, Q in zip(readings[1:], (wide, narrow), strict=True):
            kalman.predict(np.eye(6), block_diag(Q, np.zeros((4, 4))), np.append(step, np.zeros(4)))
            H = np.zeros((2, 6))
            H[:, :2], H[:, 2 + 2 * landmark : 4 + 2 * landmark] = -np.eye(2), np.eye(2)
            kalman.update(np.array(z[0]), H, R)
        exact.append(kalman)
    logs = np.array([kalman.log_evidence for kalman in exact])
    assert evidence == pytest.approx(2 * -60.0 + logsumexp(logs), abs=1e-6)
    order = np.argsort(-logs)
    np.testing.assert_allclose(np.exp([each.log_weight for each in found.held]), softmax(logs)[order], 1e-6)
    for each, kalman in zip(found.held, [exact[i] for i in order], strict=True):
        pose = each.map.estimate(each.filter.particles)
        np.testing.assert_allclose(pose.mean[1:], kalman.mean[:2], atol=1e-7)
        np.testing.assert_allclose(pose.cov[1:, 1:], kalman.cov[:2, :2], atol=1e-7)
