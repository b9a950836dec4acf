"""Landmarks anchored at clones of the path in a joint map: linear worlds have exact answers, curved ones numeric ones."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from rbpf.core.filter import Filter
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Belief, Landmark, Observations, Part, Records
from rbpf.core.particles import Particles, Prior
from rbpf.core.resampling import Consolidation
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.joint.rows import WIDE
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import AnchoredPoint, MixturePoint, Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraPoint, CameraRay
from rbpf.sensors.range_bearing import RelativePosition
from tests.exactness.models import Kalman, Scripted
from tests.exactness.slam import ALONG, NOISE, STEP, TURNED, Q, turned
from tests.exactness.test_joint_map import assert_same

CAMERA = Pinhole(640, 480, 400.0, 380.0, 319.5, 239.5)


class FromAnchor(RelativePosition):
    """Where a landmark in its anchor's frame is seen; one is started where it is seen, with the robot as its anchor."""

    def predict(self, state, landmark=None, const=None, substate=None):
        return super().predict(state, SE2.transform(const, landmark))

    def jacobians(self, state, landmark=None, const=None, substate=None):
        return None

    def initialise(self, state, z, cov):
        n, k = len(state), len(z)
        anchor = np.broadcast_to(state[:, None], (n, k, 3))
        return Records(np.broadcast_to(z, (n, k, 2)), np.broadcast_to(cov, (n, k, 2, 2)), anchor)

    def kernel(self):
        return None


class Careful(Landmark):
    """An `AnchoredPoint` in the plane whose second coordinate is learnt alone."""

    dim, constants, anchored, learnt_alone = 2, 3, True, 1

    def homogeneous(self, mean, const=None):
        return AnchoredPoint(SE2).homogeneous(mean, const)


def filtered(world, landmark: Landmark) -> Filter:
    """A robot of known heading among anchored landmarks, consolidated in every step."""
    options = {"n": 12, "start": TURNED, "lag": 1, "consolidation": Consolidation(1), "rng": np.random.default_rng(0)}
    filter_ = Filter(OdometryMotion(SE2), Scripted(), JointMap(SE2), **options)
    for frame in world.frames(FromAnchor(SE2)):
        born = [replace(new, landmark=landmark) for new in frame.new_landmarks]
        filter_.step(replace(frame, new_landmarks=born), ALONG)
    return filter_


def test_anchored_at_clones_it_is_the_kalman_filter():
    world = turned()
    filter_ = filtered(world, AnchoredPoint(SE2))
    assert_same(filter_, world.kalman)
    assert len(filter_.belief().map.held.clones) == 2  # two landmarks are new in the first step, one in the third


