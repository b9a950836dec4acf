"""Simulated measurements of a camera: noise, visibility, tracks, outliers."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from examples.studies.point_worlds import (
    MONO,
    STEREO,
    DeskWorld,
    LabWorld,
    Measuring,
    PointWorld,
    Scene,
    simulate_features,
)
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.simulation.lab import LabDrive
from tests.validation.feature_logs import StillCamera, errors, likely, sightings, truth

CAMERAS = [MONO, STEREO]
FISHEYE = replace(MONO, fx=262.0, fy=262.0, distortion=(-0.03, 0.02, -0.012, 0.002), distortion_model="equidistant")
DESK = DeskWorld(frames=200)
STILL = StillCamera(frames=800)
CHANGING = LabWorld(LabDrive(frames=150, every=4), points=3000)
EXACT = Measuring(dropout=0.0, turnover=0.0)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("world", [DESK, CHANGING])
def test_measurements_are_projections_with_the_stated_noise(
    world: PointWorld, camera: Pinhole | RectifiedStereo
) -> None:
    log = simulate_features(world, Measuring(noise_px=0.7), camera, seed=0)
    score = errors(log) / 0.7
    n = score.size
    assert n > 5000
    assert abs((score**2).sum() - n) < 4.0 * np.sqrt(2.0 * n)
    assert (np.abs(score.sum(axis=0)) < 4.0 * np.sqrt(len(score))).all()
    assert abs((score[:, 0] * score[:, 1]).sum()) < 4.0 * np.sqrt(len(score))
    for frame in log.frames:
        np.testing.assert_allclose(frame.cov_z, np.tile(0.49 * np.eye(camera.dim), (len(frame.z), 1, 1)))


@pytest.mark.parametrize("camera", [*CAMERAS, replace(MONO, distortion=(-0.28, 0.07, 2e-4, 2e-5, 0.0)), FISHEYE])
@pytest.mark.parametrize("world", [DESK, CHANGING])
def test_only_what_is_visible_is_measured(world: PointWorld, camera: Pinhole | RectifiedStereo) -> None:
    measuring = Measuring(nearest_m=0.7, farthest_m=5.0)
    log = simulate_features(world, measuring, camera, seed=1)
    assert len(log.outside()) == 0
    for t in range(len(log.frames)):
        points = truth(log, t)
        assert camera.visible(points, margin_px=8.0).all()
        distance = np.linalg.norm(points, axis=1)
        assert ((distance >= 0.7) & (distance <= 5.0)).all()


def blocked(log: FeatureLog, scene: Scene) -> int:
    """Number of measurements through a block, told from 500 places along each line of sight."""
    assert log.truth is not None
    along = np.linspace(0.0, 0.999, 500)[:, None, None]
    count = 0
    for pose, frame in zip(log.truth.world_from_camera, log.frames, strict=True):
        points = np.array([log.truth.landmarks[name] for name in frame.landmarks.tolist()])
        places = (pose[4:] + along * (points - pose[4:]))[..., None, :]
        within = ((places > scene.blocks[:, 0]) & (places < scene.blocks[:, 1])).all(axis=-1)
        count += int(within.any(axis=(0, 2)).sum())
    return count


@pytest.mark.slow
@pytest.mark.parametrize(
    "world", [DeskWorld(frames=60, blocks=8), LabWorld(LabDrive(frames=6, every=100), points=2000)]
)
def test_blocks_hide_what_is_behind_them(world: PointWorld) -> None:
    scene = world.build(np.random.default_rng(2))
    assert blocked(simulate_features(world, Measuring(), MONO, seed=2), scene) == 0
    assert blocked(simulate_features(world, Measuring(occlusion=False), MONO, seed=2), scene) > 20


@pytest.mark.parametrize("places", [6, 25])
def test_the_budget_is_kept_and_used(places: int) -> None:
    log = simulate_features(DESK, replace(EXACT, measurements=places), MONO, seed=0)
    assert {len(frame.landmarks) for frame in log.frames} == {places}


def test_few_landmarks_enter_the_map_after_the_first_frame() -> None:
    log = simulate_features(CHANGING, Measuring(new_per_frame=1), MONO, seed=0)
    begins = np.bincount([frames[0] for frames in sightings(log).values()])
    assert begins[0] == 25
    assert begins[1:].max() == 1
    assert begins[1:].sum() > 50


def test_new_landmarks_are_spread_over_the_image() -> None:
    log = simulate_features(DESK, Measuring(), MONO, seed=0)
    column, row = (log.frames[0].z // [160.0, 160.0]).T
    assert len(set(zip(column, row, strict=True))) == 12


def test_tracks_go_on_while_the_point_is_visible() -> None:
    world = DeskWorld(frames=200, blocks=0)
    log = simulate_features(world, replace(EXACT, known=0), MONO, seed=0)
    assert log.known is None and log.truth is not None
    ended = 0
    for t, (before, after) in enumerate(pairwise(log.frames), start=1):
        gone = np.setdiff1d(before.landmarks, after.landmarks)
        points = np.array([log.truth.landmarks[name] for name in gone.tolist()]).reshape(-1, 3)
        local = SE3.inverse_transform(log.truth.world_from_camera[t], points)
        assert not MONO.visible(local, margin_px=13.0).any()
        ended += len(gone)
    assert ended > 10


def test_landmarks_that_come_back_go_before_new_ones() -> None:
    measuring = replace(EXACT, known=0)
    log = simulate_features(DeskWorld(frames=600, blocks=0), measuring, MONO, seed=0)
    seen = sightings(log)
    assert log.truth is not None
    again = 0
    for t, frame in enumerate(log.frames[1:], start=1):
        new = [name for name in frame.landmarks.tolist() if seen[name][0] == t]
        old = [name for name, frames in seen.items() if frames[0] < t and name not in frame.landmarks]
        again += sum(name not in log.frames[t - 1].landmarks for name in frame.landmarks) - len(new)
        if new and old:
            points = np.array([log.truth.landmarks[name] for name in old])
            local = SE3.inverse_transform(log.truth.world_from_camera[t], points)
            assert not MONO.visible(local, margin_px=13.0).any()
    assert again > 10


@pytest.mark.parametrize("camera", CAMERAS)
def test_share_and_place_of_outliers(camera: Pinhole | RectifiedStereo) -> None:
    log = simulate_features(STILL, Measuring(outlier_rate=0.1), camera, seed=0)
    first = np.zeros(sum(len(frame.z) for frame in log.frames), dtype=bool)
    first[: len(log.frames[0].z)] = True
    wrong = np.abs(errors(log)).max(axis=1) > 6.0
    assert not wrong[first].any()
    assert likely(wrong[~first].sum(), int((~first).sum()), 0.1)
    z = np.concatenate([frame.z for frame in log.frames])[wrong]
    size = np.array([640.0, 480.0])
    assert (np.abs(z[:, :2].mean(axis=0) / size - 0.5) < 4.0 / np.sqrt(12.0 * len(z))).all()
    assert len(log.outside()) == 0
    if camera is STEREO:
        assert (z[:, 2] <= z[:, 0]).all()


def test_no_outlier_begins_a_landmark() -> None:
    log = simulate_features(CHANGING, Measuring(outlier_rate=0.5), MONO, seed=0)
    seen = sightings(log)
    residual = [f.z - MONO.project(truth(log, t)) for t, f in enumerate(log.frames)]
    begun = [residual[frames[0]][log.frames[frames[0]].landmarks.tolist().index(name)] for name, frames in seen.items()]
    assert len(begun) > 100
    assert np.abs(begun).max() < 6.0


def test_share_of_missed_measurements() -> None:
    log = simulate_features(STILL, replace(EXACT, dropout=0.2), MONO, seed=0)
    counts = [len(frame.landmarks) for frame in log.frames]
    assert counts[0] == 20
    assert likely(sum(counts[1:]), 20 * (STILL.frames - 1), 0.8)


def test_a_lost_track_rests_and_is_taken_up_again() -> None:
    log = simulate_features(STILL, replace(EXACT, turnover=0.05, rest_frames=12), MONO, seed=0)
    assert log.known is not None
    seen = sightings(log)
    assert all(len(seen[name]) == STILL.frames for name in log.known.names.tolist())
    tracked = {name: frames for name, frames in seen.items() if name not in log.known.names}
    gaps = np.concatenate([np.diff(frames) - 1 for frames in tracked.values()])
    assert set(gaps.tolist()) == {0, 12}
    # After a gap a track has gone on for no frame yet, so that it cannot have been lost.
    assert likely(int((gaps > 0).sum()), len(gaps), 0.05)


def test_points_that_are_gone_stay_gone() -> None:
    world = DeskWorld(frames=600, renewal=0.1)
    scene = world.build(np.random.default_rng(5))
    log = simulate_features(world, Measuring(), MONO, seed=5)
    assert log.known is not None and log.truth is not None
    renewed = len(log.truth.landmarks) - world.points
    assert abs(renewed - 600) < 4.0 * np.sqrt(600)
    seen = sightings(log)
    assert max(seen) >= world.points
    for name, frames in seen.items():
        start, end = scene.present[name]
        assert frames[0] >= start
        assert frames[-1] < end or name in log.known.names
    there = [(scene.present[:, 0] <= t) & (t < scene.present[:, 1]) for t in range(world.frames)]
    assert {int(row.sum()) for row in there} == {world.points}


def test_disparity_tells_the_depth() -> None:
    log = simulate_features(DESK, Measuring(), STEREO, seed=0)
    z = np.concatenate([frame.z for frame in log.frames])
    depth = np.concatenate([truth(log, t)[:, 2] for t in range(len(log.frames))])
    disparity = z[:, 0] - z[:, 2]
    assert (disparity > 0.0).all()
    error = disparity - 400.0 * 0.12 / depth
    assert abs(error.mean()) < 4.0 * np.sqrt(2.0 / error.size)
    assert error.std() == pytest.approx(np.sqrt(2.0), rel=0.05)


def test_a_frame_without_measurements() -> None:
    log = simulate_features(DeskWorld(frames=300, points=2), replace(EXACT, known=0), MONO, seed=1)
    assert min(len(frame.landmarks) for frame in log.frames) == 0


@dataclass(frozen=True)
class Line:
    """A camera at rest that sees points on a line."""

    points: int = 10

    def build(self, rng: np.random.Generator) -> Scene:
        points = np.zeros((self.points, 3))
        points[:, 0] = rng.uniform(-1.0, 1.0, self.points)
        points[:, 2] = 3.0
        still = SE3.identity((2,))
        present = np.tile([0, 2], (self.points, 1))
        return Scene("line", np.arange(2), still, points, present, np.zeros((0, 2, 3)))


def test_known_points_are_measured_whenever_they_are_visible() -> None:
    log = simulate_features(DeskWorld(frames=1000, blocks=0), EXACT, MONO, seed=2)
    assert log.known is not None and log.truth is not None
    points = np.array([log.truth.landmarks[name] for name in log.known.names.tolist()])
    local = SE3.inverse_transform(log.truth.world_from_camera[:, None], points)
    visible = MONO.visible(local, margin_px=13.0)
    measured = np.array([np.isin(log.known.names, frame.landmarks) for frame in log.frames])
    assert visible[0].all() and not visible.all()
    np.testing.assert_array_equal(measured, visible)


def test_known_points_are_given_with_the_stated_error() -> None:
    score, flat = [], []
    for seed in range(20):
        log = simulate_features(DeskWorld(frames=2), Measuring(known=5, known_std_m=0.02), MONO, seed)
        assert log.known is not None and log.truth is not None
        points = np.array([log.truth.landmarks[name] for name in log.known.names.tolist()])
        score.append((log.known.positions - points) / 0.02)
        np.testing.assert_allclose(log.known.cov, np.tile(4e-4 * np.eye(3), (5, 1, 1)))
        px = MONO.project(SE3.inverse_transform(log.truth.world_from_camera[0], points))
        flat.append(np.linalg.svd(px - px.mean(axis=0), compute_uv=False)[1])
    n = np.size(score)
    assert abs(np.sum(np.square(score)) - n) < 4.0 * np.sqrt(2.0 * n)
    assert min(flat) > 100.0


def test_exactly_known_points() -> None:
    log = simulate_features(DeskWorld(frames=2), Measuring(known_std_m=0.0), MONO, seed=0)
    assert log.known is not None and log.truth is not None
    points = np.array([log.truth.landmarks[name] for name in log.known.names.tolist()])
    np.testing.assert_array_equal(log.known.positions, points)
    assert not log.known.cov.any()


@pytest.mark.parametrize(
    ("world", "measuring", "message"),
    [
        (DeskWorld(points=3), Measuring(), "first frame of the desk sees [0-3] points .* expected 4: simulate more"),
        (DeskWorld(), Measuring(known=30), "30 known points do not fit into 25 measurements"),
        (Line(), Measuring(known=3), "known points of the line lie on a line in the first frame"),
    ],
)
def test_refused_worlds(world: PointWorld, measuring: Measuring, message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate_features(world, measuring, MONO, seed=0)


def test_two_known_points_cannot_be_on_a_line() -> None:
    log = simulate_features(Line(), Measuring(known=2), MONO, seed=0)
    assert log.known is not None and len(log.known.names) == 2
