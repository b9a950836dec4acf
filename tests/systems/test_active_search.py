"""Active search: appearances, the gate that matches pass, who is trusted, and what moves by itself."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.image_faults import cover_view
from rbpf.core.models import Part
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.patches.search import cut, warp
from rbpf.sensors.readers import open_images, read_known_points
from rbpf.systems.mono.active_search import CAUCHY_SCALE, ROUNDS, ActiveSearch, RobustMotionGate, SearchResult
from rbpf.systems.mono.config import MonoConfig, SearchConfig
from rbpf.systems.mono.feature_table import PATCH_HALF_PX
from rbpf.systems.mono.image_sensor import ImageSensor, inside_bars
from rbpf.systems.mono.slam import MonoSlam
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from tests.systems.mono_logs import SMALL
from tests.systems.plane_sequences import CAMERA, TILT, known_points, on_plane, sequence, shown_at, texture, view

SEARCH = MonoConfig().search
ALL = np.ones(20, dtype=bool)


# Appearances: of a wall that leans away, the first one is not known again from the side.


def around(degrees: float) -> np.ndarray:
    """A camera that looks at the middle of the wall from one side."""
    middle, turn = on_plane(np.array([500.0, 500.0])), np.deg2rad(degrees)
    axis = SE3.exp(np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0]))
    shift = np.concatenate([[0.0, 0.0, 0.0], middle])
    return SE3.compose(SE3.compose(SE3.exp(shift), axis), SE3.exp(-shift))


@pytest.fixture
def wall() -> tuple[ImageSensor, np.ndarray]:
    """A sensor with features on the wall, cut from straight ahead, and their places (K, 3)."""
    image = view(texture(), around(0.0))
    sensor = MonoSlam(CAMERA).sensor
    px = sensor.detector.detect(image, 40, None, 16.0, PATCH_HALF_PX + 30.0).px
    points = shown_at(px)
    rows = sensor.table.add(np.array([cut(image, p, PATCH_HALF_PX) for p in px]), px, around(0.0))
    sensor.table.position[rows] = np.concatenate([points, np.ones((len(px), 1))], axis=1)
    return sensor, points


def see_again_from(sensor: ImageSensor, points: np.ndarray, pose: np.ndarray) -> None:
    """The features as they are seen from a pose become their last appearance."""
    image = view(texture(), pose)
    px = CAMERA.project(SE3.inverse_transform(pose, points))
    for row, place in enumerate(px):
        patch = cut(image, place, PATCH_HALF_PX)
        if patch is not None:
            sensor.table.last_patch[row], sensor.table.last_pose[row] = patch, pose


def test_the_nearest_appearance_is_chosen(wall):
    sensor, points = wall
    see_again_from(sensor, points, around(30.0))
    rows, table = np.arange(len(points)), sensor.table
    for degrees, later in ((-10.0, False), (10.0, False), (20.0, True), (45.0, True)):
        patches, poses = table.nearest_appearance(rows, table.position, around(degrees))
        assert (patches == (table.last_patch if later else table.first_patch)).all()
        assert (poses == (table.last_pose if later else table.first_pose)).all()


def test_appearances_are_renewed_when_they_have_changed(wall):
    sensor, points = wall
    renewed = []
    for degrees in (5.0, 14.0, 20.0, 28.0):
        pose, before = around(degrees), sensor.table.last_pose.copy()
        px = CAMERA.project(SE3.inverse_transform(pose, points))
        used = FeatureFrame(0, np.arange(len(points)), px, np.tile(np.eye(2), (len(points), 1, 1)))
        sensor._keep_appearances(view(texture(), pose), used, pose)
        now, then = (SE3.translation(p) - points for p in (pose, before))
        lengths = np.linalg.norm(now, axis=1), np.linalg.norm(then, axis=1)
        turn = np.rad2deg(np.arccos((now * then).sum(axis=1) / lengths[0] / lengths[1]))
        scale = np.maximum(lengths[0] / lengths[1], lengths[1] / lengths[0])
        whole = ((px >= PATCH_HALF_PX) & (px <= np.array([319.0, 239.0]) - PATCH_HALF_PX)).all(axis=1)
        changed = (sensor.table.last_pose != before).any(axis=1)
        is_new = (turn >= SEARCH.appearance_turn_deg) | (scale >= SEARCH.appearance_scale_change)
        assert (changed == (whole & is_new)).all()
        renewed.append(int(changed.sum()))
    assert renewed[0] == 0 and min(renewed[1], renewed[3]) > 10
    assert (sensor.table.first_pose == around(0.0)).all()


def test_how_a_patch_lies_in_space_is_learnt_from_how_it_looks(wall):
    """The wall's slope, beside a plane that faces the camera; a template that has it is found where the feature is."""
    sensor, points = wall
    search = ActiveSearch(sensor.features, sensor.table, replace(SEARCH, planes="learnt"))
    table, rows = sensor.table, np.arange(len(points))
    ray, normal = points / points[:, 2:], np.array([0.3, np.tan(TILT), -1.0])
    expected = normal[:2] / (ray @ normal)[:, None] - ray[:, :2] / np.square(ray).sum(axis=1, keepdims=True)

    def found(degrees: float, learn: bool) -> np.ndarray:
        pose = around(degrees)
        image, px = view(texture(), pose), CAMERA.project(SE3.inverse_transform(pose, points))
        templates = warp(table.first_patch, search.first_affines(rows, pose), 11)
        places, _, accepted, _ = search.match(image, templates, px, np.tile(np.eye(2), (len(px), 1, 1)))
        if learn:
            search._learn_planes(image, pose, rows[accepted], places[accepted])
        return np.hypot(*(places - px).T)

    facing = found(20.0, learn=False)
    for degrees in np.arange(2.0, 20.0, 2.0):
        found(degrees, learn=True)
    assert np.median(np.abs(table.slopes(rows) - expected)) < 0.1 * np.median(np.abs(expected))
    assert np.median(found(20.0, learn=False)) < 0.3 * np.median(facing)


