"""Stereo SLAM on pairs of images of a plane whose poses are known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.image_faults import cover_view
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.descriptors.landmark_management import NewLandmarkConfig
from rbpf.systems.stereo.config import MapConfig, OdometryConfig, StereoConfig, TriggerConfig
from rbpf.systems.stereo.dead_reckoning import Pixels
from rbpf.systems.stereo.front_ends import ImageFrontEnd
from rbpf.systems.stereo.run import StereoRun, run_images
from tests.systems.stereo_sequences import flat, missing, pairs, swapped

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("keypoints_once")]
CONFIG = StereoConfig(particles=60)
COUNT = 12


def error_m(run: StereoRun, poses: np.ndarray) -> float:
    """Root mean square of the positions' errors; the first camera is the world."""
    true = SE3.between(run.truth.world_from_camera[0], run.truth.world_from_camera[: len(poses)])
    off = SE3.translation(poses) - SE3.translation(true)
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def plain(keypoints_once: None) -> StereoRun:
    return run_images(pairs(COUNT), CONFIG)


def test_the_path(plain):
    """The camera goes 17 cm; an error of the pixels of 0.1 px at 1.5 m is 0.6 mm."""
    assert plain.notes == [] and plain.failure is None
    moved = np.linalg.norm(SE3.translation(plain.world_from_camera[-1]))
    assert moved > 0.08
    assert error_m(plain, plain.world_from_camera) < 0.003
    assert error_m(plain, plain.odometry) < 0.004
    assert np.all(plain.cov[-1].diagonal() > 0.0)


def test_landmarks_are_found_again(plain):
    sensor = plain.front_end.sensor
    assert (sensor.manager.confirmed).sum() > 15
    assert plain.observed[3:].mean() > 10
    config = CONFIG.new_landmarks
    assert (~sensor.manager.confirmed).sum() <= config.max_candidates
    ids = plain.filter.belief().map.ids
    names = [plain.filter.belief().catalogue[i] for i in ids.tolist()]
    np.testing.assert_array_equal(sorted(names), sensor.manager.names)
    np.testing.assert_array_equal(sensor.index.store.ids, sensor.manager.names)


def test_the_map_is_where_the_plane_is(plain):
    """Every landmark seen often lies on the plane, within a few of its own standard deviations."""
    belief, sensor = plain.filter.belief(), plain.front_end.sensor
    often = sensor.manager.names[sensor.manager.observations >= 5]
    by_name = {name: i for i, name in belief.catalogue.items()}
    records = belief.read(np.array([by_name[n] for n in often.tolist()]))
    points = SE3.transform(plain.truth.world_from_camera[0], records.mean[belief.mode])
    side = (points[:, 0]) / 0.004
    down = points[:, 1] / (0.004 * np.cos(0.35))
    depth = 1.5 + down * 0.004 * np.sin(0.35) + 0.3 * side * 0.004
    off = points[:, 2] - depth
    assert often.size > 10
    assert np.median(np.abs(off)) < 0.01