def test_what_is_learnt_alone_is_as_schmidt_has_it():
    """The dense filter of (position, clone, landmark, clone, landmark …), which takes what is measured in two parts.
    First all of it, as uncertain by second coordinates besides as they are; then what that left, by gains that are zero but
    for a second coordinate's own row, and given the step that was sampled."""
    world, turn, at = turned(), SE2.rotation(TURNED), dict[int, int]()
    kalman = Kalman(TURNED[1:], np.zeros((2, 2)))
    for seen, z in world.measured:
        size = len(kalman.mean)
        kalman.augment(np.zeros(2), np.eye(2, size), np.zeros((2, 2)))  # where the robot was
        motion = np.zeros((size + 2, size + 2))
        motion[:2, :2] = turn @ Q @ turn.T
        kalman.predict(np.eye(size + 2), motion, np.append(turn @ STEP, np.zeros(size)))
        old = [k for k, landmark in enumerate(seen) if landmark in at]
        if old:
            H, wide = np.zeros((2 * len(old), size + 2)), np.zeros((len(old), 2))
            for row, k in enumerate(old):
                first = at[seen[k]]
                H[2 * row : 2 * row + 2, :2] = -turn.T
                H[2 * row : 2 * row + 2, first - 2 : first + 2] = np.hstack([turn.T, np.eye(2)])
                wide[row] = WIDE * np.sqrt(kalman.cov[first + 1, first + 1]) * H[2 * row : 2 * row + 2, first + 1]
            kalman.update(z[old].ravel(), H, block_diag(*(NOISE + np.outer(each, each) for each in wide)))
            step = np.hstack([np.eye(2), np.zeros((2, size - 2)), -np.eye(2)])
            given = kalman.cov - kalman.cov @ step.T @ np.linalg.solve(step @ kalman.cov @ step.T, step @ kalman.cov)
            gain, slopes, noises = np.zeros((size + 2, len(old))), np.zeros((len(old), size + 2)), np.zeros(len(old))
            nu = np.zeros(len(old))
            for row, k in enumerate(old):
                squared = wide[row] @ wide[row]
                along = wide[row] / np.sqrt(squared)
                used = along @ NOISE @ along + squared
                noises[row] = (used - squared) * used / squared  # of what is left: 1/r = 1/(r + w²) + 1/r′
                slopes[row] = h = along @ H[2 * row : 2 * row + 2]
                nu[row] = along @ z[k] - h @ kalman.mean
                own = at[seen[k]] + 1
                gain[own, row] = given[own] @ h / (h @ given @ h + noises[row])
                spread = h @ kalman.cov @ h + noises[row]
                both = 2.0 * np.pi * used * noises[row] / (used - squared)  # of N(0; r) / N(0; r + w²) N(0; r′)
                kalman.log_evidence += 0.5 * (np.log(both / (2.0 * np.pi * spread)) - nu[row] ** 2 / spread)
            closed = np.eye(size + 2) - gain @ slopes
            kalman.mean = kalman.mean + gain @ nu
            kalman.cov = closed @ kalman.cov @ closed.T + gain @ np.diag(noises) @ gain.T
        kalman.mean, kalman.cov = kalman.mean[:-2], kalman.cov[:-2, :-2]
        for k, landmark in enumerate(seen):
            if landmark not in at:
                kalman.augment(np.zeros(2), np.eye(2, len(kalman.mean)), np.zeros((2, 2)))
                at[landmark] = len(kalman.mean)
                kalman.augment(z[k], np.zeros((2, len(kalman.mean))), NOISE)
    # In the world a landmark is its clone + turn · (its mean).
    T = np.zeros((8, len(kalman.mean)))
    T[:2, :2] = np.eye(2)
    for landmark, first in at.items():
        T[2 + 2 * landmark : 4 + 2 * landmark, first - 2 : first + 2] = np.hstack([np.eye(2), turn])
    world_told = Kalman(T @ kalman.mean, T @ kalman.cov @ T.T, kalman.log_evidence)
    assert_same(filtered(world, Careful()), world_told)
    assert not np.allclose(world_told.mean, world.kalman.mean, atol=1e-3)


def rays(n: int, spread: float = 0.02, seed: int = 4) -> tuple[JointMap, Particles]:
    """In the middle of a window, everything correlated: three points, four rays at one clone, two at another."""
    rng = np.random.default_rng(seed)
    joint = JointMap(SE3)
    joint.begin(n, Lineage(n))
    points = rng.normal(size=(3, 3)) + [0.0, 0.0, 4.0] + spread * rng.normal(size=(n, 3, 3))
    joint.add_records(Records(points, np.broadcast_to(np.eye(3), (n, 3, 3, 3))), Point(3), ids=np.array([5, 2, 9]))
    for first, count in ((20, 4), (10, 2)):
        anchor = SE3.retract(SE3.exp(0.2 * rng.normal(size=6)), spread * rng.normal(size=(n, 6)))
        mean = 0.3 * rng.normal(size=(count, 3)) + [0.0, 0.0, 0.7] + spread * rng.normal(size=(n, count, 3))
        mean[..., 2] = np.maximum(mean[..., 2], 0.3)
        const = np.broadcast_to(anchor[:, None], (n, count, 7))
        records = Records(mean, np.broadcast_to(np.eye(3), (n, count, 3, 3)), const)
        joint.add_records(records, InverseDepth(), ids=first + np.arange(count))
    d = joint.mean.shape[1]
    joint.mean[:, :6] = spread * rng.normal(size=(n, 6))
    joint.mean[:, joint.mean[0] == 0.0] = spread * rng.normal(size=(n, 1))
    root = spread * rng.normal(size=(d, d)) / np.sqrt(d)
    joint.cov, joint.origin = root @ root.T, SE3.exp(rng.normal(size=6))
    state = SE3.retract(SE3.exp(0.2 * rng.normal(size=6)), spread * rng.normal(size=(n, 6)))
    weights = rng.uniform(0.5, 1.5, n)
    return joint, Particles(state, np.log(weights / weights.sum()))


