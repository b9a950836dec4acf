"""Association by maximum likelihood against trying out every explanation."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from rbpf.core.filter import Filter
from rbpf.core.likelihoods import ExistenceModel, Gates, associate
from rbpf.core.models import NEW, NULL, Records, Resampler
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.scripted import Scripted, ids_of, seen
from tests.core.worlds import MAX_RANGE, Recipe, World, anonymous, drive, planar_world


def problem(rng: np.random.Generator, n: int, k: int, m: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Innovations and covariances with many near ties for a small spread."""
    factor = rng.normal(size=(n, k, m, 2, 3))
    return spread * rng.normal(size=(n, k, m, 2)), factor @ np.swapaxes(factor, -1, -2) + 0.3 * np.eye(2)


def explained(nu, cov, present, gates: Gates, choice: tuple[int, ...]) -> float:
    """Log-density of one particle's explanation, −∞ where it is not allowed."""
    total = 0.0
    matched = [landmark for landmark in choice if landmark >= 0]
    if len(set(matched)) < len(matched):
        return -np.inf
    for k, landmark in enumerate(choice):
        squared = np.array([v @ np.linalg.solve(c, v) for v, c in zip(nu[k], cov[k], strict=True)])
        squared[~present] = np.inf
        if landmark >= 0:
            if not squared[landmark] <= gates.accept:
                return -np.inf
            total += multivariate_normal.logpdf(nu[k, landmark], np.zeros(2), cov[k, landmark])
        elif landmark == NEW:
            if squared.min(initial=np.inf) <= gates.isolate:
                return -np.inf
            total += gates.log_new
        else:
            total += gates.log_clutter
    return total


@given(
    seed=st.integers(0, 2**32 - 1),
    k=st.integers(1, 3),
    m=st.integers(0, 3),
    spread=st.sampled_from([0.5, 2.0, 8.0]),
    log_new=st.floats(-12.0, -1.0),
)
def test_no_explanation_is_more_probable(seed, k, m, spread, log_new):
    rng = np.random.default_rng(seed)
    gates = Gates(accept=9.0, isolate=16.0, log_new=log_new, log_clutter=-6.0)
    nu, cov = problem(rng, 2, k, m, spread)
    present = rng.random((2, m)) < 0.7
    chosen = associate(nu, cov, present, gates)
    for i in range(2):
        every = product([NULL, NEW, *range(m)], repeat=k)
        best = max(explained(nu[i], cov[i], present[i], gates, choice) for choice in every)
        found = explained(nu[i], cov[i], present[i], gates, tuple(chosen[i].tolist()))
        assert found == pytest.approx(best, abs=1e-9)


def test_where_clutter_is_impossible_nothing_is_forced_on_a_landmark():
    nu = np.array([[[[4.0, 0.0]], [[0.0, 0.0]], [[0.1, 0.0]]]])
    gates = Gates(9.0, 25.0, -6.0, -np.inf)
    chosen = associate(nu, np.broadcast_to(np.eye(2), (1, 3, 1, 2, 2)), np.ones((1, 1), dtype=bool), gates)
    assert chosen.tolist() == [[NULL, 0, NULL]]


def test_log_odds_of_existence():
    """They grow up to the limit; what is dropped has left, and stays away."""
    model = ExistenceModel(hit=1.0, miss=0.5, limit=3.0, drop=-1.0)
    log_odds = np.array([[0.0, 0.0, 0.0, 0.0, 2.7, -0.5, -0.6, -np.inf]])
    seen = np.array([[True, True, False, False, True, False, False, True]])
    expected = np.array([[True, False, True, False, True, True, True, True]])
    after = [[1.0, 1.0, -0.5, 0.0, 3.0, -1.0, -np.inf, -np.inf]]
    np.testing.assert_array_equal(model.updated(log_odds, seen, expected), after)


# A small world without names, with and without clutter, against the run that knows the names.

STEPS, LANDMARKS = 80, 12
NOTHING = FeatureFrame(0, np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros((0, 2, 2)))


def position_error(world: World, reports) -> float:
    means = np.array([report.estimate.mean for report in reports])
    return float(np.sqrt(np.square(means[:, 1:] - world.truth[:, 1:]).sum(axis=1).mean()))


