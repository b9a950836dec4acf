"""The joint map against the Kalman filter: the same Gaussian, whenever the particles are consolidated."""

from copy import deepcopy
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.special import logsumexp
from scipy.stats import gamma, norm

from rbpf.core.filter import Filter
from rbpf.core.genealogy import Lineage
from rbpf.core.likelihoods import Gaussian, GaussianWithOutliers, StudentT, TruncatedMahalanobis
from rbpf.core.models import Belief, Likelihood, NewLandmarks, Observations, Part, Records
from rbpf.core.particles import Particles, Prior, balanced, uniform_log_weights
from rbpf.core.proposals import PriorProposal
from rbpf.core.resampling import Consolidation
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Euclidean
from rbpf.maps.joint.rows import Group, with_tails
from rbpf.maps.joint_map import JointMap
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition
from tests.exactness.models import Frame, Kalman, LinearObservation, Relative, Scripted
from tests.exactness.slam import ALONG, DRIFTING, NOISE, TURNED, LinearSlam, Walk, turned, velocity, walked

EVERY_STEP = (Consolidation(window=1), Consolidation(window=9, threshold=1.0))


def plane(consolidation, n=12, seed=0) -> Filter:
    rng = np.random.default_rng(seed)
    return Filter(Walk(), Scripted(), JointMap(Euclidean(2)), None, None, n, rng, lag=1, consolidation=consolidation)


def told(filter_: Filter) -> tuple[np.ndarray, list[np.ndarray]]:
    """Mean of pose and landmarks in the world, and their covariances one by one."""
    joint = filter_.belief().map
    assert isinstance(joint, JointMap)
    pose, cov = filter_.belief().moments(Part.STATE)
    points, covs = filter_.belief().moments(joint.ids)
    turn = joint.space.rotation(pose)
    dim = joint.point.dim
    return np.concatenate([pose[-dim:], points.ravel()]), [turn @ cov[-dim:, -dim:] @ turn.T, *covs]


def assert_same(filter_: Filter, kalman: Kalman, moving: int = 2, rtol: float = 1e-7) -> None:
    mean, covs = told(filter_)
    np.testing.assert_allclose(mean, np.delete(kalman.mean, np.s_[2:moving]), rtol, rtol)
    for place, cov in zip([0, *range(moving, kalman.mean.size, 2)], covs, strict=True):
        np.testing.assert_allclose(cov, kalman.cov[place : place + 2, place : place + 2], rtol, rtol)
    assert filter_.log_evidence == pytest.approx(kalman.log_evidence, abs=10 * rtol)


@pytest.fixture(scope="module")
def world() -> LinearSlam:
    return walked()


@pytest.mark.parametrize("consolidation", EVERY_STEP, ids=repr)
def test_consolidated_before_every_step_it_is_the_kalman_filter(world, consolidation):
    filter_ = plane(consolidation, 10)
    for frame in world.frames(Relative()):
        filter_.step(frame)
    assert_same(filter_, world.kalman)


@pytest.mark.parametrize(
    ("consolidation", "proposal"),
    [(Consolidation(2), None), (Consolidation(9, 0.9), PriorProposal()), (Consolidation(9, 0.0), None)],
    ids=["often", "bootstrap", "seldom"],
)
def test_whatever_the_trigger_it_comes_to_the_kalman_filter(world, consolidation, proposal):
    filter_ = plane(consolidation, 6000)
    for frame in world.frames(Relative()):
        filter_.step(frame, proposal=proposal)
    assert_same(filter_, world.kalman, rtol=0.06)