def numeric(function, mean: np.ndarray, step: float = 1e-6) -> np.ndarray:
    steps = step * np.eye(mean.size)
    return np.array([function(mean + e) - function(mean - e) for e in steps]).T / (2 * step)


@pytest.mark.parametrize("compiled", [True, False])
def test_slopes_of_rows_are_those_of_what_is_measured(compiled):
    """By everything held, and by the state."""
    joint, particles = rays(1)
    joint.compiled = compiled
    ids = np.array([11, 20, 23])
    z, cov = np.zeros((3, 2)), np.repeat(np.eye(2)[None], 3, axis=0)
    groups = [
        Observations(z, cov, CameraRay(CAMERA), ids=ids),
        Observations(z[:2], cov[:2], CameraPoint(CAMERA), ids=np.array([9, 5])),
    ]

    def measured(mean: np.ndarray, state: np.ndarray = particles.state) -> np.ndarray:
        return -joint._rows(state, mean[None], joint.cov, groups).nu[0]

    rows = joint._rows(particles.state, joint.mean, joint.cov, groups)
    by_mean = rows.through(np.eye(joint.mean.shape[1]))
    np.testing.assert_allclose(by_mean, numeric(measured, joint.mean[0]), atol=1e-4)
    by_state = numeric(lambda xi: measured(joint.mean[0], SE3.retract(particles.state, xi)), np.zeros(6))
    np.testing.assert_allclose(rows.said[:, 1:, 0], by_state, atol=1e-4)


def test_the_loops_do_what_numpy_does():
    """More particles than a block of lanes has, of which the last one is not full; points, and rays at two clones.
    States may lie in another order, and be locked."""
    joint, particles = rays(150)
    state = np.asfortranarray(particles.state)
    state.flags.writeable = False
    prior = Prior(SE3, particles.state, np.full((1, 6), 0.01), 0.01 * np.eye(6)[None], centred=False)
    belief = Belief(particles.log_weights, prior, {Part.LANDMARK: joint})
    kinds = (CameraRay(CAMERA), np.array([11, 20, 23])), (CameraPoint(CAMERA), np.array([9, 5]))
    cov = np.repeat(np.eye(2)[None], 3, axis=0)
    groups = [Observations(np.ones((ids.size, 2)), cov[: ids.size], model, ids=ids) for model, ids in kinds]
    found = []
    for compiled in (True, False):
        joint.compiled, joint._reading = compiled, None
        rows = joint._rows(state, joint.mean, joint.cov, groups)
        expected = [joint.project(model, ids, belief) for model, ids in kinds]
        found.append([rows.said, rows.slope, rows.carried, rows.cov, *(each for pair in expected for each in pair)])
    for first, second in zip(*found, strict=True):
        np.testing.assert_allclose(first, second, 1e-9, 1e-9)


