"""The motion between two stereo frames: exact data, SciPy's bundle adjustment, false matches, degenerate geometry."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.motion.least_squares import Rule
from rbpf.motion.stereo_geometry import Matches
from rbpf.motion.stereo_vo import (
    MotionEstimate,
    MotionPrior,
    VoConfig,
    candidate_motions,
    estimate_motion,
    fit,
    product,
    trimming,
)
from rbpf.sensors.camera import RectifiedStereo
from tests.motion import stereo_pairs as worlds

STRICT = Rule(offset=1e-7, iterations=100)
COV = 0.25 * np.eye(3)


def estimated(matches: Matches, seed: int = 0, **options) -> MotionEstimate:
    return estimate_motion(matches, np.random.default_rng(seed), **options)


def adjusted_by_scipy(matches: Matches, start: np.ndarray):
    """Bundle adjustment of both frames in another parametrisation: motion and points in space, no elimination."""
    camera, count = matches.camera, len(matches)
    assert isinstance(camera, RectifiedStereo)
    whites = [np.linalg.inv(np.linalg.cholesky(cov)) for cov in (matches.cov_prev, matches.cov_now)]

    def misses(x):
        points = x[6:].reshape(count, 3)
        now = SE3.inverse_transform(SE3.retract(start, x[:6]), points)
        off = matches.z_prev - camera.project(points), matches.z_now - camera.project(now)
        return np.concatenate([(w @ o[..., None]).ravel() for w, o in zip(whites, off, strict=True)])

    begin = np.concatenate([np.zeros(6), camera.triangulate(matches.z_prev).ravel()])
    return least_squares(misses, begin, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-12)


@pytest.mark.parametrize("points", ["adjusted", "propagated", "exact"])
@pytest.mark.parametrize("world", [worlds.ROAD, worlds.ROOM, worlds.LEAP], ids=["road", "room", "leap"])
def test_without_noise_the_motion_is_exact(world, points):
    before, now, delta = worlds.noiseless(world, 40, np.random.default_rng(0))
    matches, config = Matches.checked(world.camera, before, now, COV, COV), VoConfig(points, rule=STRICT)
    found = estimated(matches, config=config)
    np.testing.assert_allclose(SE3.local(delta, found.previous_camera_from_camera), 0.0, atol=1e-7)
    left = fit(matches, found.previous_camera_from_camera, config).squared
    assert found.found and found.inliers.all() and left < (3 * len(matches) - 6) * 1e-4**2


@pytest.mark.parametrize("world", [worlds.ROAD, worlds.ROOM, worlds.LEAP], ids=["road", "room", "leap"])
def test_the_default_is_scipys_bundle_adjustment(world):
    matches, delta = worlds.correlated(world, 15, np.random.default_rng(1))
    config = VoConfig(gate=1e6, rule=STRICT)
    theirs = adjusted_by_scipy(matches, estimated(matches, config=config).previous_camera_from_camera)
    marginal = np.linalg.inv(theirs.jac.T @ theirs.jac)[:6, :6]
    std = np.sqrt(np.diagonal(marginal))
    np.testing.assert_allclose(theirs.x[:6] / std, 0.0, atol=1e-3)
    # Before the correction for noisy depths the covariance is that of the adjustment.
    found = fit(matches, delta, config)
    np.testing.assert_allclose(found.squared, 2.0 * theirs.cost, rtol=1e-7)
    np.testing.assert_allclose(found.cov / np.outer(std, std), marginal / np.outer(std, std), atol=2e-3)


@pytest.mark.parametrize("points", ["propagated", "exact"])
def test_the_other_kinds_are_scipys_least_squares(points):
    """With S held where the motion was found."""
    matches, delta = worlds.correlated(worlds.LEAP, 20, np.random.default_rng(2))
    ours = fit(matches, delta, VoConfig(points, rule=STRICT))
    camera, best = matches.camera, ours.x
    before = camera.triangulate(matches.z_prev)
    by_z = np.linalg.inv(camera.jacobian(before))
    by_prev = camera.jacobian(SE3.inverse_transform(best, before)) @ SE3.rotation(best).T @ by_z
    noise = by_prev @ matches.cov_prev @ by_prev.mT if points == "propagated" else 0.0
    white = np.linalg.inv(np.linalg.cholesky(matches.cov_now + noise))

    def misses(xi):
        now = camera.project(SE3.inverse_transform(SE3.retract(best, xi), before))
        return (white @ (matches.z_now - now)[..., None]).ravel()

    theirs = least_squares(misses, np.zeros(6), x_scale="jac", xtol=1e-15, ftol=1e-15)
    cov = np.linalg.inv(theirs.jac.T @ theirs.jac)
    np.testing.assert_allclose(theirs.x / np.sqrt(np.diagonal(cov)), 0.0, atol=1e-3)
    np.testing.assert_allclose(ours.cov, cov, rtol=2e-3, atol=2e-3 * np.abs(cov).min())


@pytest.mark.parametrize("world", [worlds.ROAD, worlds.ROOM, worlds.LEAP], ids=["road", "room", "leap"])
@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.6])
def test_false_matches_are_found(world, fraction):
    rng = np.random.default_rng(3)
    pair = worlds.simulate(world, 300, rng)
    matches, wrong = worlds.mistaken(pair, fraction, rng)
    found = estimated(matches)
    off = SE3.local(pair.delta, found.previous_camera_from_camera)
    assert off @ np.linalg.solve(found.cov, off) < 22.5  # χ²₆, 99.9 %
    assert found.inliers[wrong].sum() <= 1
    assert found.inliers[~wrong].mean() > 0.95
    left = fit(matches.take(found.inliers), found.previous_camera_from_camera, VoConfig()).residual
    assert 0.85 < np.sqrt(trimming(VoConfig().gate) * (left @ left) / (len(left) - 6)) < 1.1
    assert found.others == ()


class TestTooLittle:
    def refused(self, matches, complaint, **options):
        start = SE3.exp(np.full(6, 0.1))
        found = estimated(matches, start=start, **options)
        assert not found.found
        assert found.failure == complaint
        np.testing.assert_array_equal(found.previous_camera_from_camera, start)
        assert np.isnan(found.cov).all() and not found.inliers.any()

    @pytest.mark.parametrize("count", [0, 1, 7])
    def test_too_few_matches(self, count):
        matches = worlds.simulate(worlds.ROOM, 20, np.random.default_rng(0)).matches.take(np.arange(count))
        self.refused(matches, f"{count} matches are valid, 8 are needed")

    def test_left_and_right_swapped(self):
        matches = worlds.simulate(worlds.ROOM, 30, np.random.default_rng(0)).matches
        swapped = replace(matches, z_prev=matches.z_prev[:, [2, 1, 0]], z_now=matches.z_now[:, [2, 1, 0]])
        complaint = "30 of 30 matches have a negative disparity: are left and right swapped? 0 are valid"
        self.refused(swapped, f"{complaint}, 8 are needed")

    def test_nothing_agrees(self):
        rng = np.random.default_rng(1)
        pair = worlds.simulate(worlds.ROOM, 60, rng)
        matches, _ = worlds.mistaken(pair, 1.0, rng)
        found = estimated(matches)
        assert not found.found
        assert "of 60 matches agree on a motion, 8 are needed" in found.failure


class TestDegenerate:
    def test_far_points_leave_the_translation_open(self):
        """At infinity: the turn is known, the way is not, and the covariance says both."""
        world = worlds.World(worlds.CAR, 1e5, 1e6, worlds.ROAD.xi)
        pair = worlds.simulate(world, 200, np.random.default_rng(0), 0.1)
        found = estimated(pair.matches)
        assert found.found
        std = np.sqrt(np.diagonal(found.cov))
        off = np.abs(SE3.local(pair.delta, found.previous_camera_from_camera))
        assert std[:3].max() < 1e-3 and (off[:3] < 4.0 * std[:3]).all()
        assert std[3:].min() > 0.3 and (off[3:] < 4.0 * std[3:]).all()

    @pytest.mark.parametrize("place", ["one place", "a line"])
    def test_points_in_one_place_or_on_a_line(self, place):
        rng = np.random.default_rng(1)
        way = 0.0 if place == "one place" else rng.uniform(-1.0, 1.0, (30, 1))
        points = np.array([0.3, 0.1, 3.0]) + way * np.array([0.5, 0.3, 1.0]) * np.ones((30, 1))
        delta = SE3.exp(np.array(worlds.ROOM.xi))
        before, now = worlds.HAND.project(points), worlds.HAND.project(SE3.inverse_transform(delta, points))
        found = estimate_motion(Matches.checked(worlds.HAND, before, now, COV, COV), rng)
        assert found.found and found.inliers.all()
        # A turn about the line, or about any axis through the place, is open.
        axis = np.array([0.5, 0.3, 1.0]) / np.linalg.norm([0.5, 0.3, 1.0])
        turn = SE3.adjoint(SE3.inverse(delta)) @ np.concatenate([axis, np.cross([0.3, 0.1, 3.0], axis)])
        assert turn @ found.cov @ turn > 1e3 * (turn @ turn) ** 2

    def test_disparities_below_zero_are_used(self):
        """Noise on points far away; to drop them would push the rest nearer."""
        pair = worlds.simulate(
            worlds.World(worlds.CAR, 5.0, 2000.0, worlds.ROAD.xi), 300, np.random.default_rng(2), 1.0
        )
        behind = pair.matches.z_prev[:, 0] < pair.matches.z_prev[:, 2]
        found = estimated(pair.matches)
        assert behind.sum() > 5
        assert found.inliers[behind].mean() > 0.9


@pytest.mark.parametrize(
    ("z_prev", "z_now", "cov", "complaint"),
    [
        (np.zeros((5, 2)), np.zeros((5, 2)), COV, r"\(K, 3\) arrays \(u_left, v, u_right\), got \(5, 2\)"),
        (np.zeros((5, 3)), np.full((5, 3), np.nan), COV, "NaN or infinity"),
        (np.zeros((5, 3)), np.zeros((5, 3)), np.ones((3, 3)), "cov_prev is not a covariance of pixels"),
        (np.zeros((5, 3)), np.zeros((5, 3)), np.ones(3), r"cov_prev must be \(3, 3\) or \(5, 3, 3\), got \(3,\)"),
    ],
)
def test_wrong_input_is_refused(z_prev, z_now, cov, complaint):
    with pytest.raises(InputError, match=complaint):
        Matches.checked(worlds.HAND, z_prev, z_now, cov, cov)


def trials(world, points, count, runs, noise_px):
    """Errors (R, 6) in the right chart at the estimate, and covariances (R, 6, 6)."""
    rng, config = np.random.default_rng(11), VoConfig(points)
    errors, covs = [], []
    for _ in range(runs):
        pair = worlds.simulate(world, count, rng, noise_px)
        found = estimated(pair.matches, config=config, start=pair.delta)
        assert found.found
        errors.append(SE3.local(found.previous_camera_from_camera, pair.delta))
        covs.append(found.cov)
    return np.array(errors), np.array(covs)


def mean_nees(errors, covs):
    return float(np.einsum("ri,ri->r", errors, np.linalg.solve(covs, errors[..., None])[..., 0]).mean())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "count", "noise_px"),
    [(worlds.ROAD, 100, 0.5), (worlds.ROOM, 100, 1.0), (worlds.LEAP, 30, 0.5), (worlds.FAR_ROAD, 100, 1.0)],
    ids=["road", "room", "leap", "far"],
)
def test_nees(world, count, noise_px):
    """Within the 95 % band of 400 runs about 6, also with points whose distance is mostly noise."""
    errors, covs = trials(world, "adjusted", count, 400, noise_px)
    assert 5.67 < mean_nees(errors, covs) < 6.35
    planar = [1, 3, 5]
    assert 2.77 < mean_nees(errors[:, planar], covs[:, planar][:, :, planar]) < 3.25


@pytest.mark.slow
def test_nees_of_the_papers_covariance():
    """(JᵀJ)⁻¹ with the earlier points taken as exact: over-confident by a factor of four or so, as a fact."""
    assert 15.0 < mean_nees(*trials(worlds.ROAD, "exact", 100, 100, 0.5)) < 50.0


@pytest.mark.parametrize("seed", range(5))
def test_matches_on_a_thing_that_moves_are_counted(seed):
    rng = np.random.default_rng(seed)
    room, thing = worlds.simulate(worlds.ROOM, 60, rng), worlds.simulate(worlds.LEAP, 20, rng)
    found = estimated(worlds.joined(room.matches, thing.matches))
    assert found.inliers[:60].sum() >= 54 and not found.inliers[60:].any()
    assert 16 <= sum(other.inliers.sum() for other in found.others) <= 20


class TestCandidateMotions:
    """What is handed out where the matches tell less than the prior."""

    DT = 0.1

    def step(self, matches, velocity, **prior):
        expected = MotionPrior(**prior).increment(np.asarray(velocity), self.DT)
        return expected, *candidate_motions(matches, expected, np.random.default_rng(0), VoConfig())

    def test_a_clear_motion_is_the_estimate_itself(self):
        pair = worlds.simulate(worlds.ROOM, 60, np.random.default_rng(0))
        _, (motion,), failure = self.step(pair.matches, np.zeros(6))
        estimate = estimated(pair.matches)
        np.testing.assert_array_equal(motion.odometry.delta, estimate.previous_camera_from_camera)
        np.testing.assert_array_equal(motion.odometry.cov, estimate.cov)
        assert motion.note == failure == ""

    def test_without_a_motion_there_is_the_prior(self):
        none = worlds.simulate(worlds.ROOM, 20, np.random.default_rng(0)).matches.take(np.arange(0))
        prior, motions, failure = self.step(none, np.full(6, 0.3), std_turn=0.5, std_speed=2.0)
        assert motions == () and failure == "0 matches are valid, 8 are needed"
        np.testing.assert_allclose(prior.delta, SE3.exp(np.full(6, 0.03)))
        np.testing.assert_allclose(prior.cov, np.diag(self.DT**2 * np.repeat([0.25, 4.0], 3)))

    def test_joining_is_a_product_of_gaussians(self):
        pair = worlds.simulate(
            worlds.World(worlds.CAR, 300.0, 3000.0, worlds.ROAD.xi), 60, np.random.default_rng(1), 0.5
        )
        velocity = np.concatenate([np.array(worlds.ROAD.xi)[:3], [0.0, 0.0, 0.85]]) / self.DT
        prior, (motion,), _ = self.step(pair.matches, velocity, std_speed=2.0)
        assert motion.note.startswith("the matches leave the motion open (a standard deviation ")
        estimate = estimated(pair.matches, start=prior.delta)
        info = np.linalg.inv(prior.cov) + np.linalg.inv(estimate.cov)
        np.testing.assert_allclose(motion.odometry.cov, np.linalg.inv(info), rtol=1e-6, atol=1e-12)
        off = SE3.local(prior.delta, estimate.previous_camera_from_camera)
        mean = np.linalg.solve(info, np.linalg.solve(estimate.cov, off))
        np.testing.assert_allclose(SE3.local(prior.delta, motion.odometry.delta), mean, atol=1e-9)
        measured = replace(estimate.odometry, by_constants=np.linspace(-1.0, 1.0, 12).reshape(6, 2))
        slope = np.linalg.solve(info, np.linalg.solve(estimate.cov, measured.by_constants))
        np.testing.assert_allclose(product(measured, prior)[0].by_constants, slope, atol=1e-9)
