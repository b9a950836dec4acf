"""The parts that reproduce the paper's figures, each against a case that can be worked out."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig, SearchConfig
from rbpf.systems.mono.sightings import Sighting
from rbpf.systems.mono.video import run_images
from rbpf.validation.e06.depth_curves import Passing, shape_of
from rbpf.validation.e06.depth_from_images import follow
from rbpf.validation.e06.loop import AWAY, find_closure, started_until
from rbpf.validation.e06.many_landmarks import fill
from rbpf.validation.e06.new_landmarks import line_distances, line_lengths
from rbpf.validation.e06.plane import fit_plane
from rbpf.validation.e06.setting import Row, Setting
from rbpf.validation.e06.worlds import LoopOverDesk, SidewaysDesk, StillTarget
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import cast
from tests.systems.plane_sequences import known_points, sequence

cv2 = pytest.importorskip("cv2")

CAMERA = Pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
NOTHING = np.zeros((0, 2))


def sighting(rows, found, started=0):
    """A frame in which features were looked for."""
    k = len(rows)
    px = np.where(np.array(found, dtype=bool)[:, None], 5.0, np.nan) if k else np.zeros((0, 2))
    line = np.full((k, 2, 2), np.nan)
    return Sighting(
        np.array(rows, dtype=int), np.zeros((k, 2)), np.zeros((k, 2, 2)), px, line, np.zeros((k, 4)),
        np.zeros((started, 2)), np.zeros((1, 2), dtype=int),
    )  # fmt: skip


def test_a_plane_is_fitted_whatever_its_pose():
    rng = np.random.default_rng(0)
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
    inside = rng.uniform(0.0, 1.0, (200, 2)) * [2.0, 1.0]
    flat = np.concatenate([corners, inside])
    height = 0.004 * rng.standard_normal(len(flat))
    height[:4] = 0.0
    points = SE3.transform(SE3.exp([0.4, -0.8, 0.3, 3.0, -1.0, 2.0]), np.column_stack([flat, height]))
    plane = fit_plane(points)
    assert plane.rms_m == pytest.approx(np.std(height), rel=0.02)
    assert plane.worst_m == pytest.approx(np.abs(height).max(), rel=0.1)
    assert plane.area_m2 == pytest.approx(2.0, rel=1e-3)


def test_three_landmarks_make_no_plane():
    with pytest.raises(InputError, match="at least 4 landmarks"):
        fit_plane(np.eye(3))


def test_a_loop_is_closed_when_the_start_is_found_again():
    out = [sighting([50, 51], [True, True])] * (AWAY + 5)
    frames = [sighting([], [], 4), sighting([0, 1, 2], [True, True, False]), sighting([3], [True]), *out]
    back = [sighting([1, 60], [False, True]), sighting([1, 2], [True, False]), sighting([3], [True])]
    closure = find_closure(frames + back, 4)
    assert (closure.first, closure.again) == (4, 2)
    assert (closure.left, closure.back) == (2, 3 + len(out) + 1)
    assert find_closure(frames, 4).back == -1
    assert find_closure([*frames[:3], *out[: AWAY - 3], *back], 4).again == 0
    assert started_until(frames, 15) == 4


def test_distances_from_epipolar_lines():
    one = sighting([1, 2, 3], [True, False, True])
    line = one.line.copy()
    line[:2] = [[0.0, 0.0], [30.0, 40.0]]
    px = np.array([[12.0 + 2.0, 16.0 - 1.5], [np.nan, np.nan], [9.0, 9.0]])
    one = replace(one, line=line, px=px)
    assert line_distances(one) == pytest.approx([2.5])
    assert line_lengths(one) == pytest.approx([50.0])


def test_a_gaussian_curve_is_called_one_and_a_gamma_curve_is_not():
    grid = np.linspace(1e-3, 40.0, 20_000)
    bell = shape_of(grid, -0.5 * ((grid[None] - 20.0) / 2.0) ** 2)
    assert bell.divergence[0] == pytest.approx(0.0, abs=1e-6)
    assert (bell.mean[0], bell.std[0]) == pytest.approx((20.0, 2.0), rel=1e-6)
    k = 4.0
    gamma = shape_of(grid, ((k - 1.0) * np.log(grid) - grid)[None])
    assert gamma.skewness[0] == pytest.approx(2.0 / np.sqrt(k), rel=1e-3)
    assert gamma.divergence[0] > 0.05


def test_the_likelihood_of_depth_has_its_peak_at_the_truth():
    poses = np.tile(SE3.identity(), (5, 1))
    poses[:, 4] = 0.05 * np.arange(1, 6)
    passing, first = Passing(CAMERA, poses, 1.0), np.array([300.0, 250.0])
    z = CAMERA.project(
        SE3.inverse_transform(poses, 1.7 * np.append(CAMERA.unproject(first[None])[0], 1.0)[None])
    )
    rho = np.linspace(0.1, 2.0, 1901)
    curves = passing.log_likelihoods(first, rho, z.reshape(1, -1))
    assert 1.0 / rho[curves[-1, 0].argmax()] == pytest.approx(1.7, rel=2e-3)


def test_the_map_is_filled_with_landmarks_that_are_never_looked_for():
    added, held, searched = [], [], []

    def watch(t, frame, run):
        if t == 5:
            first = run.sensor.table.count
            fill(run, 500, np.random.default_rng(0))
            added.extend(range(first, run.sensor.table.count))
            held.append(run.filter.belief().map.ids.size)
        elif t > 5:
            searched.extend(run.sensor.searched.rows.tolist())

    run = run_images(sequence(10), MonoConfig(particles=5), known_points(), watch)
    assert held == [500]
    assert run.filter.belief().map.ids.size >= 500
    assert len(added) > 400 and len(searched) > 40
    assert not set(added) & set(searched)
    assert not run.lost.any()


def test_the_poster_s_corners_are_where_the_picture_shows_them():
    world = StillTarget(frames=2)
    scene = world.build(np.random.default_rng(0))
    image = Renderer(scene.rectangles, CAMERA).image(scene.world_from_camera[0])
    known = world.known(CAMERA, 0.0, 0.0, np.random.default_rng(1))
    found = cv2.cornerSubPix(
        np.clip(image, 0, 255).astype(np.uint8), known.px.astype(np.float32)[:, None] + 1.0, (5, 5), (-1, -1),
        (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3),
    )  # fmt: skip
    assert np.abs(found[:, 0] - known.px).max() < 0.4
    normal = np.linalg.svd(known.positions - known.positions.mean(axis=0))[1]
    assert normal[2] == pytest.approx(0.0, abs=1e-12)


def test_the_loop_comes_back_and_the_sideways_camera_goes_straight():
    path = LoopOverDesk(frames=200, texel_m=0.02).build(np.random.default_rng(0)).world_from_camera
    places = SE3.translation(path)
    assert np.linalg.norm(places - places[0], axis=1).max() > 1.2
    assert np.linalg.norm(places[150:] - places[0], axis=1).min() < 0.1
    straight = SidewaysDesk(texel_m=0.02).build(np.random.default_rng(0)).world_from_camera
    steps = SE3.between(straight[:-1], straight[1:])
    assert SE3.translation(steps) == pytest.approx(np.tile([0.02, 0.0, 0.004], (10, 1)), abs=1e-12)


def test_a_row_says_where_it_falls_short():
    row = Row("Fig. 0", "what", "1", "2", 2.0, met=False)
    assert [replace(row, met=met).verdict for met in (False, True, None)] == ["FALLS SHORT", "yes", ""]


def test_features_are_followed_to_where_they_truly_are(tmp_path):
    world = SidewaysDesk(frames=4, texel_m=0.002)
    setting = Setting(tmp_path, quick=True)
    sequence, _ = setting.sequence("sideways", world)
    px, track = follow(sequence, 12, SearchConfig())
    scene = world.build(np.random.default_rng(setting.seed))
    uv = setting.camera.unproject(px)
    depth, _ = cast(scene.rectangles, scene.world_from_camera[0], uv)
    points = SE3.transform(
        scene.world_from_camera[0], depth[:, None] * np.column_stack([uv, np.ones(len(uv))])
    )
    seen = setting.camera.project(SE3.inverse_transform(scene.world_from_camera[1:, None], points))
    away = np.linalg.norm(np.moveaxis(seen, 0, 1) - track, axis=-1)
    assert np.isfinite(away).mean() > 0.7
    assert np.nanmedian(away) < 0.5