def test_what_is_told_of_rays_is_the_gaussian_carried_over():
    joint, particles = rays(1)

    def carried(mean: np.ndarray) -> np.ndarray:
        frame = SE3.retract(joint.origin, mean[:6])
        points, start = [], 15  # ξ, three points, then a clone with its rays, and another
        for clone, count in zip(joint.held.clones, (4, 2), strict=True):
            anchor = SE3.compose(frame, SE3.retract(clone, mean[start : start + 6]))
            b = mean[start + 6 : start + 6 + 3 * count].reshape(-1, 3)
            points.append(SE3.transform(anchor, np.append(b[:, :2], np.ones((count, 1)), axis=1) / b[:, 2:]))
            start += 6 + 3 * count
        return np.concatenate([SE3.transform(frame, mean[6:15].reshape(-1, 3)), *points]).ravel()

    points, covs = joint.moments(particles)
    np.testing.assert_allclose(points.ravel(), carried(joint.mean[0]), atol=1e-11)
    jac = numeric(carried, joint.mean[0])
    cov = jac @ joint.cov @ jac.T
    for k, own in enumerate(covs):
        np.testing.assert_allclose(own, cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rtol=1e-5, atol=1e-7)


def test_consolidation_keeps_the_moments_of_draws():
    """Of the mixture before, draw by draw seen from the robot: pose, points, clones and rays in one Gaussian."""
    joint, particles = rays(60, spread=0.01)
    rng, count = np.random.default_rng(1), 40000
    which = rng.choice(60, count, p=particles.weights)
    drawn = joint.mean[which] + rng.multivariate_normal(np.zeros(len(joint.cov)), joint.cov, count)
    origin, clones, state = joint.origin, joint.held.clones, particles.state[which]
    joint.consolidate(particles)
    expected = drawn.copy()
    world = SE3.compose(SE3.retract(origin, drawn[:, :6]), state)
    expected[:, :6] = SE3.local(joint.origin, world)
    expected[:, 6:15] = SE3.inverse_transform(state[:, None], drawn[:, 6:15].reshape(-1, 3, 3)).reshape(-1, 9)
    for k, first in enumerate((15, 33)):
        at = slice(first, first + 6)
        expected[:, at] = SE3.local(joint.held.clones[k], SE3.between(state, SE3.retract(clones[k], drawn[:, at])))
    sigma = np.sqrt(np.diag(joint.cov))
    offset = (expected.mean(axis=0) - joint.mean[0]) / sigma
    assert np.abs(offset).max() < 0.03
    relative = (np.cov(expected.T) - joint.cov) / np.outer(sigma, sigma)
    # Spread over 60 particles is 1/(1 − ΣW²) larger than that of draws from them.
    assert np.abs(relative).max() < 0.05
    assert (joint.mean == joint.mean[0]).all() and np.abs(joint.mean[:, 15:21]).max() < 1e-3


def test_a_ray_that_becomes_a_point_keeps_what_it_is_correlated_with():
    joint, particles = rays(1)
    before, cov, mean = joint.moments(particles), joint.cov.copy(), joint.mean[0].copy()
    own, row = joint.landmark_of(11).promote(joint.read(np.array([11]))).mean[0, 0], joint.ids.tolist().index(11)
    joint.promote(np.array([11]))
    after, others = joint.moments(particles), joint.ids != 11
    for first, second in zip(before, after, strict=True):
        np.testing.assert_allclose(second[others], first[others], rtol=1e-9)
    # Its mean is that of its own transform: E[1/q] is not 1/q̄.
    np.testing.assert_allclose(
        after[0][row], SE3.transform(joint.world(SE3.identity((1,)), slice(1))[0], own), atol=1e-9
    )
    assert np.linalg.norm(after[0][row] - before[0][row]) > 1e-6
    assert joint.are(joint.ids, Point(3)).tolist() == [True] * 3 + [False] * 4 + [False, True]
    # Rows of the point: those of the clone and the ray, by numeric slopes.
    clone = joint.held.clones[1]

    def point(x: np.ndarray) -> np.ndarray:
        return SE3.transform(SE3.retract(clone, x[:6]), np.append(x[6:8], 1.0) / x[8])

    own = np.r_[33:39, 42:45]
    rows = numeric(point, mean[own]) @ cov[own]
    np.testing.assert_allclose(joint.cov[42:45, :42], rows[:, :42], rtol=1e-5, atol=1e-8)
    joint.remove(np.array([10, 20]))  # the last ray of the second clone: the clone goes, too
    np.testing.assert_array_equal(joint.ids, [5, 2, 9, 21, 22, 23, 11])
    assert len(joint.held.clones) == 1 and joint.mean.shape[1] == 6 + 3 * 7 + 6
    for whole, rest in zip(after, joint.moments(particles), strict=True):
        np.testing.assert_allclose(whole[[0, 1, 2, 4, 5, 6, 8]], rest, rtol=1e-9)


