"""Features of rendered stereo pairs, beside the true depths."""

from functools import cache

import numpy as np
import pytest

from examples.studies.image_faults import salt_and_pepper
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.descriptors import MatchLimits, match_all
from rbpf.sensors.features import Sift, SiftConfig
from rbpf.sensors.stereo import (
    PairConfig,
    StereoFeatures,
    StereoMatcher,
    aligned,
    calibration_doubt,
    first_views,
    refine,
)
from rbpf.validation.simulation.desk_and_room import TexturedRoom
from rbpf.validation.simulation.images import Imaging, Shutter
from rbpf.validation.simulation.render import Renderer
from tests.systems.stereo_sequences import pairs

RIG = RectifiedStereo(Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5), 0.12)


@cache
def room(frames=3, every=8, seed=1):
    """Pairs of images, depths (H, W) and rectangles (H, W) of the left ones, and poses (T, 7)."""
    rng = np.random.default_rng(seed)
    scene = TexturedRoom(frames=frames * every, texel_m=0.004).build(rng)
    imaging = Imaging(known=0, noise_std=2.0, blur_s=0.0, exposure_drift=0.0, vignetting=0.0)
    renderer = Renderer(scene.rectangles, RIG.camera, imaging.grid)
    shutter = Shutter(scene, imaging, RIG.camera, renderer, rng)
    chosen = range(0, frames * every, every)
    pairs = [tuple(shutter.images(k, RIG.baseline_m)) for k in chosen]
    depths = [renderer.depth(scene.world_from_camera[k]) for k in chosen]
    return pairs, depths, scene.world_from_camera[list(chosen)]


def true_disparity(depth, px):
    """Of places (K, 2), NaN near the edges of things: 1/z is linear in the image on a plane."""
    z, rows = depth
    column, line = np.floor(px).astype(int).T
    column, line = np.clip(column, 4, z.shape[1] - 6), np.clip(line, 4, z.shape[0] - 6)
    across, down = (px - np.column_stack([column, line])).T
    inverse = 1.0 / z
    upper = inverse[line, column] * (1 - across) + inverse[line, column + 1] * across
    lower = inverse[line + 1, column] * (1 - across) + inverse[line + 1, column + 1] * across
    value = RIG.camera.fx * RIG.baseline_m * (upper * (1 - down) + lower * down)
    offsets = [(dx, dy) for dx in (-4, 0, 5) for dy in (-4, 0, 5)]
    same = np.all([rows[line + dy, column + dx] == rows[line, column] for dx, dy in offsets], axis=0)
    return np.where(same, value, np.nan)


FULL = SiftConfig(features=0, working_scale=1.0)


def measured(index=0, sift=FULL, **changes):
    return StereoMatcher(RIG, Sift(sift), PairConfig(**changes)).measure(*room()[0][index])


def disparity_error(features, index=0):
    """(K,) px, NaN near the edges of things."""
    return features.z[:, 0] - features.z[:, 2] - true_disparity(room()[1][index], features.z[:, :2])


def test_disparities_of_a_rendered_pair():
    error = disparity_error(measured())
    error = error[np.isfinite(error)]
    assert len(error) > 100 and np.mean(np.abs(error) > 1.0) < 0.01
    assert abs(np.median(error)) < 0.02 and np.median(np.abs(error)) < 0.06


def test_the_stated_noise_covers_the_error():
    features = measured()
    error = disparity_error(features)
    across = np.array([1.0, 0.0, -1.0])
    normalised = error / np.sqrt(across @ features.cov @ across)
    # Rendered images are cleaner than those for which the noise was set.
    assert 0.15 < 1.4826 * np.nanmedian(np.abs(normalised)) < 1.0


def test_points_and_covariances_follow_from_the_pixels():
    features = measured()
    z, step = features.z, 1e-4
    np.testing.assert_array_equal(features.points, RIG.triangulate(z))
    moved = [RIG.triangulate(z + step * e) - RIG.triangulate(z - step * e) for e in np.eye(3)]
    slope = np.stack(moved, axis=-1) / (2 * step)
    np.testing.assert_allclose(features.cov_points, slope @ features.cov @ slope.mT, rtol=1e-6, atol=1e-9)


