"""A camera that is lost says so, finds itself in its map, and does not claim to where it cannot know."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera.resection import Resected
from rbpf.sensors.features import CornerDetector
from rbpf.systems.mono.config import MonoConfig, RelocalisationConfig
from rbpf.systems.mono.image_sensor import ImageSensor, Searched
from rbpf.systems.mono.likeness import known_places, unmistakable
from rbpf.systems.mono.relocalise import Looks, Relocaliser, convincing
from rbpf.systems.mono.system import build_features
from rbpf.systems.mono.video import VideoRun, run_images
from tests.systems.plane_sequences import CAMERA, Pictures, known_points, path, sequence, texture, view

pytestmark = pytest.mark.slow

START, DARK, FRAMES = 40, 20, 90
CONFIG = MonoConfig(particles=50, checkpoint_every=START)


class Tracked(NamedTuple):
    """A run, its checkpoint after the first `START` frames, and which features lived then."""

    run: VideoRun
    checkpoint: Path
    alive: np.ndarray


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """A run of all frames."""
    folder, alive = tmp_path_factory.mktemp("plane"), []

    def keep(t, frame, run):
        if t + 1 == START:
            (folder / "latest.npz").rename(folder / "start.npz")
            alive.append(run.sensor.table.alive.copy())

    run = run_images(sequence(FRAMES), CONFIG, known_points(), keep, folder / "latest.npz")
    return Tracked(run, folder / "start.npz", alive[0])


def resumed(tracked, tmp_path, change, frames=FRAMES):
    """From the checkpoint on, with other images."""
    copy = tmp_path / "start.npz"
    copy.write_bytes(tracked.checkpoint.read_bytes())
    config = replace(CONFIG, checkpoint_every=10 * FRAMES)
    return run_images(sequence(frames, change), config, known_points(), None, copy, resume=True)


def blackout(t, image):
    """Black for a while after the start."""
    return np.zeros_like(image) if START <= t < START + DARK else image


def errors(run):
    """Distances from the true positions (T,)."""
    truth = SE3.translation(path(FRAMES))[: len(run.world_from_camera)]
    return np.linalg.norm(SE3.translation(run.world_from_camera) - truth, axis=1)


def test_tracking_is_not_disturbed(tracked):
    run = tracked.run
    assert not run.lost.any()
    assert not run.relocalisations
    assert not run.problems
    assert errors(run).max() < 0.05


def test_recovers_after_a_blackout(tracked, tmp_path):
    run = resumed(tracked, tmp_path, blackout)
    assert run.lost[START + 3 : START + DARK].all()
    assert not run.lost[START + DARK + 3 :].any()
    assert len(run.relocalisations) == 1
    assert any("lost" in problem for problem in run.problems)
    assert sum("shows nothing" in problem for problem in run.problems) == 1
    assert errors(run)[-10:].max() < 0.03
    assert np.trace(run.cov[START + DARK - 1][3:, 3:]) > np.trace(run.cov[START][3:, 3:])


def test_missing_images_are_a_blackout_too(tracked, tmp_path):
    run = resumed(tracked, tmp_path, lambda t, image: None if START <= t < START + DARK else image)
    assert run.lost[START + DARK - 1]
    assert not run.lost[-20:].any()
    assert errors(run)[-10:].max() < 0.03


def test_the_map_survives_the_dark(tracked, tmp_path):
    held = resumed(tracked, tmp_path, lambda t, image: np.zeros_like(image) if t >= START else image)
    assert np.array_equal(held.sensor.table.alive, tracked.alive)
    assert held.lost[-1]
    assert np.ptp(errors(held)[START:]) < 0.5


def test_an_unknown_place_is_not_recognised(tracked, tmp_path):
    other = Pictures(texture(seed=7), path(FRAMES), lambda t, image: image)
    images = {t: frame.image for t, frame in enumerate(other.frames(0))}
    run = resumed(tracked, tmp_path, lambda t, image: images[t] if t >= START else image)
    assert run.lost[START + 3 :].all()
    assert not run.relocalisations
    last = SE3.translation(run.world_from_camera[START - 1])
    assert np.linalg.norm(SE3.translation(run.world_from_camera[-1]) - last) < 0.1


def test_a_frozen_camera_is_noticed(tracked, tmp_path):
    still = view(texture(), path(FRAMES)[START])
    run = resumed(tracked, tmp_path, lambda t, image: still if START <= t < START + DARK else image)
    assert any("frozen" in problem for problem in run.problems)
    assert run.lost[START + DARK - 1]
    assert not run.lost[-20:].any()


@pytest.fixture
def relocaliser(tracked):
    """Of the tracked run, and its belief."""
    run = tracked.run
    return Relocaliser(run.sensor, CONFIG.relocalisation), run.filter.belief(), run


def test_the_pose_found_is_right_and_its_covariance_fair(relocaliser):
    finder, belief, run = relocaliser
    truth = SE3.retract(path(FRAMES)[60], np.array([0.05, -0.1, 0.2, 0.1, -0.1, 0.15]))
    law = finder.find(belief, view(texture(), truth), run.recovery.trusted[0])
    assert law is not None
    assert finder.attempt is not None and finder.attempt.accepted
    assert CONFIG.relocalisation.min_inliers <= finder.attempt.agreeing <= finder.attempt.landmarks
    start = SE3.compose(belief.state[belief.mode][:7], SE3.inverse(run.world_from_camera[-1]))
    error = SE3.log(SE3.between(SE3.compose(start, truth), law.mean))
    assert np.abs(error).max() < 0.03
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(law.cov)) + 0.01).all()


def test_two_copies_of_the_map_are_not_taken_for_it(relocaliser):
    finder, belief, run = relocaliser
    half = view(texture(), path(FRAMES)[-1])[:, :160]
    assert finder.find(belief, np.hstack([half, half]), run.recovery.trusted[0]) is None


def test_nothing_is_found_in_noise_or_in_grey(relocaliser):
    finder, belief, run = relocaliser
    noise = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    for image in (noise, np.full((240, 320), 90, dtype=np.uint8)):
        assert finder.find(belief, image, run.recovery.trusted[0]) is None
        assert finder.attempt is not None and not finder.attempt.accepted
    assert (finder.attempt.places, finder.attempt.pairs) == (0, 0)


def test_too_few_landmarks_find_nothing(relocaliser):
    _, belief, run = relocaliser
    image, near = view(texture(), path(FRAMES)[-1]), run.recovery.trusted[0]
    assert Relocaliser(run.sensor, RelocalisationConfig()).find(belief, image, near) is not None
    assert Relocaliser(run.sensor, RelocalisationConfig(min_inliers=1000)).find(belief, image, near) is None


def test_inliers_on_a_line_do_not_convince():
    rng, along = np.random.default_rng(0), np.linspace(30.0, 290.0, 20)
    line = np.stack([along, 0.5 * along + rng.normal(size=20)], axis=-1)
    found = Resected(SE3.identity(), np.eye(6), np.ones(20, dtype=bool), 1.0)
    assert not convincing(found, line, CAMERA.width, RelocalisationConfig())
    assert convincing(found, rng.uniform(0, 240, (20, 2)), CAMERA.width, RelocalisationConfig())


def test_likeness_must_be_unmistakable():
    away = np.array([[0.1, 0.5, 0.6], [0.5, 0.2, 0.19], [0.6, 0.5, 0.5]])
    points, px = np.eye(3), np.array([[0.0, 0.0], [50.0, 0.0], [100.0, 0.0]])
    landmark, place = unmistakable(away, points, px, 0.8)
    assert (landmark.tolist(), place.tolist()) == ([0], [0])
    # Two names for one landmark, and two corners at one place, are no rivals.
    landmark, place = unmistakable(away, points, px * [0.01, 1.0], 0.8)
    assert 1 in landmark
    landmark, place = unmistakable(np.array([[0.1, 0.5], [0.1, 0.6]]), np.zeros((2, 3)), px[:2], 0.8)
    assert (landmark.size, place.tolist()) == (1, [0])


def test_the_recovery_is_in_the_checkpoint(tracked, tmp_path):
    run = resumed(tracked, tmp_path, lambda t, image: image)
    again = tracked.run
    assert run.world_from_camera == pytest.approx(again.world_from_camera, abs=1e-9)
    arrays = run.recovery.arrays()
    assert arrays["recovery/pose"] == pytest.approx(again.recovery.trusted[0])
    assert int(arrays["recovery/stamp_ns"]) == again.stamps_ns[-1]


BLINK = 8
"""Frames of darkness in the test of an interruption."""


def blinking(t, image):
    """Frozen first, then dark."""
    if t < 2:
        return image
    return view(texture(), path(FRAMES)[1]) if t < 2 + BLINK else np.zeros_like(image)


@pytest.mark.parametrize("stop", [4, 2 + BLINK - 1, 2 + BLINK + 2], ids=["repeats", "frozen", "dark"])
def test_an_interruption_while_nothing_is_seen_changes_no_byte(tmp_path, stop):
    frames, config = 2 + 2 * BLINK, replace(CONFIG, particles=10, checkpoint_every=1)

    def interrupt(t, frame, run):
        if t + 1 == stop:
            raise KeyboardInterrupt

    def go(name, on_frame=None):
        return run_images(
            sequence(frames, blinking), config, known_points(), on_frame, tmp_path / name, resume=True
        )

    whole = go("whole.npz")
    with pytest.raises(KeyboardInterrupt):
        go("cut.npz", interrupt)
    again = go("cut.npz")
    assert again.problems == whole.problems
    assert sum("frozen" in problem for problem in whole.problems) == 1
    kept, fresh = again.recovery.arrays(), whole.recovery.arrays()
    assert all(kept[name].tobytes() == fresh[name].tobytes() for name in fresh)
    for name in ("world_from_camera", "cov", "lost", "found", "ess", "log_evidence"):
        assert getattr(again, name).tobytes() == getattr(whole, name).tobytes()


def test_patches_say_more_exactly_than_corners_where_landmarks_are(relocaliser):
    finder, belief, run = relocaliser
    truth = SE3.retract(path(FRAMES)[60], np.array([0.05, -0.1, 0.2, 0.1, -0.1, 0.15]))
    image = view(texture(), truth)
    start = SE3.compose(belief.state[belief.mode][:7], SE3.inverse(run.world_from_camera[-1]))
    rows, points = known_places(run.sensor, belief, CONFIG.relocalisation.depth_std_ratio)
    seen = CAMERA.project(SE3.inverse_transform(SE3.compose(start, truth), points))
    px = CornerDetector().detect(image, 500, None, 6.0, 16.0).px
    away = np.linalg.norm(seen[:, None] - px, axis=-1)
    near = np.flatnonzero(away.min(axis=1) < 6.0)
    pairs = near, away[near].argmin(axis=1)
    assert near.size >= 15
    sharp = finder._sharp(Looks(image, rows, points, px), pairs, run.recovery.trusted[0])
    before, after = (np.linalg.norm(places - seen[near], axis=1) for places in (px[pairs[1]], sharp))
    assert np.median(after) < 0.7 * np.median(before)
    assert np.median(after) < 1.5


def lost_sensor(found, reach_px):
    """A lost sensor that looked for features in ellipses of these half axes, and found some of them."""
    sensor = ImageSensor(build_features(CAMERA, CONFIG, None), CONFIG.search)
    k = len(found)
    sensor.table.add(np.zeros((k, 31, 31), np.uint8), np.zeros((k, 2)), SE3.identity())
    cov = (np.array(reach_px) / CONFIG.search.ellipse_sigmas)[:, None, None] ** 2 * np.eye(2)
    hits, px = np.array(found, dtype=bool), np.zeros((k, 2))
    sensor.searched = Searched(np.arange(k), px, cov, px, np.ones(k), hits, np.zeros(k, dtype=bool))
    sensor.bad_frames = CONFIG.search.lost_frames
    return sensor


def test_only_ellipses_searched_whole_confirm_a_place():
    narrow, wide = 20.0, 3.0 * CONFIG.search.max_radius_px
    assert still_lost(lost_sensor([True] * 5 + [False] * 5, [narrow] * 10))  # too few
    assert still_lost(lost_sensor([True] * 8 + [False] * 10, [narrow] * 18))  # too small a fraction
    assert not still_lost(lost_sensor([True] * 8 + [False] * 8, [narrow] * 16))
    assert not still_lost(lost_sensor([True] * 8 + [False] * 20, [narrow] * 16 + [wide] * 12))
    assert still_lost(lost_sensor([True] * 16, [wide] * 16))


def test_a_place_recognised_beyond_doubt_needs_less():
    sensor = lost_sensor([True] * 8 + [False] * 16, [20.0] * 24)
    assert still_lost(sensor)
    sensor.recognised = True
    assert not still_lost(sensor)
    few = lost_sensor([True] * 5 + [False] * 2, [20.0] * 7)
    few.recognised = True
    assert still_lost(few)


def still_lost(sensor):
    """What the sensor says of its last search."""
    return sensor._fails()