# The gate: the motion that most matches agree on.


def matches(seed: int, count: int = 20) -> tuple[np.ndarray, ...]:
    """ν, H, S of matches of a motion ε drawn from its prior N(0, L Lᵀ), L, and ε."""
    rng = np.random.default_rng(seed)
    factor = np.diag([0.05, 0.05, 0.05, 0.1, 0.1, 0.1])
    motion = factor @ rng.standard_normal(6)
    jac = 100.0 * rng.standard_normal((count, 2, 6))
    nu = jac @ motion + rng.standard_normal((count, 2))
    return nu, jac, np.tile(np.eye(2), (count, 1, 1)), factor, motion


fit_motion = RobustMotionGate().fit


@pytest.mark.parametrize("rank", [4, 6])
def test_the_fit_is_numpys(rank):
    """Reweighted least squares of ε = L u, some matches not trusted."""
    nu, jac, cov, factor, _ = matches(5)
    nu[3] += 30.0
    cov, factor, trusted = cov + 0.3, (factor + 0.01)[:, :rank], np.arange(len(nu)) % 3 > 0
    chol = np.linalg.cholesky(cov[trusted])
    white, slope = (np.linalg.solve(chol, each) for each in (nu[trusted, :, None], jac[trusted] @ factor))
    u = np.zeros(rank)
    for _ in range(ROUNDS):
        weight = 1.0 / (1.0 + np.square(white[..., 0] - slope @ u).sum(axis=1) / CAUCHY_SCALE**2)
        weighed = (weight[:, None, None] * slope).reshape(-1, rank)
        info = np.eye(rank) + weighed.T @ slope.reshape(-1, rank)
        u = np.linalg.solve(info, weighed.T @ white.ravel())
    fit = fit_motion(nu, jac, cov, factor, trusted)
    np.testing.assert_allclose(fit.increment, factor @ u, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fit.cov, factor @ np.linalg.solve(info, factor.T), rtol=1e-9, atol=1e-12)
    off, given = nu - jac @ fit.increment, cov + jac @ fit.cov @ np.swapaxes(jac, 1, 2)
    given[trusted] = cov[trusted]
    expected = (off[:, None] @ np.linalg.solve(given, off[..., None])).ravel()
    np.testing.assert_allclose(fit.squared, expected, rtol=1e-8)