def test_a_feature_is_seen_again_where_the_motion_takes_it():
    _, _, poses = room()
    first, second = measured(0, align=True), measured(1, align=True)
    second_from_first = SE3.between(poses[1], poses[0])
    expected = RIG.project(SE3.transform(second_from_first, first.points))
    matches = match_all(first.descriptors, second.descriptors, MatchLimits())
    error = second.z[matches.second] - expected[matches.first]
    assert len(matches) > 80 and np.mean(np.abs(error).max(axis=1) < 1.0) > 0.9
    # Put where its first view is, it is there to a tenth of a pixel, with the noise that is said.
    then, rows = first.take(matches.first), matches.second
    exact = aligned(RIG, PairConfig(), room()[0][1], 0.0, second, rows, then.patch, then.first).take(rows)
    found, off = (exact.first == then.first).all(axis=1), np.abs(exact.z - expected[matches.first])[:, :2]
    assert found.mean() > 0.8 and np.median(off[found]) < min(0.1, 0.7 * np.median(np.abs(error)[found, :2]))
    assert 0.3 < 1.4826 * np.median(off[found] / np.sqrt(exact.cov[found][:, [0, 1], [0, 1]])) < 1.2
    # Where it is not, the keypoint's place and noise are left.
    np.testing.assert_array_equal(exact.z[~found], second.z[rows][~found])
    np.testing.assert_array_equal(exact.cov[~found], PairConfig().noise(exact.scale[~found]))


