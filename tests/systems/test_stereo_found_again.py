"""A camera whose motion was not seen is found again in its map; a thing that moves does not take it along."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.image_faults import blur_motion, cover_view, salt_and_pepper
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_vo import VoConfig
from rbpf.sensors.features import Sift
from rbpf.sensors.stereo.matching import StereoMatcher
from rbpf.systems.stereo.config import RecoveryConfig, StereoConfig, TriggerConfig
from rbpf.systems.stereo.global_relocalisation import relocalise_globally
from rbpf.systems.stereo.run import StereoRun, run_images
from rbpf.systems.stereo.sensor import StereoFrame, log_support
from tests.systems.plane_sequences import texture
from tests.systems.stereo_sequences import Pairs, pairs

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("keypoints_once")]
CONFIG = StereoConfig(particles=60)
FIRST, BLURRED, COUNT = 10, 5, 20
RIGHT_M = 0.01


def errors_m(run: StereoRun) -> np.ndarray:
    """Of the positions (T,); the first camera is the world."""
    true = SE3.between(run.truth.world_from_camera[0], run.truth.world_from_camera[: run.frames_done])
    return np.linalg.norm(SE3.translation(run.world_from_camera) - SE3.translation(true), axis=1)


def blurred(config: StereoConfig = CONFIG, **options) -> StereoRun:
    """Five pairs of which the odometry makes nothing: the camera is assumed 10 to 20 cm from where it is."""
    return run_images(blur_motion(25, FIRST, BLURRED)(pairs(COUNT)), config, **options)


@pytest.fixture(scope="module")
def found(keypoints_once: None) -> StereoRun:
    return blurred()


@pytest.fixture(scope="module")
def settled(keypoints_once: None) -> StereoRun:
    """Before the last of these pairs, which shows what the map has."""
    return run_images(pairs(12), replace(CONFIG, trigger=TriggerConfig(0.0, 0.0)))


def test_found_again(found):
    """It errs by more than a decimetre and says how much it may err; the first sharp pair mends it."""
    sharp, error = FIRST + BLURRED, errors_m(found)
    assert error[sharp - 1] > 0.1
    assert error[sharp:].max() < RIGHT_M
    assert not found.updated[FIRST:sharp].any() and found.updated[sharp]
    std = np.sqrt(np.trace(found.cov[:, 3:, 3:], axis1=1, axis2=2))
    assert std[sharp - 1] > 0.5 * error[sharp - 1] and std[sharp] < RIGHT_M
    assert (found.assumed[FIRST:sharp] > 0).all() and (found.assumed[sharp:] == 0).all()
    said = [note for note in found.notes if "found again by" in note]
    assert len(said) == 1 and said[0].startswith(f"pair {sharp}: the camera is found again by ")
    assert said[0].endswith("pairs whose motion was only assumed")


def test_without_recovery_it_stays_lost(found):
    """The particles of the assumed motion alone do not come to where they should be."""
    run = blurred(replace(CONFIG, recovery=RecoveryConfig(used=False)))
    assert errors_m(run)[-1] > 5.0 * errors_m(found)[-1]
    assert errors_m(run)[-1] > 0.05


def test_resumed_in_doubt(found, tmp_path):
    """Stopped while it is lost and taken up again: the same bytes."""
    place = tmp_path / "checkpoint.npz"

    def stop(t: int, run: StereoRun) -> None:
        if t == FIRST + 2:
            assert run.assumed[t] > 0
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        blurred(on_frame=stop, checkpoint=place)
    run = blurred(checkpoint=place, resume=True)
    for name in ("world_from_camera", "cov", "assumed", "updated", "observed"):
        np.testing.assert_array_equal(getattr(run, name), getattr(found, name))
    assert run.notes == found.notes


def test_a_map_that_cannot_tell_yet_is_not_waited_for():
    """The second pair is blurred, when the map has nothing that was found again; and a run without a map."""
    run = run_images(blur_motion(25, 1, 1)(pairs(10)), CONFIG)
    assert any("assumed" in note for note in run.notes) and run.updated[2:].any()
    alone = run_images(blur_motion(25, 4, 2)(pairs(10)), replace(CONFIG, map=replace(CONFIG.map, used=False)))
    assert not any("not found again in the map" in note for note in alone.notes)


def test_where_nothing_was_mapped_the_map_goes_on():
    """After the pairs of its patience; until then no particle moves."""
    poses = np.tile(SE3.identity(), (12, 1))
    poses[:, 4] = 0.03 * np.arange(12)
    poses[6:, 4] += 2.2
    poses[6:, 5] -= 0.9
    config = replace(CONFIG, recovery=RecoveryConfig(patience=3))
    run = run_images(pairs(12, poses=poses), config)
    np.testing.assert_array_equal(run.updated[6:9], [0, 0, 1])
    assert any(note.startswith("pair 8: the camera is not found again in the map") for note in run.notes)
    known = run.front_end.sensor.manager
    assert known.names[known.last_observed == known.frame].size > 10
    assert (run.assumed[6:8] > 0).all() and (run.assumed[8:] == 0).all()


def features_of(run: StereoRun, seed: int = 0):
    sequence = pairs(12)
    source = Pairs(texture(seed), sequence.truth.world_from_camera, lambda t, frame: frame)
    frame = next(iter(source.frames(11)))
    return StereoMatcher(run.front_end.rig, Sift(CONFIG.sift), CONFIG.pair).measure(frame.image, frame.right)


def test_anywhere_in_the_map(settled):
    """Whatever was expected, and though half of the places are exchanged."""
    features, rng = features_of(settled), np.random.default_rng(0)
    z, rows = features.z.copy(), rng.permutation(len(features))[: len(features) // 2]
    z[rows] = z[np.roll(rows, 1)]
    rig, belief = settled.front_end.rig, settled.filter.belief()
    wrong = features.measured(
        rig, z, features.cov, features.scale, features.orientation, features.descriptors
    )
    for seen, least in ((features, 20), (wrong, 8)):
        place = relocalise_globally(settled.front_end.sensor, StereoFrame(seen), belief, VoConfig())
        assert place is not None and place[1] >= least
        off = SE3.local(settled.world_from_camera[-1], place[0])
        assert np.linalg.norm(off[:3]) < 0.01 and np.linalg.norm(off[3:]) < RIGHT_M


def test_another_wall_is_nowhere_in_the_map(settled):
    place = relocalise_globally(
        settled.front_end.sensor, StereoFrame(features_of(settled, 1)), settled.filter.belief(), VoConfig()
    )
    assert place is None


def test_far_from_where_it_was_assumed(settled):
    """The odometry was deceived by half a metre: the map says so, and the particles come there."""
    run, law = settled, Odometry(SE3.exp(np.array([0, 0, 0, 0.5, 0, 0])), 0.05**2 * np.eye(6))
    run.front_end._now = features_of(run)
    belief = run.filter.expect(law)
    assert run.front_end.recognised(belief) < CONFIG.map.agreeing
    place = run.front_end.relocalise_globally(belief)
    assert place is not None
    np.testing.assert_allclose(place[0][4:], run.world_from_camera[-1, 4:], atol=RIGHT_M)


def test_how_well_landmarks_are_seen():
    """Beside the formula for one of them; a far one says nothing, and never speaks against."""
    rig = pairs(2).rig
    z = np.array([[10.0, 20.0, 5.0], [100.0, 90.0, 65.0], [50.0, 60.0, 44.0], [300.0, 200.0, 290.0]])
    density = 4.0 / (320.0 * 240.0 * 30.0)
    nu, cov = np.array([[1.0, 0.0, 0.0], [90.0, 0.0, 0.0]]), np.tile(4.0 * np.eye(3), (2, 1, 1))
    log_normal = -0.5 * (0.25 + 3.0 * np.log(2.0 * np.pi * 4.0))
    assert log_support(nu, cov, z, rig) == pytest.approx(log_normal - np.log(density))


@pytest.mark.parametrize(("fraction", "texture_seed"), [(1 / 3, 12), (0.5, 0)])
def test_a_thing_that_moves_does_not_take_it_along(fraction, texture_seed):
    """For some pairs most matches are on the thing. Nothing on it becomes a landmark that weighs."""
    first = 6
    run = run_images(cover_view(fraction, first, 8, seed=texture_seed)(pairs(14)), CONFIG)
    said = [note for note in run.notes if "something in the view moves" in note]
    many = [note for note in said if int(note.split()[2]) < 0.5 * int(note.split()[4])]
    assert len(said) >= 4 and len(many) >= 2
    assert errors_m(run).max() < RIGHT_M


def test_salt_and_pepper():
    """Said at each pair but the first, and without harm."""
    run = run_images(salt_and_pepper(0.02)(pairs(12)), CONFIG)
    assert sum("have impulse noise" in note for note in run.notes) == 11
    assert errors_m(run).max() < RIGHT_M and not run.assumed.any()