def test_few_particles_stray_by_chance_not_to_one_side(world):
    """Their mean over many runs is the exact one, where a window is longer than a step."""
    runs = []
    for seed in range(80):
        filter_ = plane(Consolidation(3), 30, seed)
        for frame in world.frames(Relative()):
            filter_.step(frame)
        runs.append(np.append(told(filter_)[0] - world.kalman.mean, filter_.log_evidence - world.kalman.log_evidence))
    runs = np.array(runs)
    assert np.abs(runs.mean(axis=0) / (runs.std(axis=0) / np.sqrt(len(runs)))).max() < 3.5
    assert (runs[:, :-1].std(axis=0) < 0.2 * np.sqrt(np.diag(world.kalman.cov))).all()


def test_a_turned_robot_whose_heading_is_known():
    world, rng = turned(), np.random.default_rng(0)
    options = {"n": 12, "start": TURNED, "lag": 1, "consolidation": Consolidation(1), "rng": rng}
    filter_ = Filter(OdometryMotion(SE2), Scripted(), JointMap(SE2), **options)
    for frame in world.frames(RelativePosition(SE2)):
        filter_.step(frame, ALONG)
    assert_same(filter_, world.kalman)


class Doppler(Relative):
    """Where a landmark will be seen a moment later: it reads the velocity, too."""

    reads = frozenset({Part.STATE, Part.LANDMARK, Part.SUBSTATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return landmark - state - 0.5 * substate


class Restless(Scripted):
    """The landmark may have moved by as much as its noise since it was seen."""

    def observe(self, frame, belief):
        belief.map.loosen(belief.map.ids, NOISE)
        return super().observe(frame, belief)


def test_a_velocity_a_fix_what_reads_velocity_and_landmark_together_and_a_landmark_that_moves():
    (F, noise, drift), kalman = DRIFTING.joint(), velocity()
    joint = JointMap(DRIFTING.space, (kalman.mean[2:], kalman.cov[2:, 2:]))
    options = {"n": 12, "lag": 1, "consolidation": Consolidation(1), "rng": np.random.default_rng(1)}
    filter_ = Filter(DRIFTING, Restless(), joint, **options)
    rng, unit, fix = np.random.default_rng(5), np.eye(2), LinearObservation(np.eye(2))
    covs = NOISE[None]
    for t in range(6):
        z = rng.normal(size=(3, 2))
        still = np.zeros((kalman.mean.size - 4,) * 2)
        kalman.predict(
            block_diag(F, np.eye(len(still))), block_diag(noise, still), np.append(drift, np.zeros(len(still)))
        )
        kalman.cov[4:, 4:] += NOISE if len(still) else still
        groups = [Observations(z[2:], covs, fix)] if t % 3 == 2 else []
        if groups:
            kalman.update(z[2], np.eye(2, kalman.mean.size), NOISE)
        if t:
            ids = np.zeros(1, dtype=np.int64)
            groups += [Observations(z[:1], covs, Relative(), ids=ids), Observations(z[1:2], covs, Doppler(), ids=ids)]
            kalman.update(z[0], np.hstack([-unit, 0 * unit, unit]), NOISE)
            kalman.update(z[1], np.hstack([-unit, -0.5 * unit, unit]), NOISE)
        else:
            kalman.augment(z[0], np.eye(2, 4), NOISE)
        filter_.step(Frame(groups, [] if t else [NewLandmarks(z[:1], covs, Relative(), Point(2))]))
    assert_same(filter_, kalman, moving=4)
    np.testing.assert_allclose(joint.mean[:, 2:4], np.tile(kalman.mean[2:4], (12, 1)), 1e-7)
    np.testing.assert_allclose(joint.cov[2:4, 2:4], kalman.cov[2:4, 2:4], 1e-7)


@pytest.mark.parametrize(("space", "dim"), [(SE2, 2), (SE3, 3)], ids=["plane", "space"])
def test_the_kernel_does_what_numpy_does(space, dim):
    """More particles than a block of lanes has, a last block that is not full."""
    rng, model, ends = np.random.default_rng(6), RangeBearing(space), []
    control = Odometry(space.retract(space.identity(), 0.1 * rng.normal(size=space.dim)), 1e-3 * np.eye(space.dim))
    frames = [rng.normal([4.0, 0.3, 0.1][:dim], 0.05, size=(5, dim)) for _ in range(4)]
    covs, ids = np.repeat(1e-3 * np.eye(dim)[None], 5, axis=0), np.arange(5)
    for compiled in (True, False):
        filter_ = Filter(
            OdometryMotion(space), Scripted(), JointMap(space, compiled=compiled), n=70, lag=1,
            rng=np.random.default_rng(0), consolidation=Consolidation(2),
        )  # fmt: skip
        for t, z in enumerate(frames):
            groups = [Observations(z, covs, model, ids=ids)] if t else []
            born = [] if t else [NewLandmarks(z, covs, model, Point(dim))]
            filter_.step(Frame(groups, born), control if t else None)
        ends.append((*told(filter_), filter_.log_evidence))
    for first, second in zip(*ends, strict=True):
        np.testing.assert_allclose(first, second, 1e-8, 1e-10)


def held(space, n: int, landmarks: int, seed: int = 4) -> tuple[JointMap, Particles]:
    """A map in the middle of a window: its particles differ, and everything is correlated."""
    rng = np.random.default_rng(seed)
    joint, dim = JointMap(space), 2 if space is SE2 else 3
    joint.begin(n, Lineage(n))
    mean = rng.normal(size=(n, landmarks, dim)) * 0.02 + 3 * rng.normal(size=(landmarks, dim))
    joint.add_records(Records(mean, np.broadcast_to(np.eye(dim), (*mean.shape, dim))), joint.point)
    joint.mean[:, : space.dim] = 0.02 * rng.normal(size=(n, space.dim))
    root = 0.05 * rng.normal(size=joint.cov.shape)
    joint.cov, joint.origin = root @ root.T, space.exp(rng.normal(size=space.dim))
    state = space.retract(space.exp(0.4 * rng.normal(size=space.dim)), 0.02 * rng.normal(size=(n, space.dim)))
    weights = rng.uniform(0.5, 1.5, n)
    return joint, Particles(state, np.log(weights / weights.sum()))


@pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
def test_what_is_told_of_the_world_is_the_gaussian_carried_over(space):
    """Of one particle: the covariance by numeric derivatives of the pose and the points by everything held."""
    joint, particles = held(space, 1, 3)
    state, d, step = particles.state[0], space.dim, 1e-6

    def carried(mean: np.ndarray) -> np.ndarray:
        frame = space.retract(joint.origin, mean[:d])
        points = space.transform(frame, mean[d:].reshape(3, -1))
        return np.append(space.local(pose.mean, space.compose(frame, state)), points)

    pose = joint.estimate(particles)
    points, covs = joint.moments(particles)
    np.testing.assert_allclose(carried(joint.mean[0]), np.append(np.zeros(d), points), atol=1e-12)
    steps = step * np.eye(joint.mean.shape[1])
    jac = np.array([carried(joint.mean[0] + e) - carried(joint.mean[0] - e) for e in steps]).T / (2 * step)
    cov = jac @ joint.cov @ jac.T
    np.testing.assert_allclose(pose.cov, cov[:d, :d], atol=1e-8)
    for k, own in enumerate(covs):
        at = slice(d + k * joint.point.dim, d + (k + 1) * joint.point.dim)
        np.testing.assert_allclose(own, cov[at, at], atol=1e-8)


@pytest.mark.parametrize("landmarks", [0, 3])
@pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
def test_consolidation_changes_nothing_that_is_told(space, landmarks):
    joint, particles = held(space, 20, landmarks)
    before = joint.estimate(particles), joint.moments(particles)
    particles = joint.consolidate(particles)
    assert (particles.state == space.identity()).all() and (joint.mean == joint.mean[0]).all()
    after = joint.estimate(particles), joint.moments(particles)
    for first, second in zip(
        (before[0].mean, before[0].cov, *before[1]), (after[0].mean, after[0].cov, *after[1]), strict=True
    ):
        np.testing.assert_allclose(first, second, atol=1e-12)
    assert np.linalg.eigvalsh(joint.cov).min() > -1e-12


def test_particles_of_weight_zero_count_for_nothing():
    joint, particles = held(SE2, 20, 3)
    log_weights = np.concatenate([particles.log_weights[:15], np.full(5, -np.inf)])
    log_weights -= np.log(np.exp(log_weights).sum())
    alone = held(SE2, 20, 3)[0]
    alone.mean, alone.n = alone.mean[:15], 15
    joint.consolidate(Particles(particles.state, log_weights))
    alone.consolidate(Particles(particles.state[:15], log_weights[:15]))
    np.testing.assert_allclose(joint.mean[0], alone.mean[0], atol=1e-12)
    np.testing.assert_allclose(joint.cov, alone.cov, atol=1e-12)


def test_draws_have_the_moments_of_independent_ones():
    rng = np.random.default_rng(0)
    weights = rng.uniform(0.2, 1.0, 30)
    weights /= weights.sum()
    apart = rng.normal(size=(30, 2))
    noise = balanced(rng.normal(size=(30, 4)), weights, apart)
    np.testing.assert_allclose(weights @ noise, 0.0, atol=1e-14)
    np.testing.assert_allclose((weights[:, None] * apart).T @ noise, 0.0, atol=1e-14)
    expected = (1.0 - np.square(weights).sum()) * np.eye(4)
    np.testing.assert_allclose((weights[:, None] * noise).T @ noise, expected, atol=1e-13)


def test_sensors_read_it_as_any_map():
    """With the same Gaussians a map of the particles' own says the same."""
    joint, particles = held(SE2, 15, 3)
    own, model, rng = LandmarkMap(SE2, compiled=False), RelativePosition(SE2), np.random.default_rng(2)
    own.begin(15, Lineage(15))
    own.add_records(joint.read(joint.ids), Point(2))
    prior = Prior(SE2, particles.state, np.zeros((1, 3)), 0.1 * np.eye(3)[None])
    belief = Belief(particles.log_weights, prior, {})
    z = rng.normal(size=(2, 2))

    def told(held) -> list[np.ndarray]:
        some = held.read(held.ids[1:], slice(3))
        nu, jac, _ = held.innovations(model, z, held.ids[:2], particles.state[4], 4)
        expected = held.expected(model, held.ids, belief)
        return [some.mean, some.cov, nu, jac.landmark, *expected, *held.project(model, held.ids, belief)]

    for first, second in zip(told(joint), told(own), strict=True):
        np.testing.assert_allclose(first, second, 1e-12, 1e-12)
    mean, cov = joint.project_jointly(model, joint.ids, belief)
    alone = own.project(model, own.ids, belief)
    np.testing.assert_allclose(mean, alone[0], 1e-12, 1e-12)
    np.testing.assert_allclose([cov[i : i + 2, i : i + 2] for i in (0, 2, 4)], alone[1], 0.01, 1e-3)  # mean slopes
    assert joint.are(np.array([0, 9]), Point(2)).tolist() == [True, False]
    assert joint.landmark_of(2).dim == 2
    assert joint.stored_fraction < 1.0


def test_what_is_expected_of_several_landmarks_is_correlated_as_they_are():
    """Of one particle that stands still, in a sensor that turns: R^T P R, blocks off the diagonal, too."""
    joint, particles = held(SE2, 1, 3)
    standing = Prior(SE2, particles.state, np.zeros((1, 3)), np.zeros((1, 3, 0)))
    turn = np.kron(np.eye(3), SE2.rotation(particles.state[0]))
    mean, cov = joint.project_jointly(RelativePosition(SE2), joint.ids, Belief(particles.log_weights, standing, {}))
    np.testing.assert_allclose(mean, SE2.inverse_transform(particles.state[0], joint.mean[0, 3:].reshape(3, 2)), 1e-12)
    np.testing.assert_allclose(cov, turn.T @ joint.cov[3:, 3:] @ turn, 1e-9, 1e-15)


def test_more_landmarks_than_a_covariance_can_hold():
    joint, _ = held(SE2, 2, 1)
    many = Records(np.zeros((2, 3000, 2)), np.broadcast_to(np.eye(2), (2, 3000, 2, 2)))
    with pytest.raises(InputError, match="at most 2998 landmarks"):
        joint.add_records(many, Point(2))
    assert joint.ids.size == 1


def test_what_a_joint_map_does_not_take(world):
    z, covs, one = np.zeros((1, 2)), NOISE[None], np.zeros(1, dtype=np.int64)
    group = Observations(z, covs, Relative(), ids=one)
    first = Frame([], [NewLandmarks(z, cov, Relative(), Point(2)) for cov in (covs, 1e30 * np.ones((1, 2, 2)))])
    refused = {
        "one association for all particles": replace(group, ids=np.zeros((12, 1), dtype=np.int64)),
        "update state and landmarks": replace(group, updates=frozenset({Part.STATE})),
        "has no landmark 7": replace(group, ids=one + 7),
        r"e\+15: the map diverged": Observations(np.zeros((2, 2)), covs.repeat(2, 0), Relative(), ids=np.arange(2)),
    }
    for words, wrong in refused.items():
        filter_ = plane(Consolidation(1))
        filter_.step(first)
        with pytest.raises(InputError, match=words):
            filter_.step(Frame([wrong]))
    with pytest.raises(InputError, match=r"holds Point\(2\)"):
        plane(Consolidation(1)).step(Frame([], [NewLandmarks(z, covs, Relative(), Point(3))]))
    space = Euclidean(2)
    with pytest.raises(InputError, match="LandmarkMap cannot be consolidated"):
        Filter(Walk(), Scripted(), LandmarkMap(space), n=5, consolidation=Consolidation(1)).step(Frame())
    with pytest.raises(InputError, match="window must be a whole number"):
        Consolidation(window=0)


# Outliers in the joint map: decided once for all particles, weighed by each; against the sum over all choices.

SPACE = Euclidean(2)
OUTLIERS = GaussianWithOutliers(0.1, 1e4)
AT = np.array([[0.0, 0.0], [5.0, 1.0], [-3.0, 4.0], [2.0, -6.0], [7.0, 7.0]])


def six_held(n: int = 6, correlated: bool = True) -> tuple[JointMap, np.ndarray]:
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


OWN = Gaussian()
OWN.kernel_id = -1  # as a user's, which has no compiled twin


def corrected(group: Observations) -> tuple[np.ndarray, np.ndarray, JointMap]:
    """Log-odds, log p(z | x) and the map after the update."""
    joint, state = six_held()
    decided = joint.decided([group], belief(joint, state))
    densities = joint.correct(state, np.zeros_like(state), decided)
    return decided[0].log_odds, densities.all, joint


def test_every_particle_is_weighed_by_the_sum_over_all_choices():
    log_odds, density, _ = corrected(SOME)
    assert (log_odds >= 0.0).tolist() == [True, False, True, True, True, False]
    assert 0.0 < log_odds[3] < 2.0
    np.testing.assert_allclose(density, summed(*six_held(), SOME), atol=1e-3)


@pytest.mark.parametrize("likelihood", [OUTLIERS, StudentT()], ids=["outliers", "tails"])
def test_the_order_of_the_rows_and_groups_does_not_matter(likelihood):
    group = replace(SOME, likelihood=likelihood)
    log_odds, density, joint = corrected(group)
    order = np.array([5, 3, 0, 4, 2, 1])
    other = corrected(replace(group, z=SOME.z[order], ids=SOME.ids[order]))
    if log_odds is not None:
        np.testing.assert_allclose(other[0], log_odds[order], rtol=1e-9)
    np.testing.assert_allclose(other[1], density, rtol=1e-9)
    np.testing.assert_allclose(other[2].mean, joint.mean, atol=1e-12)
    parts = [replace(group, z=SOME.z[rows], cov=SOME.cov[rows], ids=SOME.ids[rows]) for rows in ([3, 1], [0, 2, 4, 5])]
    held_, state = six_held()
    decided = held_.decided(parts, belief(held_, state))
    np.testing.assert_allclose(held_.correct(state, np.zeros_like(state), decided).all, density, rtol=1e-9)


@pytest.mark.parametrize(("dof", "within"), [(1.5, 0.07), (4.0, 0.04), (20.0, 0.025)])
@pytest.mark.parametrize(("known", "error"), [(0.1, 0.0), (0.1, 2.0), (0.1, 6.0), (1.0, 0.3)])
def test_heavy_tails_are_a_noise_of_each_measurement(dof, within, known, error):
    """Beside the integral over λ: its mean, and a bound of the density, for one reading of a landmark known to `known`."""
    group = Observations(np.zeros((1, 1)), np.ones((1, 1, 1)), LinearObservation([[1.0]]), StudentT(dof))
    part = Group(group.likelihood, np.array([[0]]), np.array([np.inf]), None)
    [found] = with_tails([group], np.array([error]), np.array([[known + 1.0]]), [part])
    log_scale, step = np.linspace(-12.0, 5.0, 20_001, retstep=True)
    scale = np.exp(log_scale)
    density = (
        norm.pdf(error, 0.0, np.sqrt(known + 1.0 / scale)) * gamma.pdf(scale, dof / 2.0, scale=2.0 / dof) * scale * step
    )
    assert 1.0 / found.cov[0, 0, 0] == pytest.approx((density * scale).sum() / density.sum(), rel=within)
    bound = norm.logpdf(error, 0.0, np.sqrt(known + found.cov[0, 0, 0])) + found.log_factor
    assert 0.0 < np.log(density.sum()) - bound < within


def test_without_tails_they_are_a_gaussian_beside_which_there_may_be_outliers():
    rows = [0, 2, 4], [3, 1, 5]
    first, second = [replace(SOME, z=SOME.z[at], cov=SOME.cov[at], ids=SOME.ids[at]) for at in rows]
    found = []
    for likelihood in (StudentT(1e9), None):
        joint, state = six_held()
        decided = joint.decided([second, replace(first, likelihood=likelihood)], belief(joint, state))
        found.append((decided[0].log_odds, joint.correct(state, np.zeros_like(state), decided).all, joint.mean))
    for one, two in zip(*found, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6)


@pytest.mark.parametrize("n", [1, 6])
def test_nothing_but_outliers_updates_nothing(n):
    joint, state = six_held(n)
    mean, cov = joint.mean, joint.cov
    decided = joint.decided([replace(SOME, z=SOME.z + 40.0)], belief(joint, state))
    assert (decided[0].log_odds < 0.0).all()
    found = joint.information(state, decided, Prior.exactly(SPACE, state))
    density = joint.correct(state, np.zeros_like(state), decided).all
    np.testing.assert_array_equal(found.info, 0.0)
    np.testing.assert_allclose(density, 6 * OUTLIERS.log_outlier())
    np.testing.assert_allclose(found.log_factor, density)
    np.testing.assert_array_equal(joint.mean, mean)
    np.testing.assert_array_equal(joint.cov, cov)


@pytest.mark.parametrize(
    "likelihood", [Gaussian(), OUTLIERS, TruncatedMahalanobis(), TruncatedMahalanobis(4.0, 16.0), OWN]
)
def test_landmarks_that_are_independent_weigh_as_in_a_map_of_the_particles_own(likelihood):
    joint, state = six_held(correlated=False)
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