def test_without_outliers_it_is_near_the_posterior_of_a_linear_model():
    nu, jac, cov, factor, _ = matches(0)
    fit = fit_motion(nu, jac, cov, factor, ALL)
    rows, stacked = nu.ravel(), jac.reshape(-1, 6)
    info = np.linalg.inv(factor @ factor.T) + stacked.T @ stacked
    np.testing.assert_allclose(fit.increment, np.linalg.solve(info, stacked.T @ rows), atol=0.01)
    # The loss takes a little of every match's weight, so that it is never surer than the linear posterior.
    ratio = np.diag(fit.cov) / np.diag(np.linalg.inv(info))
    assert (ratio > 1.0).all() and (ratio < 2.5).all()
    # Along a direction without noise nothing moves.
    fit = fit_motion(nu, jac, cov, factor[:, :4], ALL)
    assert not fit.increment[4:].any() and not fit.cov[4:].any()


def test_a_majority_that_is_not_trusted_is_judged_by_the_trusted_ones():
    """Twelve that move together, as on a thing that passes, against eight that are known to be at rest."""
    nu, jac, cov, factor, motion = matches(3)
    passing = np.arange(20) < 12
    nu[passing] += jac[passing] @ (factor @ np.array([2.0, -2.0, 2.0, 2.0, -2.0, 2.0]))
    fit = fit_motion(nu, jac, cov, factor, ~passing)
    assert (np.abs(fit.increment - motion) < 5.0 * np.sqrt(np.diag(fit.cov))).all()
    assert np.median(fit.squared[passing]) > 50.0 and (fit.squared[~passing] < 15.0).all()
    alone = fit_motion(nu[~passing], jac[~passing], cov[~passing], factor, ALL[:8])
    np.testing.assert_allclose(fit.increment, alone.increment)


# A thing that moves through the view: what is new on it has to prove itself before it says where the camera is.


@pytest.mark.slow
def test_a_third_of_the_view_moves_and_the_camera_is_not_taken_along(tmp_path):
    """It crosses the view in two seconds; features on it are taken for near ones at rest, if they are trusted at once."""
    camera = Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)
    simulate_images(TexturedDesk(frames=150, texel_m=0.003), Imaging(), camera, tmp_path / "desk", seed=1)
    recording = open_images(tmp_path / "desk")
    # Particles with own maps of a world that is uncertain across the line of sight, too, may lose it whatever is trusted.
    known = replace(read_known_points(tmp_path / "desk" / "known_points.csv"), across_m=None)
    damaged = cover_view(1 / 3, 60, 60)(recording)
    stamps, own = recording.stamps_ns, MonoConfig(map="particles")
    # Runs differ from seed to seed by more than the kinds do: their means over six.
    kinds = {"credulous": replace(own, search=SearchConfig(trusted_fraction=0.0)), "usual": own, "joint": MonoConfig()}
    off: dict[str, list[float]] = {name: [] for name in kinds}
    for name, config in kinds.items():
        for seed in range(6):
            run = filter_opened(open_mono(damaged, replace(config, seed=seed), known))
            off[name].append(ate(Trajectory(stamps, run.log.poses), Trajectory(stamps, run.truth.poses)).rmse)
    assert np.mean(off["usual"]) < 0.02 and np.median(off["usual"]) < 0.015
    assert np.mean(off["credulous"]) > 2.0 * np.mean(off["usual"]) and np.mean(off["joint"]) < 0.025


def test_no_feature_begins_at_a_bar():
    """A letterbox, with noise as compression leaves it: where things end at its bars, corners slide along them."""
    noise = np.random.default_rng(0).integers(0, 8, (240, 320), dtype=np.uint8)
    is_picture = (np.arange(240) >= 30)[:, None] & (np.arange(320) < 280)
    images = sequence(6, lambda t, image: np.where(is_picture, image, noise))
    px = filter_opened(open_mono(images, SMALL)).system.sensor.table.first_px
    least = PATCH_HALF_PX + 1
    assert len(px) > 20 and px[:, 1].min() >= 30 + least and px[:, 0].max() < 280 - least
    assert inside_bars(np.zeros((9, 9), dtype=np.uint8), 2, None).all() and inside_bars(noise * 30, 2, None) is None


