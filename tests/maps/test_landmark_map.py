"""A map by itself: kinds side by side, promotion, readiness, log-odds, rings."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.genealogy import Lineage
from rbpf.core.models import NewLandmarks, Observations, Records
from rbpf.core.particles import Prior
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import AnchoredPoint, MixturePoint, Point, ring
from rbpf.sensors.range_bearing import RangeBearing

N = 40


def filled(evidence: bool = False) -> tuple[LandmarkMap, Lineage]:
    lineage, landmark_map = Lineage(N), LandmarkMap(SE2, evidence=evidence)
    landmark_map.begin(N, lineage)
    return landmark_map, lineage


def points(rng: np.random.Generator, k: int, dim: int = 2) -> Records:
    return Records(rng.normal(size=(N, k, dim)), np.broadcast_to(0.1 * np.eye(dim), (N, k, dim, dim)).copy())


def resample(landmark_map: LandmarkMap, lineage: Lineage, rng: np.random.Generator) -> np.ndarray:
    ancestors = np.sort(rng.integers(0, N, N))
    lineage.advance(ancestors)
    landmark_map.resample(ancestors)
    return ancestors


def test_kinds_side_by_side_follow_their_particles():
    rng = np.random.default_rng(0)
    landmark_map, lineage = filled()
    plane, mixture = points(rng, 2), ring(rng.normal(size=(N, 2)), np.array([4.0]), 2.0, 5)
    free = points(rng, 1)
    anchors = Records(free.mean, free.cov, SE2.exp(rng.normal(size=(N, 1, 3))))
    ids = [
        landmark_map.add_records(plane, Point(2)),
        landmark_map.add_records(mixture, MixturePoint(5)),
        landmark_map.add_records(anchors, AnchoredPoint(SE2)),
    ]
    assert np.concatenate(ids).tolist() == [0, 1, 2, 3]
    row = np.arange(N)
    for _ in range(30):
        row = row[resample(landmark_map, lineage, rng)]
    for which, expected in zip(ids, (plane, mixture, anchors), strict=True):
        found = landmark_map.read(which)
        np.testing.assert_array_equal(found.mean, expected.mean[row])
        np.testing.assert_array_equal(found.cov, expected.cov[row])
    assert np.array_equal(np.asarray(landmark_map.read(ids[1]).log_weights), np.asarray(mixture.log_weights)[row])
    assert np.array_equal(np.asarray(landmark_map.read(ids[2]).const), np.asarray(anchors.const)[row])
    assert isinstance(landmark_map.landmark_of(2), MixturePoint)
    with pytest.raises(InputError, match="one parametrisation at a time"):
        landmark_map.read(np.array([0, 2]))


def test_a_ring_promotes_to_its_moments():
    rng = np.random.default_rng(2)
    landmark_map, _ = filled()
    centre = rng.normal(size=(N, 2))
    mixture = ring(centre, np.array([4.0]), 0.5, 9)
    ids = landmark_map.add_records(mixture, MixturePoint(9))
    landmark_map.promote(ids)
    assert isinstance(landmark_map.landmark_of(0), Point)
    found = landmark_map.read(ids)
    # Equal weights: the centre, and half of the squared radius on each axis beside the components' own share.
    np.testing.assert_allclose(found.mean[:, 0], centre, atol=1e-12)
    own = mixture.cov[0, 0].mean(axis=0)
    np.testing.assert_allclose(found.cov[:, 0], np.broadcast_to(8.0 * np.eye(2) + own, (N, 2, 2)), atol=1e-10)


def test_ready_when_enough_of_the_weight_says_so():
    landmark_map, _ = filled()
    mixture = ring(np.zeros((N, 2)), np.array([4.0]), 2.1, 4)
    dominant = np.log(np.array([0.997, 0.001, 0.001, 0.001]))
    log_weights = np.where(np.arange(N)[:, None, None] < N // 2, dominant, np.log(0.25))
    landmark_map.add_records(points(np.random.default_rng(0), 1), Point(2))
    ids = landmark_map.add_records(Records(mixture.mean, mixture.cov, None, log_weights), MixturePoint(4))
    weights = np.where(np.arange(N) < N // 2, 0.96, 0.04) / (N // 2)
    assert landmark_map.ready(weights).tolist() == ids.tolist()
    assert landmark_map.ready(weights, fraction=0.97).size == 0
    assert landmark_map.ready(np.full(N, 1 / N)).size == 0


def test_log_odds_follow_their_particle_outlast_promotion_and_end_what_nobody_holds():
    rng = np.random.default_rng(4)
    landmark_map, lineage = filled(evidence=True)
    log_odds = rng.normal(size=(N, 3))
    mixtures = ring(rng.normal(size=(N, 2)), np.array([4.0, 5.0, 6.0]), 3.1, 4)
    ids = landmark_map.add_records(mixtures, MixturePoint(4), log_odds)
    landmark_map.promote(ids)
    np.testing.assert_array_equal(landmark_map.log_odds(ids), log_odds)
    before, log_odds = landmark_map.read(ids), rng.normal(size=(N, 3))
    landmark_map.set_log_odds(ids, log_odds)
    ancestors = resample(landmark_map, lineage, rng)
    np.testing.assert_array_equal(landmark_map.log_odds(ids), log_odds[ancestors])
    np.testing.assert_array_equal(landmark_map.read(ids).mean, before.mean[ancestors])
    np.testing.assert_array_equal(landmark_map.read(ids).cov, before.cov[ancestors])
    log_odds[:, 0], log_odds[1:, 1] = -np.inf, -np.inf
    landmark_map.set_log_odds(ids, log_odds)
    assert landmark_map.ids.tolist() == [1, 2]


def sighting(landmark_id: int) -> list[Observations]:
    z, cov = np.array([[5.0, 0.1]]), 0.01 * np.eye(2)[None]
    return [Observations(z, cov, RangeBearing(SE2), ids=np.array([landmark_id]))]


def test_an_update_by_other_groups_than_the_refinement_is_by_the_groups_it_is_given():
    state, increment = np.zeros((N, 3)), np.zeros((N, 3))
    found = []
    for refined_by in (sighting(0), sighting(1)):
        landmark_map, _ = filled()
        landmark_map.add_records(points(np.random.default_rng(1), 2), Point(2))
        landmark_map.information(state, refined_by, Prior.exactly(SE2, state))
        densities = landmark_map.correct(state, increment, sighting(1))
        found.append((densities.all, landmark_map.read(np.arange(2)).mean))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])
    # A landmark that is removed after the refinement is missed by the update.
    landmark_map.information(state, sighting(1), Prior.exactly(SE2, state))
    landmark_map.remove(np.array([1]))
    with pytest.raises(InputError, match="is of landmark 1, which is not in the map"):
        landmark_map.correct(state, increment, sighting(1))


def numbered(*ids: int) -> NewLandmarks:
    count = len(ids)
    cov = np.repeat(np.eye(2)[None], count, 0)
    return NewLandmarks(np.ones((count, 2)), cov, RangeBearing(SE2), Point(2), ids=np.array(ids))


def test_landmarks_have_the_numbers_that_their_sensor_gives_them():
    """They stay in the order in which they were started; the map goes on counting above the largest."""
    landmark_map, _ = filled()
    state = np.tile(SE2.identity(), (landmark_map.n, 1))
    assert landmark_map.add(numbered(5, 2), state).tolist() == [5, 2]
    assert landmark_map.add(replace(numbered(0), ids=None), state).tolist() == [6]
    landmark_map.remove(np.array([5]))
    assert landmark_map.add(numbered(3, 5), state).tolist() == [3, 5]
    assert landmark_map.ids.tolist() == [2, 6, 3, 5]
    assert landmark_map.holds(np.array([0, 2, 3, 4, 5, 6, 7])).tolist() == [0, 1, 1, 0, 1, 1, 0]


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        ([4, 4], "needs an id of its own: 4 is in use"),
        ([4, 1], "needs an id of its own: 1 is in use"),
        ([4, -1], "as many whole numbers from 0 up"),
        ([4], "ids of 2 new landmarks must be as many"),
        ([4.0, 5.0], "whole numbers"),
    ],
)
@pytest.mark.usefixtures("unchecked_shapes")
def test_numbers_that_no_new_landmark_can_have(ids, message):
    landmark_map, _ = filled()
    state = np.tile(SE2.identity(), (landmark_map.n, 1))
    landmark_map.add(numbered(0, 1), state)
    with pytest.raises(InputError, match=message):
        landmark_map.add(replace(numbered(7, 8), ids=np.array(ids)), state)
    assert landmark_map.ids.tolist() == [0, 1]