def test_particles_that_are_far_off_leave_a_covariance():
    """Innovations of many standard deviations: what is learnt alone is not told to be better known than that allows."""
    joint, _ = rays(5)
    joint.mean[:, :6] = 0.0
    state, ids = SE3.exp(0.2 * np.random.default_rng(3).normal(size=(5, 6))), np.array([20, 21, 22, 23])
    z, cov = np.full((4, 2), 300.0), np.repeat(np.eye(2)[None], 4, axis=0)
    joint.correct(state, np.zeros((5, 6)), [Observations(z, cov, CameraRay(CAMERA), ids=ids)])
    assert np.linalg.eigvalsh(joint.cov).min() > -1e-15


def test_rays_without_parallax_or_doubt_tell_the_pose_alone():
    """Seen from where they were seen first, and by a depth that is exact: there is nothing to learn along a line."""
    joint, _ = rays(5)
    joint.mean[:, :6] = joint.mean[:, 15:21] = 0.0
    depths, ids, noise = np.array([23, 26, 29, 32]), np.array([20, 21, 22, 23]), np.repeat(np.eye(2)[None], 4, axis=0)
    joint.cov[depths[1]] = joint.cov[:, depths[1]] = 0.0
    inverse, spread = joint.mean[:, depths].copy(), joint.cov[depths, depths].copy()
    state = np.broadcast_to(joint.held.clones[0], (5, 7))
    z = CameraRay(CAMERA).predict(state[0], joint.read(ids).mean[0], joint.held.clones[0])
    total = joint.correct(state, np.zeros((5, 6)), [Observations(z, noise, CameraRay(CAMERA), ids=ids)])
    assert np.isfinite(total.all).all() and np.isfinite(joint.mean).all() and np.isfinite(joint.cov).all()
    np.testing.assert_allclose(joint.mean[:, depths[1]], inverse[:, 1], atol=1e-15)
    assert joint.cov[depths[1], depths[1]] == 0.0 and (joint.cov[depths, depths] <= spread + 1e-15).all()


def test_kinds_that_a_joint_map_does_not_hold():
    class Mute(Landmark):
        dim = 2

        def homogeneous(self, mean, const=None):
            return Point(2).homogeneous(mean)

    joint, _ = rays(2)
    one = Records(np.zeros((2, 1, 3)), np.zeros((2, 1, 3, 3)))
    for landmark in (MixturePoint(2, 3), Point(2), AnchoredPoint(SE2)):
        with pytest.raises(InputError, match="or anchored landmarks"):
            joint.add_records(one, landmark)
    with pytest.raises(InputError, match="override seen_from"):
        JointMap(SE2).register(Mute())
    with pytest.raises(InputError, match="one parametrisation at a time"):
        joint.read(np.array([5, 20]))
    with pytest.raises(InputError, match=r"to Point\(3\)"):
        joint.promote(np.array([5]))
    twice = Observations(np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)), CameraRay(CAMERA), ids=np.array([20, 20]))
    with pytest.raises(InputError, match="unknown depth twice"):
        joint.correct(SE3.identity((2,)), np.zeros((2, 6)), [twice])