def test_what_looks_like_nothing_else_counts_at_first_whatever_its_depth(monkeypatch):
    """A camera that is fast at first, at which no feature is placed, before and after its depths are known."""
    monkeypatch.setattr("rbpf.systems.mono.active_search.WIDEST", 0.0)
    unknown, given = (filter_opened(open_mono(sequence(6), SMALL, *of)).log["found"] for of in ((), (known_points(),)))
    assert unknown[1:].min() > 10 and not given[1:].any()


def test_what_is_often_missed_only_updates_the_map():
    run = filter_opened(open_mono(sequence(8), SMALL, known_points()))
    sensor, belief, used = run.system.sensor, run.system.filter.belief(), run.system.measurement.used
    untrusted = [row for row in used.landmarks.tolist() if sensor.table.member[row] < 0][:3]
    assert len(untrusted) == 3

    def of_state() -> int:
        groups = sensor.observations(used, belief)
        assert all(Part.STATE in group.updates or group.updates == {Part.LANDMARK} for group in groups)
        return sum(group.z.size for group in groups if Part.STATE in group.updates)

    before = of_state()
    sensor.table.attempts[untrusted] += 20
    assert of_state() == before - 2 * len(untrusted)
    # Where few are trusted, all of them are.
    table, rows = sensor.table, np.arange(8)
    assert table.trusted(rows, SEARCH.trusted_fraction).all()
    table.member[rows], table.attempts[rows], table.found[rows] = -1, 10, 2
    assert table.trusted(rows, SEARCH.trusted_fraction).all()
    table.found[rows[:6]] = 10
    np.testing.assert_array_equal(table.trusted(rows, SEARCH.trusted_fraction), rows < 6)
    # What was only begun has no vote on which matches agree, but where the others are too few.
    table.attempts[[6, 7]], table.found[[6, 7]] = 1, 1
    np.testing.assert_array_equal(table.trusted(rows, SEARCH.trusted_fraction), ALL[:8])
    np.testing.assert_array_equal(table.voting(rows, SEARCH.trusted_fraction), rows < 6)
    table.found[5] = 2
    np.testing.assert_array_equal(table.voting(rows, SEARCH.trusted_fraction), rows != 5)


# Tracking and losing: how much has to be found.


@pytest.mark.parametrize(
    ("found", "of", "radius_px", "recognised", "is_lost"),
    [
        (5, 10, "narrow", False, True),  # too few
        (8, 18, "narrow", False, True),  # too small a fraction
        (8, 16, "narrow", False, False),
        (8, 16, "and wide ones", False, False),  # only ellipses that were searched whole confirm a place
        (16, 16, "wide", False, True),
        (8, 24, "narrow", False, True),
        (8, 24, "narrow", True, False),  # a place that was recognised beyond doubt needs less
        (5, 7, "narrow", True, True),
    ],
)
def test_how_much_a_lost_camera_has_to_find(found, of, radius_px, recognised, is_lost):
    sensor = MonoSlam(CAMERA).sensor
    narrow, wide = 20.0, 3.0 * SEARCH.max_radius_px
    radius = np.full(of, wide if radius_px == "wide" else narrow)
    if radius_px == "and wide ones":
        radius = np.append(radius, np.full(12, wide))
    k = radius.size
    sensor.table.add(np.zeros((k, 31, 31), np.uint8), np.zeros((k, 2)), SE3.identity())
    cov = (radius / SEARCH.ellipse_sigmas)[:, None, None] ** 2 * np.eye(2)
    result = SearchResult(np.arange(k), np.zeros((k, 2)), cov, found=np.arange(k) < found)
    sensor.bad_frames = SEARCH.lost_frames
    assert sensor._too_little(result, recognised) == is_lost
