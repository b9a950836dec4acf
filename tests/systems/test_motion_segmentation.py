"""Of several motions the camera's, and what stood still: each thing that is known has its say, and no more."""

from itertools import product

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_vo import MotionEstimate, MotionPrior, VoConfig, candidate_motions
from rbpf.systems.stereo import motion_segmentation
from rbpf.systems.stereo.motion_segmentation import CHANGES, MISTAKEN, MOVING, STATIC, UNKNOWN, camera_motion
from tests.motion.stereo_pairs import LEAP, ROOM, joined, simulate

PRIOR = Odometry(SE3.identity(), np.diag(np.repeat(0.1**2, 6)))
STILL, AWAY = (Odometry(SE3.exp(np.array([0.0, 0.0, 0.0, x, 0.0, 0.0])), 1e-6 * np.eye(6)) for x in (0.0, 0.3))


def motion_of(odometry: Odometry, inliers: np.ndarray) -> MotionEstimate:
    return MotionEstimate(odometry.delta, odometry.cov, inliers)


def candidates(*counts: int, left: int = 5) -> list[MotionEstimate]:
    """Disjoint groups of so many matches that stand still and move away, and some matches that are in none."""
    motions, first = [], 0
    for count, odometry in zip(counts, (STILL, AWAY), strict=True):
        rows = np.arange(sum(counts) + left)
        motions.append(motion_of(odometry, (rows >= first) & (rows < first + count)))
        first += count
    return motions


def chosen(found: list[MotionEstimate], support=(0.0, 0.0, 0.0), informed: bool = False) -> int:
    labels = np.full(found[0].inliers.size, UNKNOWN)
    return camera_motion(found, PRIOR if informed else None, labels, False, np.array(support))


def test_the_group_that_is_the_camera():
    # Where nothing is known the many.
    assert chosen(candidates(20, 30)) == 1 and chosen(candidates(30, 20)) == 0
    # Three standard deviations of a velocity that was measured are exp(4.5) = 90 to one; twice as many do not make up for it.
    assert chosen(candidates(20, 40), informed=True) == 0 and chosen(candidates(20, 40), informed=False) == 1
    assert chosen(candidates(2, 400), informed=True) == 1
    # Landmarks that no motion explains, and a wide prior does: as likely as one match more, whatever was expected.
    assert chosen(candidates(10, 200), (0.0, 0.0, np.log(201) + 0.1)) == -1
    assert chosen(candidates(10, 200), (0.0, 0.0, np.log(201) - 0.1)) == 1
    assert chosen(candidates(10, 2), informed=True) >= 0


@pytest.mark.parametrize("marks", list(product([MOVING, UNKNOWN, STATIC], repeat=3)))
def test_the_past_against_enumeration(marks):
    """P(labels | stands still) / P(labels | moves), summed over whether the thing has changed since the pair before.
    As the support of the map that makes it as likely as none at all, which has no past."""
    labels = np.array(marks)

    def likelihood(is_static: bool) -> float:
        right = [1.0 - MISTAKEN if (mark == STATIC) == is_static else MISTAKEN for mark in marks if mark]
        return float(np.prod(right))

    still, moved = likelihood(True), likelihood(False)
    ratio = ((1 - CHANGES) * still + CHANGES * moved) / ((1 - CHANGES) * moved + CHANGES * still)
    even = -np.log(ratio) - np.log1p((labels == UNKNOWN).sum())
    found = [motion_of(STILL, np.ones(3, dtype=bool))]
    for more, expected in ((1e-9, 0), (-1e-9, -1)):
        assert camera_motion(found, None, labels, False, np.array([even + more, 0.0])) == expected


def test_the_past_is_no_proof():
    """A thing of 1,000 features that has stopped: bounded by how often things stop."""
    found = [motion_of(STILL, np.ones(1000, dtype=bool))]
    even = np.log((1 - CHANGES) / CHANGES)
    for more, expected in ((1e-6, 0), (-1e-6, -1)):
        support = np.array([even + more, 0.0])
        assert camera_motion(found, None, np.full(1000, MOVING), False, support) == expected


def test_when_a_single_motion_is_doubted():
    agree = np.array([1, 1, 1, 1, 0, 0, 0], dtype=bool)
    assert not motion_segmentation.contradicts(agree[:0], np.zeros(0), False)
    assert not motion_segmentation.contradicts(agree, np.array([1, 1, 1, 0, 1, 0, 0]), False)
    assert motion_segmentation.contradicts(agree, np.array([1, 0, 0, 0, 1, 1, 0]), False)
    assert motion_segmentation.contradicts(agree, np.array([-1, -1, 0, 0, 0, 0, 0]), False)
    assert motion_segmentation.contradicts(agree, np.zeros(7), hidden=True)


@pytest.mark.parametrize("seed", range(3))
def test_the_few_that_stood_still_before(seed):
    """A room of 20 matches and a thing of 60 that has leapt."""
    rng = np.random.default_rng(seed)
    room, thing = simulate(ROOM, 20, rng), simulate(LEAP, 60, rng)
    both = joined(room.matches, thing.matches)
    expected = MotionPrior().increment(np.zeros(6), 0.1)
    found, _ = candidate_motions(both, expected, np.random.default_rng(1), VoConfig())
    labels = np.concatenate([np.full(20, STATIC), np.full(60, MOVING)])
    for known, pair in ((np.zeros(80), thing), (labels, room)):
        motion = found[camera_motion(found, None, known, False, np.zeros(3))]
        assert np.linalg.norm(SE3.local(motion.odometry.delta, pair.delta)) < 0.02
