"""Sub-maps against one Gaussian of everything: the same map and pose, and no more work per step however long the way."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import block_diag

from rbpf import RangeBearingConfig, RangeBearingSlam
from rbpf.core.filter import Filter
from rbpf.core.models import Part
from rbpf.core.resampling import Consolidation
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Euclidean
from rbpf.maps.joint.solution import Constants, Given, SubMap
from rbpf.maps.joint.submaps import SubMaps
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.validation.simulation.robot import RobotWorld, simulated_log
from tests.exactness.models import LinearMotion, Relative
from tests.exactness.slam import DRIFTING, NOISE, STEP, Q, Walk

RING = 80
START = np.array([2.0, 0.5]), np.eye(2)
"""A velocity."""
STEADY = LinearMotion(
    np.eye(2), np.vstack([np.linalg.cholesky(Q), np.zeros((2, 2))]), np.eye(2), np.eye(2), np.zeros(2)
)
"""A `Walk` whose steps are alike, and not known."""
DRIFT = STEP + 0.3, 0.2 * np.eye(2)
FIRST = STEP, 1e-4 * np.eye(2)


class Reading:
    """Landmarks by name."""

    def __init__(self, landmarks: np.ndarray, z: np.ndarray) -> None:
        self.landmarks, self.z, self.cov_z = landmarks, z, np.tile(NOISE, (len(z), 1, 1))


def walk(steps: int = 14) -> tuple[list[Reading], np.ndarray, np.ndarray]:
    """Readings of a `Walk` that sees three new landmarks per step and old ones again, and what they say of all: least squares.
    Names (M,) in the order of the solution; mean and covariance of the last position, then of the landmarks."""
    rng = np.random.default_rng(3)
    position, landmarks, readings = np.zeros(2), {}, []
    rows, values, infos = [], [], []
    columns: dict[object, int] = {}

    def at(name: object) -> int:
        return columns.setdefault(name, 2 * len(columns))

    def say(blocks: dict[object, float], value: np.ndarray, cov: np.ndarray) -> None:
        rows.append({at(name): sign for name, sign in blocks.items()})
        values.append(value)
        infos.append(np.linalg.inv(cov))

    for t in range(steps):
        position = position + STEP + np.linalg.cholesky(Q) @ rng.normal(size=2)
        say({("robot", t): 1.0} | ({("robot", t - 1): -1.0} if t else {}), STEP, Q)
        # The last steps look back at the first landmarks, which the sub-maps between have not.
        seen = np.arange(2 * t, 2 * t + 4) if t < steps - 2 else np.append(np.arange(4), 2 * t + np.arange(2))
        z = []
        for name in seen.tolist():
            landmarks.setdefault(name, position + rng.normal(size=2))
            z.append(landmarks[name] - position + np.linalg.cholesky(NOISE) @ rng.normal(size=2))
            say({name: 1.0, ("robot", t): -1.0}, z[-1], NOISE)
        readings.append(Reading(seen, np.array(z)))
    slope = np.zeros((2 * len(rows), 2 * len(columns)))
    for row, blocks in enumerate(rows):
        for column, sign in blocks.items():
            slope[2 * row : 2 * row + 2, column : column + 2] = sign * np.eye(2)
    weight = block_diag(*infos)
    cov = np.linalg.inv(slope.T @ weight @ slope)
    mean = cov @ slope.T @ weight @ np.concatenate(values)
    kept = np.concatenate([columns[name] + np.arange(2) for name in [("robot", steps - 1), *sorted(landmarks)]])
    return readings, mean[kept], cov[np.ix_(kept, kept)]


@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize("submap", [4, 7, 100])
@pytest.mark.parametrize(
    ("motion", "start", "first"), [(Walk(), None, None), (STEADY, DRIFT, None), (STEADY, DRIFT, FIRST)]
)
def test_joined_they_say_what_one_gaussian_says(submap, window, motion, start, first):
    """Also where constants had another prior at `first`, which is exchanged."""
    readings, mean, cov = walk()
    n, tolerance = (10, 1e-6) if window == 1 else (4000, 0.05)  # a window's samples tell no more
    constants = 0 if start is None else 2
    whole = JointMap(Euclidean(2), start, constants=constants)
    joint = JointMap(Euclidean(2), first or start, submap=submap, constants=constants)
    options = {"n": n, "rng": np.random.default_rng(0), "consolidation": Consolidation(window)}
    filters = [Filter(motion, NamedLandmarkSensor(Relative(), Point(2)), held, **options) for held in (whole, joint)]
    for t, reading in enumerate(readings):
        for filter_ in filters:
            filter_.step(reading)
        if t == 7 and first:
            filters[1].consolidate()
            joint.presume(Constants(*start))
        # The sub-maps of landmarks that return in the end are asked when the window ends.
        if (7 if first else 0) <= t < 12:
            told, pose = (held.estimate(each.particles) for held, each in zip((whole, joint), filters, strict=True))
            np.testing.assert_allclose(np.append(pose.mean, pose.cov), np.append(told.mean, told.cov), atol=tolerance)
    filter_.consolidate()
    before = joint.arrays()
    ids, places, covs = joint.landmarks(filter_.particles)
    np.testing.assert_equal(joint.arrays(), before)  # to be asked changes nothing
    order = np.argsort(ids)
    assert window > 1 or len(joint.old.maps) == {4: 14, 7: 5, 100: 1}[submap]  # the last one ends as it reaches far
    np.testing.assert_array_equal(ids[order], np.arange(ids.size))
    if start is not None:
        names, *expected = whole.landmarks(filters[0].particles)
        mean[2:], cov[2:, 2:] = expected[0][np.argsort(names)].ravel(), block_diag(*expected[1][np.argsort(names)])
    np.testing.assert_allclose(places[order].ravel(), mean[2:], rtol=1e-6, atol=tolerance)
    for row, own in enumerate(covs[order]):
        at = slice(2 + 2 * row, 4 + 2 * row)
        np.testing.assert_allclose(own, cov[at, at], rtol=1e-6, atol=0.0 if window == 1 else tolerance)


def ring(space, seed: int, size: float = 0.05, count: int = 14) -> tuple[list[SubMap], np.ndarray, np.ndarray]:
    """Sub-maps past landmarks on a ring, nine to a round, their true ends (count + 1, E) and landmarks."""
    rng = np.random.default_rng(seed)
    dim = 2 if space is SE2 else 3
    turns = 0.22 * np.pi * np.arange(count + 1)
    tangents = np.zeros((count + 1, space.dim))
    tangents[:, 0 if space is SE2 else 2] = turns
    ends = space.compose(space.exp(tangents), space.exp(np.eye(space.dim)[-dim] * 8.0))
    angles = np.linspace(0.0, 2.0 * np.pi, RING, endpoint=False)
    landmarks = rng.normal(size=(RING, dim))
    landmarks[:, :2] += 10.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    landmarks, ends = space.inverse_transform(ends[0], landmarks), space.between(ends[0], ends)
    found = []
    for begin, end in pairwise(ends):
        ids = np.flatnonzero(np.linalg.norm(space.inverse_transform(end, landmarks), axis=1) < 6.0)
        n = space.dim + dim * ids.size
        factor = size * (rng.normal(size=(n, n)) / np.sqrt(n) + 0.5 * np.eye(n))
        error = factor @ rng.normal(size=n)
        points = space.inverse_transform(end, landmarks[ids]) + error[space.dim :].reshape(-1, dim)
        moved = space.retract(space.between(begin, end), error[: space.dim])
        found.append(SubMap(moved, ids, points, factor @ factor.T))
    return found, ends, landmarks


@pytest.mark.parametrize("space", [SE2, SE3])
def test_what_is_joined_one_by_one_is_what_all_together_say(space):
    """With small errors, where slopes hardly matter: the start, the landmarks about it, and their covariance."""
    finished, *_ = ring(space, 0, 1e-4)
    maps = SubMaps(space, 2 if space is SE2 else 3, RING)
    for each in finished[:6]:
        maps.join(each)
    assert maps.about.ids.size < RING  # nothing has returned: no solution of all was needed
    start, near, points, cov = maps.start, maps.about.ids, maps.about.points, maps.about.cov
    maps.solve()
    np.testing.assert_allclose(space.local(start, maps.start), 0.0, atol=1e-7)
    mine, its = (np.argsort(ids) for ids in (near, maps.about.ids[np.isin(maps.about.ids, near)]))
    np.testing.assert_allclose(points[mine], maps.about.points[np.isin(maps.about.ids, near)][its], atol=1e-7)
    d, (ids, _, covs) = space.dim, maps.landmarks()
    np.testing.assert_allclose(cov[:d, :d], maps.about.cov[:d, :d], rtol=1e-3, atol=1e-4 * cov.max())
    # What is told of every landmark: that of all in one system of equations, whose inverse is dense.
    at = d * len(maps.maps) + maps.dim * np.arange(ids.size)[:, None] + np.arange(maps.dim)
    solution = maps._solve(ids)
    information = np.zeros((solution.eliminated.size + d,) * 2)  # columns of the first start fall behind the end
    for factor in solution.factors:
        slope = factor.through(np.eye(len(factor.residual)))
        information[np.ix_(factor.columns, factor.columns)] += slope.T @ factor.info @ slope
    dense = np.linalg.inv(information[:-d, :-d])
    np.testing.assert_allclose(covs, dense[at[:, :, None], at[:, None]], rtol=1e-4, atol=1e-6 * dense.max())


def test_with_a_landmark_come_back_those_that_were_seen_with_it():
    """Not the nearest, of which the next step would ask for none."""
    finished, *_ = ring(SE2, 0, 1e-4)
    maps = SubMaps(SE2, 2, finished[5].ids.size + 4)
    for each in finished[:6]:
        maps.join(each)
    asked = np.setdiff1d(finished[0].ids, finished[1].ids)[:1]
    maps.solve(asked)
    back = np.setdiff1d(maps.about.ids, finished[5].ids)
    assert back.size == 4 and asked[0] in back and np.isin(back, finished[0].ids).all()


def turning(maps: SubMaps, each: SubMap, by: np.ndarray) -> SubMap:
    """What a robot makes of it whose turns are too large by as much in every sub-map, of which it knows something."""
    space, known, given = maps.space, maps.known, maps.given(each.ids[:0])
    first, nothing = 0 if space is SE2 else 2, np.zeros(known.cov.shape)
    end = space.retract(each.end, np.eye(space.dim)[first] * (by - known.mean).sum())
    slope = np.vstack([-np.eye(len(each.cov))[:, [first] * by.size], np.eye(by.size)])
    cov = block_diag(each.cov, nothing) + slope @ known.cov @ slope.T
    return each._replace(end=end, cov=cov, constants=known.mean, given=given)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("space", "count", "most", "by"),
    [(SE2, 14, 10, 0.0), (SE2, 14, 10, 0.1), (SE3, 14, 10, 0.0), (SE3, 14, 10, 0.1), (SE2, 30, 50, 0.1)],
)
def test_the_place_after_loops_is_as_uncertain_as_told(space, count, most, by):
    """NEES per degree of freedom of the last start and the landmarks about it, over the runs; going round holds no more."""
    pose, near = [], []
    for seed in range(10):
        finished, ends, landmarks = ring(space, seed, count=count)
        wrong = by * np.random.default_rng(seed).normal(size=int(by > 0.0))
        prior = Constants(0.0 * wrong, by**2 * np.eye(wrong.size))
        maps, closed = SubMaps(space, landmarks.shape[1], most, False, prior), 0
        for each in finished:
            closed += bool(maps.returned(each.ids).any())
            maps.join(turning(maps, each, wrong))
        assert closed and len(maps.maps) <= 14
        error, d = space.local(maps.start, ends[-1]), space.dim
        pose.append(error @ np.linalg.solve(maps.about.cov[:d, :d], error) / d)
        error = (maps.about.points - space.inverse_transform(ends[-1], landmarks[maps.about.ids])).ravel()
        error = np.append(error, maps.known.mean - wrong)
        near.append(error @ np.linalg.solve(maps.about.cov[d:, d:], error) / error.size)
    for found in (pose, near):
        assert abs(np.mean(found) - 1.0) < 3.0 * np.std(found) / np.sqrt(len(found)) + 0.05


@pytest.mark.slow
def test_a_step_holds_no_more_than_a_sub_map_and_the_pose_stays_true(tmp_path):
    log = simulated_log(RobotWorld(260, 60, radius_m=8.0, laps=1.2, extent_m=11.0, max_range_m=5.0), 0)
    config = RangeBearingConfig(particles=50, submap=20)
    system, whole = (RangeBearingSlam.of_log(log, replace(config, submap=n)) for n in (20, None))
    errors, sizes = [], []
    for t, frame in enumerate(log.frames):
        found, theirs = system.take(frame), whole.take(frame)
        error = SE2.local(found.pose, log.truth.poses[t])
        errors.append(error @ np.linalg.solve(found.cov, error) / 3.0 if t else 0.0)
        sizes.append(system.joint.cov.shape[0])
        assert np.linalg.norm(found.pose[1:] - theirs.pose[1:]) <= 6.0 * np.sqrt(np.trace(found.cov[1:, 1:]))
    assert len(system.joint.old.maps) > 2 and max(sizes) <= 3 + 2 * 40 < whole.joint.cov.shape[0]
    assert np.mean(errors) < 3.0
    found, theirs = system.map(), whole.map()
    kept, again = tmp_path / "checkpoint.npz", RangeBearingSlam.of_log(log, config)
    system.save(kept)
    again.load(kept)
    np.testing.assert_equal(vars(again.map()), vars(found))
    ends = (each.joint.estimate(each.filter.particles).mean for each in (again, system))
    np.testing.assert_array_equal(*ends)
    assert set(found.ids) == set(theirs.ids)
    error = found.mean - np.array([log.truth.landmarks[name] for name in found.ids.tolist()])
    assert np.einsum("mi,mij,mj->m", error, np.linalg.inv(found.cov), error).mean() < 6.0


@pytest.mark.parametrize(
    ("motion", "start", "first"),
    [(DRIFTING, START, START), (STEADY, DRIFT, DRIFT), (STEADY, DRIFT, FIRST), (Walk(), None, None)],
)
@pytest.mark.parametrize(("most", "by_image", "walks"), [(3, False, True), (50, False, True), (3, True, False)])
def test_what_goes_over_is_known_as_in_one_gaussian(most, by_image, walks, motion, start, first):
    """Of landmarks out of view that come back, from near and, of the smaller, by a solution of all, held before they are seen
    or recognised after it, and that walk; of what is constant, with another prior at `first`, which is exchanged, or not."""
    readings, space = walk(20)[0], Euclidean(2)
    options = {"passed_on": True, "constants": 2 * (motion is STEADY)}
    whole, submaps = JointMap(space, start, **options), JointMap(space, first, submap=most, **options)
    options = {"n": 10, "lag": 1, "consolidation": Consolidation(1)}
    filters = [
        Filter(motion, NamedLandmarkSensor(Relative(), Point(2)), each, rng=np.random.default_rng(0), **options)
        for each in (whole, submaps)
    ]
    evidence, told = np.zeros(2), []
    for t, reading in enumerate(readings):
        following = readings[min(t + 1, len(readings) - 1)].landmarks
        if t % 3 == 2:
            submaps.put_away(np.setdiff1d(submaps.ids, np.append(reading.landmarks, following)))
        if not by_image:
            submaps.bring_back(following[~submaps.holds(following)])
        if walks and t % 3 == 0:  # where a sub-map begins
            for held in (whole, submaps):
                held.loosen(submaps.ids, np.tile(NOISE, (submaps.ids.size, 1, 1)))
        again = np.isin(reading.landmarks, submaps.old.ids) & ~submaps.holds(reading.landmarks)
        parts = reading, Reading(reading.landmarks[~again], reading.z[~again])
        evidence += [filter_.step(part).log_evidence for filter_, part in zip(filters, parts, strict=True)]
        if again.any():
            assert by_image and again.sum() == 4
            submaps.recognise(Given(reading.landmarks[again], reading.z[again], np.kron(np.eye(again.sum()), NOISE)))
        if t == 12 and first is FIRST:
            particles, prior = filters[1].particles, Constants(*start)
            slope, (_, gain) = submaps.pose_by_constants(particles), submaps.presumed(particles, prior)
            (before, _), (pose, _) = submaps.moments(particles, Part.SUBSTATE), submaps.moments(particles, Part.STATE)
            submaps.presume(prior)
            by = slope @ (submaps.moments(particles, Part.SUBSTATE)[0] - before)
            np.testing.assert_allclose(submaps.moments(particles, Part.STATE)[0] - pose, by, atol=1e-6)
            np.testing.assert_allclose(gain, evidence[0] - evidence[1], rtol=1e-5)
    for filter_ in filters:
        belief = filter_.belief()
        ids, places, covs = belief.map.landmarks(filter_.particles)
        order = np.argsort(ids)
        told += [[ids[order], places[order], covs[order], *belief.moments(Part.STATE)]]
        if start is not None:
            told[-1] += belief.moments(Part.SUBSTATE)
    assert len(submaps.old.maps) > 5 and submaps.cov.shape[0] < whole.cov.shape[0] / 2
    for one, other in zip(*told, strict=True):
        np.testing.assert_allclose(other, one, atol=3e-6)


def test_what_is_removed_is_in_no_sub_map():
    """Nor is it told, or the same landmark as one that is begun anew under its name; all else stays as it is."""
    finished, *_ = ring(SE2, 1)
    maps = SubMaps(SE2, 2, 50)
    for each in finished[:6]:
        maps.join(each)
    gone = np.intersect1d(maps.maps[2].ids, maps.maps[3].ids)[:2]
    before = {name: (place, cov) for name, place, cov in zip(*maps.landmarks(), strict=True)}
    maps.forget(gone)
    after = {name: (place, cov) for name, place, cov in zip(*maps.landmarks(), strict=True)}
    assert set(after) == set(before) - set(gone) == set(maps.ids) == set(maps.places()[0])
    for name, found in after.items():
        for one, other in zip(found, before[name], strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)
    assert not maps.returned(gone).any() and min(each.ids.min() for each in maps.maps) < 0
    maps.join(finished[6]._replace(ids=np.append(gone, finished[6].ids[2:])))
    maps.forget(gone)
    assert np.unique(np.concatenate([each.ids for each in maps.maps])).size == len(maps.landmarks()[0]) + 2 * gone.size


def test_a_checkpoint_holds_them_and_a_damaged_one_is_refused():
    finished, *_ = ring(SE2, 1)
    maps, again = (SubMaps(SE2, 2, 10, False, Constants(np.zeros(1), 0.01 * np.eye(1))) for _ in range(2))
    for each in finished:
        maps.join(turning(maps, each, np.array([0.1])))
    maps.look_from(turning(maps, finished[0], np.array([0.1])))
    again.restore(maps.arrays())
    for mine, theirs in zip((*again.known, *again.landmarks()), (*maps.known, *maps.landmarks()), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for name, wrong in {
        "5/end": lambda a: a[1:], "starts": lambda a: a[1:], "0/ids": lambda a: a + 1000, "5/ids": lambda a: np.zeros_like(a),
        "5/cov": lambda a: a[1:, 1:], "0/cov": lambda a: a[1:], "5/tied": lambda a: a + 2, "5/given_cov": lambda a: a[1:],
        "5/given_ids": lambda a: np.append(a, -7), "5/constants": lambda a: a[1:], "5/given_constants": lambda a: a[:0],
    }.items():  # fmt: skip
        damaged = {key: wrong(array) if key.endswith("/" + name) else array for key, array in maps.arrays().items()}
        with pytest.raises(InputError, match="submaps/"):
            again.restore(damaged)


def test_what_was_given_and_cannot_be_taken_off_stays():
    """As when a filter has diverged: what was known before says more than sub-maps do with it."""
    finished, *_ = ring(SE2, 0)
    maps = SubMaps(SE2, 2, RING)
    for each in finished[:5]:
        maps.join(each)
    start, cov = maps.start, maps.about.cov
    maps.maps[3] = maps.maps[3]._replace(given=Given(maps.about.ids[:3], maps.about.points[:3], 1e-8 * np.eye(6)))
    maps.solve()
    np.testing.assert_equal((maps.start, maps.about.cov), (start, cov))
    assert np.linalg.eigvalsh(maps.landmarks()[2]).min() > 0.0
    # Where what was given is all that is known of some, a tenth of it stays: how it is linearised would decide.
    maps.maps[3] = maps.maps[3]._replace(given=None)
    seen, own = (whole := maps._solve(maps.ids)).seen_from(SE2, 3, np.arange(3))
    for told, off in ((0.5, 1.0), (0.9999, 0.9), (1.2, 0.0)):
        maps.maps[3] = maps.maps[3]._replace(given=Given(whole.ids[:3], seen, own[3:, 3:] / told))
        found = maps._solve(maps.ids)
        assert found.is_whole == (off > 0.0)
        left = found.seen_from(SE2, 3, np.arange(3))[1][3:, 3:] * (1.0 - off * told)
        np.testing.assert_allclose(left, own[3:, 3:], rtol=1e-3, atol=1e-5)
    maps.maps[3] = maps.maps[3]._replace(given=Given(maps.about.ids[:3], maps.about.points[:3], 1e-8 * np.eye(6)))
    for factor in (-1.0, 0.0):
        maps.maps[2] = maps.maps[2]._replace(cov=factor * maps.maps[2].cov)
        maps.solve()
        np.testing.assert_equal((maps.start, maps.about.cov), (start, cov))
    with pytest.raises(InputError, match="sub-map's covariance is singular"):
        maps.landmarks()