@pytest.mark.parametrize("clutter", [0.0, 1.0])
def test_map_and_accuracy_are_those_of_the_run_that_knows_the_names(clutter):
    """And landmarks started by clutter leave the map: about one in a frame, which lives while in view, and four misses."""
    world = planar_world(STEPS, LANDMARKS, 3, clutter)
    named = replace(world, frames=[frame.take(frame.landmarks >= 0) for frame in world.frames])
    filter_, reference = Recipe(n=40, known=False).build(), Recipe(n=40).build()
    started, sizes = set(), []

    def count(t, report):
        started.update(report.new_landmarks.tolist())
        sizes.append(filter_.belief().map.ids.size)

    error = position_error(world, drive(filter_, world, after=count))
    assert error < 1.5 * position_error(world, drive(reference, named)) + 0.01
    seen = {name for frame in named.frames for name in frame.landmarks.tolist()}
    landmark_map, weights = filter_.belief().map, filter_.particles.weights
    accepted = landmark_map.ids[weights @ (landmark_map.log_odds(landmark_map.ids) > 0) > 0.5]
    assert len(accepted) == len(seen)
    mean = np.einsum("n,nkd->kd", weights, landmark_map.read(accepted).mean)
    assert np.linalg.norm(mean[:, None] - world.landmarks, axis=-1).min(axis=1).max() < 0.3
    assert (len(started) > 0.8 * STEPS) == (clutter > 0.0) and max(sizes) < 3 * LANDMARKS
    assert np.mean(sizes[-20:]) < 1.1 * np.mean(sizes[40:60])


def one_sighting(distance: float = 3.0, bearing: float = 0.2) -> FeatureFrame:
    return FeatureFrame(0, np.zeros(1, dtype=int), np.array([[distance, bearing]]), np.diag([0.01, 0.001])[None])


def test_life_of_a_landmark():
    """Sightings and misses are counted; nothing seen of nothing is no miss, nor is what is out of sight."""
    sensor = anonymous(RangeBearing(SE2, max_range=MAX_RANGE - 0.5))
    never, landmark_map = EssTriggered(Systematic(), 0.0), LandmarkMap(SE2, evidence=True)
    filter_ = Filter(OdometryMotion(SE2), sensor, landmark_map, resampler=never, n=5, rng=np.random.default_rng(0))
    report = filter_.step(NOTHING)
    assert report.new_landmarks.size == 0 and report.log_evidence == pytest.approx(0.0)
    report = filter_.step(one_sighting())
    assert report.new_landmarks.tolist() == [0] and (ids_of(report) == NEW).all()
    np.testing.assert_array_equal(landmark_map.log_odds(np.array([0])), 0.0)
    report = filter_.step(one_sighting())
    assert (ids_of(report) == 0).all()
    np.testing.assert_array_equal(landmark_map.log_odds(np.array([0])), 1.0)
    # Beside it: neither near enough to be it nor far enough to be another one.
    report = filter_.step(one_sighting(distance=3.65))
    assert (ids_of(report) == NULL).all()
    before = landmark_map.log_odds(np.array([0]))
    for misses in (1, 2, 3):
        filter_.step(NOTHING)
        np.testing.assert_array_equal(landmark_map.log_odds(np.array([0])), before - 0.5 * misses)
    filter_.step(one_sighting(distance=MAX_RANGE - 0.3))
    for _ in range(3):
        filter_.step(NOTHING)
    assert landmark_map.ids.tolist() == [1]
    np.testing.assert_array_equal(landmark_map.log_odds(np.array([1])), 0.0)


class Fixed(Resampler):
    """Always the same ancestors."""

    def __init__(self, ancestors: list[int]) -> None:
        self.chosen = np.array(ancestors)

    def ancestors(self, weights, rng):
        return self.chosen


@pytest.mark.parametrize("compiled", [True, False])
def test_descendants_inherit_the_association_of_their_parent(compiled):
    landmark_map = LandmarkMap(SE2, compiled=compiled)
    filter_ = Filter(OdometryMotion(SE2), Scripted(), landmark_map, resampler=Fixed([3, 3, 4, 4, 5, 5]), n=6)
    mean = np.broadcast_to([[3.0, 0.6], [3.0, 0.7]], (6, 2, 2))
    landmark_map.add_records(Records(mean, np.broadcast_to(np.eye(2), (6, 2, 2, 2))), Point(2))
    ids = np.array([[0], [0], [0], [1], [1], [0]])
    report = filter_.step(seen(RangeBearing(SE2), one_sighting().z, one_sighting().cov_z, ids=ids))
    assert ids_of(report).tolist() == [[1], [1], [1], [1], [0], [0]]
    trace = np.trace(landmark_map.read(np.array([0, 1])).cov, axis1=2, axis2=3)
    assert (trace < 0.1).tolist() == [[False, True]] * 4 + [[True, False]] * 2
