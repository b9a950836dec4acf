"""A camera that is lost says so, finds itself in its map, and does not claim to where it cannot know."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from rbpf.core.models import Records
from rbpf.lie import SE3
from rbpf.maps.point import Point
from rbpf.motion.constant_velocity import PosePrior
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.sensors.camera.resection import GATE, Resected, squared_distances
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.relocalisation import (
    MIN_VIEW_CORNERS,
    Attempt,
    LastView,
    Relocaliser,
    TrackingLoss,
    is_confirmed,
    is_convincing,
    most_agree,
)
from rbpf.systems.mono.slam import MonoSlam
from tests.systems.plane_sequences import CAMERA, Pictures, known_points, path, sequence, texture, view

START, DARK, FRAMES = 40, 20, 90
CONFIG = MonoConfig(particles=50, checkpoint_every=START)
RECOVERY = CONFIG.relocalisation
SENSOR = MonoSlam(CAMERA).sensor
GREY = np.full((240, 320), 90, dtype=np.uint8)

slow = pytest.mark.slow


class Tracked(NamedTuple):
    """A run, and its checkpoint after the first `START` frames."""

    run: Run
    checkpoint: Path


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """A run of all frames."""
    folder = tmp_path_factory.mktemp("plane")

    def keep(run, _):
        if len(run.log) == START:
            (folder / "latest.npz").rename(folder / "start.npz")

    run = filter_opened(open_mono(sequence(FRAMES), CONFIG, known_points()), [keep], folder / "latest.npz")
    return Tracked(run, folder / "start.npz")


def resumed(tracked, tmp_path, change):
    """From the checkpoint on, with other images."""
    copy = tmp_path / "start.npz"
    copy.write_bytes(tracked.checkpoint.read_bytes())
    config = replace(CONFIG, checkpoint_every=10 * FRAMES)
    return filter_opened(open_mono(sequence(FRAMES, change), config, known_points()), checkpoint=copy, resume=True)


def errors(run):
    """Distances from the true positions (T,)."""
    truth = SE3.translation(path(FRAMES))[: len(run.log.poses)]
    return np.linalg.norm(SE3.translation(run.log.poses) - truth, axis=1)


@slow
def test_tracking_is_not_disturbed(tracked):
    run = tracked.run
    assert not run.log.lost().any() and not np.flatnonzero(run.log["relocalised"]).tolist() and not run.messages
    assert errors(run).max() < 0.05


@slow
def test_recovers_after_a_blackout(tracked, tmp_path):
    run = resumed(tracked, tmp_path, lambda t, image: image * np.uint8(not START <= t < START + DARK))
    assert run.log.lost()[START + 3 : START + DARK].all() and not run.log.lost()[START + DARK + 3 :].any()
    assert len(np.flatnonzero(run.log["relocalised"]).tolist()) == 1
    assert any("lost" in problem for problem in run.messages)
    assert sum("shows nothing" in problem for problem in run.messages) == 1 and errors(run)[-10:].max() < 0.03
    assert np.trace(run.log.covs[START + DARK - 1][3:, 3:]) > np.trace(run.log.covs[START][3:, 3:])


@slow
def test_the_map_keeps_its_frame_in_the_dark(tracked, tmp_path):
    run = resumed(tracked, tmp_path, lambda t, image: image * np.uint8(t < START))
    assert np.sqrt(np.diagonal(run.system.filter.belief().map.cov)[:3]).max() < 0.03  # rad, of the frame's rotation


@slow
def test_an_unknown_place_is_not_recognised(tracked, tmp_path):
    other = Pictures(texture(seed=7), path(FRAMES), lambda t, image: image)
    images = {t: frame.image for t, frame in enumerate(other.frames(0))}
    run = resumed(tracked, tmp_path, lambda t, image: images[t] if t >= START else image)
    assert run.log.lost()[START + 3 :].all() and not np.flatnonzero(run.log["relocalised"]).tolist()
    last = SE3.translation(run.log.poses[START - 1])
    assert np.linalg.norm(SE3.translation(run.log.poses[-1]) - last) < 0.1


def test_a_pose_is_found_in_each_particles_own_world():
    """Two worlds that differ by a known motion: the same camera among the same landmarks in both, and as uncertain."""
    n, rng, other = 2, np.random.default_rng(0), SE3.exp(np.array([0.2, -0.3, 0.1, 0.5, -0.2, 0.3]))
    slam = MonoSlam(CAMERA, MonoConfig(particles=n, map="particles"))
    points = np.append(rng.uniform(-0.8, 0.8, (12, 2)), rng.uniform(2.0, 4.0, (12, 1)), axis=1)
    worlds = np.stack([SE3.identity(), other])
    held = Records(SE3.transform(worlds[:, None], points), np.tile(1e-6 * np.eye(3), (n, 12, 1, 1)))
    slam.filter.belief().map.add_records(held, Point(3), ids=np.arange(12))
    table = SimpleNamespace(alive=np.ones(12, dtype=bool), member=np.full(12, -1))
    sensor = SimpleNamespace(camera=CAMERA, config=slam.config.search, features=slam.features, table=table)
    loss = TrackingLoss(sensor, slam.config)
    found, cov = SE3.exp(np.array([0.05, -0.1, 0.02, 0.1, 0.2, -0.1])), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-6
    loss.relocaliser.find = lambda *_: Attempt(prior=PosePrior(found, cov))
    prior, _ = loss.prior(slam.filter, GREY)
    np.testing.assert_allclose(SE3.local(SE3.compose(worlds, found), prior.mean), 0.0, atol=1e-9)
    expected = slam.filter.expect(prior, 0)
    np.testing.assert_allclose(SE3.local(prior.mean, expected.state[:, :7]), 0.0, atol=1e-9)
    factor = expected.prior.factor
    np.testing.assert_allclose(factor @ np.swapaxes(factor, 1, 2) - cov, 0.0, atol=1e-12)


def test_inliers_on_a_line_do_not_convince():
    rng, along = np.random.default_rng(0), np.linspace(30.0, 290.0, 20)
    line = np.stack([along, 0.5 * along + rng.normal(size=20)], axis=-1)
    found = Resected(SE3.identity(), np.eye(6), np.ones(20, dtype=bool), 1.0)
    assert not is_convincing(found, line, CAMERA.width, RECOVERY)
    assert is_convincing(found, rng.uniform(0, 240, (20, 2)), CAMERA.width, RECOVERY)


# The last view before the loss.

HERE = SE3.retract(SE3.identity(), np.array([0.02, 0.01, 0.03, 0.05, 0.02, -0.03]))
MOTIONS = {
    "sideways": [0.0, -0.15, 0.05, 0.4, 0.05, 0.0],
    "turning": [0.1, 0.15, 0.1, 0.0, 0.0, 0.0],
    "nearer": [0.0, 0.0, 0.1, 0.05, 0.0, 0.3],
}


@pytest.fixture(scope="module")
def last():
    return LastView(SENSOR, view(texture(), HERE), HERE, RECOVERY)


def matched(last, image, landmarks=None):
    """What is seen again in an image."""
    px, descriptors = Relocaliser(SENSOR, RECOVERY).corners(image)
    return last.match(descriptors, px, known_points().positions if landmarks is None else landmarks)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_corners_are_found_again_on_their_lines(last, motion):
    there = SE3.retract(HERE, np.array(motion))
    image = view(texture(), there)
    again = matched(last, image)
    assert again is not None
    rows, sights = again
    assert rows.size >= MIN_VIEW_CORNERS
    right = squared_distances(CAMERA, there[None], sights)[0] <= GATE
    assert right.mean() > 0.9
    sharp = last.refine_px(image, rows, sights, there)
    # Across its line: what is left of the depth is along it.
    before, after = (np.median(squared_distances(CAMERA, there[None], s)[0] * s.std_px**2) for s in (sights, sharp))
    assert after < 0.5 * before
    assert (squared_distances(CAMERA, there[None], sharp)[0][right] <= GATE).mean() > 0.8


def test_where_the_last_view_is_not_seen_again(last):
    """In another place, without landmarks in view, which tell the depth, and where it has no corners."""
    assert matched(last, view(texture(seed=7), HERE)) is None and matched(last, GREY) is None
    assert matched(last, view(texture(), HERE), np.array([[0.0, 0.0, -3.0]])) is None
    assert matched(LastView(SENSOR, GREY, HERE, RECOVERY), view(texture(), HERE)) is None


def test_few_landmarks_are_enough_where_most_corners_agree():
    few = RECOVERY.min_inliers_with_last_view
    assert is_confirmed(few, 90, 100, RECOVERY)
    assert not is_confirmed(few - 1, 100, 100, RECOVERY)  # these give the scale
    assert not is_confirmed(30, 60, 100, RECOVERY)  # most show another motion
    assert not is_confirmed(30, MIN_VIEW_CORNERS - 1, MIN_VIEW_CORNERS - 1, RECOVERY)
    assert most_agree(np.arange(100) < 90) and not most_agree(np.arange(100) < 60)
    assert not most_agree(np.ones(MIN_VIEW_CORNERS - 1, dtype=bool))