def test_a_first_view_is_found_in_a_turned_and_larger_image():
    grid, middle = np.stack(np.mgrid[:240, :320][::-1], axis=-1).astype(float), np.array([160.0, 120.0])
    turn, rng = 0.5, np.random.default_rng(2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    places = grid - middle, (grid - middle) @ rotation / 1.3
    then, now = (
        np.rint(128 + 7 * texture(*np.moveaxis(place, -1, 0))).clip(0, 255).astype(np.uint8) for place in places
    )
    px = rng.uniform([60, 60], [260, 180], (30, 2))
    views = first_views(then, np.column_stack([px, px[:, 0] - 10.0]), np.zeros(30))
    true = 1.3 * (px - middle) @ rotation.T + middle
    true = np.column_stack([true, true[:, 0] - 13.0])
    scale, none = np.full(30, 3.0), (np.zeros((30, 31, 31), np.uint8), np.zeros((30, 4)))
    rest = PairConfig().noise(scale), scale, np.full(30, turn), np.zeros((30, 36), np.float32)
    features = StereoFeatures.measured(RIG, true + rng.normal(0.0, 0.5, 2)[[0, 1, 0]], *rest, *none)
    found = aligned(RIG, PairConfig(), (now, np.roll(now, -13, axis=1)), 0.0, features, np.arange(30), *views)
    moved = (found.first == views[1]).all(axis=1)
    assert moved.mean() > 0.8 and np.abs(found.z - true)[moved].max() < 0.1


def test_limits_of_the_disparity():
    features = measured(least_disparity_px=12.0, nearest_m=2.0)
    disparity = features.z[:, 0] - features.z[:, 2]
    assert len(features) > 20 and disparity.min() >= 12.0 and disparity.max() <= 260.0 * 0.12 / 2.0 + 2.0


@pytest.mark.parametrize(("beyond", "doubted"), [(0.0, False), (0.1, True)])
def test_cameras_that_cannot_have_taken_the_pair_are_noticed(beyond, doubted):
    """The right image is shifted, as by a camera that is turned, until a tenth of the points lies beyond infinity."""
    left, right = room()[0][0]
    features = measured()
    disparity = features.z[:, 0] - features.z[:, 2]
    shift = int(np.quantile(disparity, beyond)) + 2 if beyond else 0
    matcher = StereoMatcher(RIG, Sift(FULL))
    assert matcher.impossible == (0, 0)
    matcher.measure(left, np.roll(right, shift, axis=1))
    assert bool(calibration_doubt(*matcher.impossible)) is doubted


def test_a_pair_on_other_rows_is_noticed():
    (left, right), matcher = room()[0][0], StereoMatcher(RIG, Sift(FULL))
    for rows in (4, -2, 0):
        matcher.measure(left, np.roll(right, rows, axis=0))
        assert matcher.rows_px == pytest.approx(rows, abs=0.2) and ("not rectified" in matcher.remark) == bool(rows)


def test_a_pair_without_texture():
    flat = np.full((240, 320), 120, dtype=np.uint8)
    features = StereoMatcher(RIG, Sift(FULL)).measure(flat, flat)
    assert features.z.shape == (0, 3) and features.cov_points.shape == (0, 3, 3)
    assert len(match_all(features.descriptors, measured().descriptors, MatchLimits())) == 0
    assert len(match_all(measured().descriptors, features.descriptors, MatchLimits())) == 0


def test_sizes_that_differ():
    left, right = room()[0][0]
    with pytest.raises(InputError, match="of one size, got 320x240 px and 300x240 px"):
        StereoMatcher(RIG, Sift(FULL)).measure(left, right[:, :300])
    with pytest.raises(InputError, match="the camera takes 320x240 px, the images have 300x240 px"):
        StereoMatcher(RIG, Sift(FULL)).measure(left[:, :300], right[:, :300])


def texture(columns, lines):
    """A smooth pattern that is known everywhere."""
    rng = np.random.default_rng(5)
    total = np.zeros(np.broadcast_shapes(columns.shape, lines.shape))
    for _ in range(25):
        angle, period, phase = rng.uniform(0, np.pi), rng.uniform(5, 14), rng.uniform(0, 2 * np.pi)
        along = np.cos(angle) * columns + np.sin(angle) * lines
        total += np.cos(2 * np.pi * along / period + phase)
    return total


def pair(disparity, gain=1.0, offset=0.0):
    line, column = np.mgrid[:80, :120].astype(float)
    right = 128 + gain * 9 * texture(column + disparity, line) + offset
    images = 128 + 9 * texture(column, line), right
    return tuple(np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in images)


PX = np.random.default_rng(3).uniform([50, 15], [100, 65], (60, 2))


def test_a_known_disparity_is_found_in_any_light():
    for disparity, gain, offset in ((10.0, 1.0, 0.0), (10.25, 1.0, 0.0), (10.5, 0.6, 25.0), (13.8, 1.0, 0.0)):
        u, correlation = refine(*pair(disparity, gain, offset), PX, PX[:, 0] - disparity + 0.6)
        np.testing.assert_allclose(u, PX[:, 0] - disparity, atol=0.05)
        assert np.abs(np.mean(u - PX[:, 0] + disparity)) < 0.005
        assert (correlation > 0.98).all()


def test_the_window_has_to_be_in_both_images():
    left, right = pair(9.4)
    px = np.array([[4.0, 40.0], [12.0, 40.0], [60.0, 4.0], [60.0, 40.0], [60.0, 76.0]])
    u, correlation = refine(left, right, px, px[:, 0] - 9.0)
    np.testing.assert_array_equal(np.isfinite(u), [False, False, False, True, False])
    np.testing.assert_array_equal(correlation > 0.0, np.isfinite(u))


@pytest.fixture(scope="module")
def whole():
    return list(pairs(2).frames())


@pytest.fixture(scope="module")
def noisy():
    return list(salt_and_pepper(0.02)(pairs(2)).frames())


def test_features_are_found_as_without(whole, noisy):
    """Nearly all of them; of the noisy images as they are half are left."""
    mending = StereoMatcher(pairs(2).rig)
    plain = StereoMatcher(pairs(2).rig, config=PairConfig(filter_impulses=False))
    clean = mending.measure(whole[1].image, whole[1].right)
    assert mending.remark == ""
    filtered = mending.measure(noisy[1].image, noisy[1].right)
    assert "% of the pixels have impulse noise" in mending.remark
    left = plain.measure(noisy[1].image, noisy[1].right)

    def again(features) -> float:
        gaps = np.linalg.norm(clean.z[:, None] - features.z[None], axis=-1)
        return float((gaps.min(axis=1) < 1.0).mean())

    assert again(filtered) > 0.7
    assert again(left) < 0.6 * again(filtered)