def test_updates_are_triggered():
    """A camera at rest is updated once; doubt adds up until the filter is asked again, but not at once."""
    still = np.tile(SE3.identity(), (6, 1))
    trigger = TriggerConfig(moved_m=0.05, turned_rad=0.05)
    run = run_images(pairs(6, poses=still), replace(CONFIG, trigger=trigger))
    np.testing.assert_array_equal(run.updated, [1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(run.world_from_camera, run.odometry)
    every = replace(CONFIG, trigger=TriggerConfig(moved_m=0.05, turned_rad=0.05, frames=2))
    run = run_images(pairs(6, poses=still), every)
    np.testing.assert_array_equal(run.updated, [1, 0, 1, 0, 1, 0])


def test_between_updates_the_odometry_moves_the_estimate():
    trigger = TriggerConfig(moved_m=0.03, turned_rad=1.0)
    run = run_images(pairs(COUNT), replace(CONFIG, trigger=trigger))
    updated = run.updated.astype(bool)
    assert 2 <= updated.sum() < COUNT
    last = 0
    for t in range(COUNT):
        if updated[t]:
            last = t
            continue
        moved = SE3.between(run.odometry[last], run.odometry[t])
        np.testing.assert_allclose(
            run.world_from_camera[t], SE3.compose(run.world_from_camera[last], moved), atol=1e-12
        )
        assert np.trace(run.cov[t][3:, 3:]) > np.trace(run.cov[last][3:, 3:])


def test_three_degrees_of_freedom_keep_the_plane():
    run = run_images(pairs(COUNT), replace(CONFIG, dof=3))
    for poses in (run.world_from_camera, run.odometry, run.filter.particles.state):
        np.testing.assert_allclose(poses[:, 5], 0.0, atol=1e-12)  # y
        np.testing.assert_allclose(SE3.log(poses)[:, [0, 2]], 0.0, atol=1e-9)
    assert np.ptp(run.world_from_camera[:, 4]) > 0.02


@pytest.mark.parametrize("change", [missing, flat], ids=["dropped", "texture-less"])
def test_a_bad_pair_is_survived(change, plain):
    """It keeps a predicted pose, and the next one is matched with the last good one."""
    bad = run_images(pairs(COUNT, lambda t, frame: change(frame) if t == 5 else frame), CONFIG)
    assert bad.failure is None and len(bad.notes) == 1
    assert bad.notes[0].startswith("pair 5 is passed over: ")
    assert "the last velocity is assumed, widely" in bad.notes[0]
    assert not bad.updated[5]
    assert error_m(bad, bad.world_from_camera) < 0.006
    assert np.trace(bad.cov[5]) > 50.0 * np.trace(plain.cov[5])
    assert np.trace(bad.cov[7]) < 10.0 * np.trace(plain.cov[7])


def test_a_thing_that_moves_through_the_view_is_said(plain):
    """It covers up to a third of the view: as long as it and the room are seen there are two motions."""
    run = run_images(cover_view(1 / 3, 3, 8)(pairs(COUNT)), CONFIG)
    said = [note for note in run.notes if "something in the view moves" in note]
    assert len(said) >= 3 and all(int(note.split()[1][:-1]) in range(3, 12) for note in said)
    assert plain.notes == []


def test_a_bad_start():
    """The path begins at the first pair that can be measured; before, the camera is at the origin."""
    run = run_images(pairs(4, lambda t, frame: missing(frame) if t < 2 else frame), CONFIG)
    assert run.notes[0].startswith("pair 0 is passed over: the right image is missing")
    np.testing.assert_array_equal(run.updated[:3], [0, 0, 1])
    np.testing.assert_array_equal(run.world_from_camera[:3], np.tile(SE3.identity(), (3, 1)))


def test_too_few_matches_widen_the_motion():
    """A jump to where nothing is known: the odometry says that it finds no motion, and assumes one."""
    poses = np.tile(SE3.identity(), (4, 1))
    poses[2:, 4] += 2.2
    poses[2:, 5] -= 0.9
    run = run_images(pairs(4, poses=poses), CONFIG)
    assert len(run.notes) == 1
    assert run.notes[0].startswith("pair 2: ") and "is assumed, widely" in run.notes[0]
    assert run.failure is None
    assert np.trace(run.cov[2][3:, 3:]) > 100.0 * np.trace(run.cov[1][3:, 3:])


def test_swapped_images():
    """The first pair is refused at once; later the run ends and keeps what it has."""
    with pytest.raises(InputError, match="seem to be swapped"):
        run_images(pairs(3, lambda t, frame: swapped(frame)), CONFIG)
    run = run_images(pairs(4, lambda t, frame: swapped(frame) if t == 2 else frame), CONFIG)
    assert run.failure is not None and run.failure.startswith("pair 2 of plane: ")
    assert "swapped" in run.failure
    assert run.stamps_ns.size == run.world_from_camera.shape[0] == 2


@pytest.mark.parametrize("split", ["none", "apart", "same"])
def test_halves_of_the_features(split):
    """Apart, no pixel that the odometry has is among the filter's observations; else most are."""
    taken: list[np.ndarray] = []
    shared: list[float] = []

    def look(t: int, run: StereoRun) -> None:
        end = run.front_end
        seen = end._now.z[end.sensor.names >= 0]
        if taken and seen.size:
            shared.append(np.isin(seen[:, 0], taken[-1]).mean())
            assert run.observed[t] <= len(seen)

    config = replace(CONFIG, trigger=TriggerConfig(0.0, 0.0), odometry=OdometryConfig(split=split))
    sequence, whole = pairs(COUNT), ImageFrontEnd.matches

    def noted(self: ImageFrontEnd) -> Pixels:
        found = whole(self)
        taken.append(found.z_now[:, 0])
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ImageFrontEnd, "matches", noted)
        run = run_images(sequence, config, look)
    assert len(shared) > 5 and run.observed[4:].mean() > 3
    assert max(shared) == 0.0 if split == "apart" else np.mean(shared) > 0.5
    assert error_m(run, run.world_from_camera) < 0.006


def test_without_a_map_the_particles_follow_the_odometry():
    config = replace(CONFIG, particles=400, map=MapConfig(used=False))
    run = run_images(pairs(COUNT), config)
    assert run.filter.belief().map.ids.size == 0 and run.observed.sum() == 0
    off = SE3.translation(run.world_from_camera[-1]) - SE3.translation(run.odometry[-1])
    spread = np.sqrt(np.trace(run.cov[-1][3:, 3:]))
    assert 0.0 < np.linalg.norm(off) < 5.0 * spread / np.sqrt(400)


def test_candidates_that_are_not_seen_again_leave():
    """A patience of one frame: what was not seen in the last update is gone."""
    run = run_images(pairs(COUNT), replace(CONFIG, new_landmarks=NewLandmarkConfig(patience=1)))
    manager = run.front_end.sensor.manager
    candidates = ~manager.confirmed
    assert (manager.last_observed[candidates] == manager.frame).all()
    assert manager.next_name > manager.names.size


def test_resumed(tmp_path, plain):
    """Stopped after any checkpoint and taken up again: the same bytes, and the same map."""
    config, place = replace(CONFIG, checkpoint_every=5), tmp_path / "checkpoint.npz"

    class StopError(Exception):
        pass

    def stop(t: int, _run: StereoRun) -> None:
        if t == 7:
            raise StopError

    with pytest.raises(StopError):
        run_images(pairs(COUNT), config, stop, place)
    run = run_images(pairs(COUNT), config, checkpoint=place, resume=True)
    for name in (
        "world_from_camera",
        "odometry",
        "cov",
        "ess",
        "observed",
        "features",
        "agreeing",
        "updated",
    ):
        np.testing.assert_array_equal(getattr(run, name), getattr(plain, name))
    ids = plain.filter.belief().map.ids
    np.testing.assert_array_equal(run.filter.belief().map.ids, ids)
    np.testing.assert_array_equal(
        run.filter.belief().read(ids[:5]).mean, plain.filter.belief().read(ids[:5]).mean
    )
    assert run.filter.belief().catalogue == plain.filter.belief().catalogue
    again = run_images(pairs(COUNT), config, checkpoint=place, resume=True)
    np.testing.assert_array_equal(again.world_from_camera, plain.world_from_camera)


def test_a_checkpoint_of_another_recording(tmp_path):
    config, place = replace(CONFIG, checkpoint_every=2), tmp_path / "checkpoint.npz"
    run_images(pairs(2), config, checkpoint=place)
    with pytest.raises(InputError, match="belongs to a run over another recording"):
        run_images(pairs(4), config, checkpoint=place, resume=True)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (StereoConfig, {"particles": 0}, "particles must be at least 1"),
        (StereoConfig, {"checkpoint_every": 0}, "checkpoint_every must be at least 1"),
        (MapConfig, {"cloud": 0}, "cloud must be at least one particle"),
        (MapConfig, {"gate": 0.0}, "expected gate and depth_fraction above 0"),
        (TriggerConfig, {"moved_m": -1.0}, "must not be negative"),
    ],
)
def test_bad_settings(kind, values, message):
    with pytest.raises(InputError, match=message):
        kind(**values)
