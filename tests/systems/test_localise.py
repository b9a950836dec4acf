"""A camera is found in the map of an earlier run, and followed in it; the map stays as it is."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.checkpoint import save_arrays
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.part import Chosen
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.known_map import KnownMap, known_map_arrays, read_known_map
from tests.systems.plane_sequences import CAMERA, known_points, made_up_map, path, sequence

MAPPED, FRAMES = 60, 90


def from_frame(whole: ImageSequence, first: int) -> ImageSequence:
    rows, stamps = np.arange(first, len(whole)), whole.stamps_ns[first:]
    return replace(whole, stamps_ns=stamps, source=Chosen(whole.source, rows, stamps))


@pytest.fixture(scope="module")
def mapped() -> KnownMap:
    run = filter_opened(open_mono(sequence(MAPPED), MonoConfig(particles=20), known_points()))
    return run.system.export_map(run.log.poses)


@pytest.fixture(scope="module")
def localised(mapped):
    return filter_opened(open_mono(from_frame(sequence(FRAMES), MAPPED), MonoConfig(particles=20), known_map=mapped))


def test_the_map_is_that_of_the_run(mapped):
    assert mapped.names.size >= 15 and mapped.alignment == "none" and mapped.views.shape[0] == 16
    # A landmark projects, from where it was seen first, to where it was seen first.
    seen = SE3.inverse_transform(mapped.first_pose, mapped.positions)
    error = np.linalg.norm(CAMERA.project(seen) - mapped.first_px, axis=1)
    assert np.median(error) < 2.0


def test_the_camera_is_found_at_once_and_followed(localised):
    assert not localised.log.lost().any() and localised.messages[0] == "frame 0: the camera is found in the map"
    assert np.flatnonzero(localised.log["relocalised"]).tolist() == []
    truth = path(FRAMES)[MAPPED:]
    error = np.linalg.norm(localised.log.poses[:, 4:] - truth[:, 4:], axis=1)
    assert np.sqrt(np.square(error).mean()) < 0.02
    turned = np.linalg.norm(SE3.local(localised.log.poses, truth)[:, :3], axis=1)
    assert np.sqrt(np.square(turned).mean()) < np.deg2rad(1.0)


def test_the_map_is_not_changed_and_nothing_is_added(localised, mapped):
    belief = localised.system.filter.belief()
    ids = belief.map.ids
    assert ids.size == mapped.names.size
    records = belief.read(ids)
    for particle in range(belief.weights.size):
        np.testing.assert_array_equal(records.mean[particle], mapped.positions)
        np.testing.assert_allclose(records.cov[particle], mapped.cov, rtol=0, atol=1e-15)


def test_uncertain_points_make_an_uncertain_pose(mapped):
    few = from_frame(sequence(MAPPED + 6), MAPPED)
    vague = replace(mapped, cov=mapped.cov + 0.03**2 * np.eye(3))
    stds = []
    for known in (mapped, vague):
        run = filter_opened(open_mono(few, MonoConfig(particles=20), known_map=known))
        assert not run.log.lost()[-1]
        stds.append(np.sqrt(np.trace(run.log.covs[-1, 3:, 3:])))
    assert stds[1] > 1.5 * stds[0]


@pytest.mark.slow
def test_a_camera_that_sees_something_else_is_lost_and_says_how_little_it_knows(mapped):
    blank = from_frame(sequence(MAPPED + 4, lambda _t, image: image // 4 + 100), MAPPED)
    other = replace(mapped, windows=np.random.default_rng(1).integers(0, 256, mapped.windows.shape, dtype=np.uint8))
    run = filter_opened(open_mono(blank, MonoConfig(particles=20), known_map=other))
    assert run.log.lost().all()
    assert np.sqrt(run.log.covs[:, 3:, 3:].diagonal(axis1=1, axis2=2)).min() >= mapped.size_m


def test_a_resumed_run_has_the_same_bytes(localised, mapped, tmp_path):
    whole, config = from_frame(sequence(FRAMES), MAPPED), MonoConfig(particles=20, checkpoint_every=10)
    checkpoint = tmp_path / "checkpoint.npz"

    def stop(run, _):
        if len(run.log) == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        filter_opened(open_mono(whole, config, known_map=mapped), [stop], checkpoint)
    run = filter_opened(open_mono(whole, config, known_map=mapped), checkpoint=checkpoint, resume=True)
    np.testing.assert_array_equal(run.log.poses, localised.log.poses)
    np.testing.assert_array_equal(run.log.covs, localised.log.covs)


FISHEYE = Pinhole(320, 240, 131.0, 131.0, 159.5, 119.5, (-0.03, 0.02, -0.012, 0.002), "equidistant")


@pytest.mark.parametrize(("camera", "count"), [(CAMERA, 9), (FISHEYE, 10)], ids=["pinhole", "fisheye"])
def test_the_file_keeps_every_bit(tmp_path, camera, count):
    """The kind of lens is told of a fisheye alone: files of others are as they were before there was one."""
    written = replace(made_up_map(), camera=camera)
    save_arrays(tmp_path / "known_map.npz", known_map_arrays(written))
    read = read_known_map(tmp_path)
    assert read.camera == written.camera and read.alignment == written.alignment
    for name in ("names", "positions", "cov", "windows", "first_px", "first_pose", "views"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    with np.load(tmp_path / "known_map.npz") as archive:
        np.testing.assert_array_equal(archive["camera"], camera.params[:count])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": np.array(9)}, "no map of this version"),
        ({"positions": np.zeros((12, 2))}, "positions must hold numbers of shape"),
        ({"cov": np.tile(-np.eye(3), (12, 1, 1))}, "none less than zero"),
        ({"alignment": np.array("upside down")}, "is damaged"),
        ({"camera": np.array([-1.0, 1, 1, 1, 0, 0, 0, 0, 0])}, "must be above 0"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path, change, words):
    path = tmp_path / "known_map.npz"
    save_arrays(path, known_map_arrays(made_up_map()))
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **(arrays | change))
    with pytest.raises(InputError, match=words):
        read_known_map(path)


def test_no_map_too_small_a_map_and_another_camera(tmp_path, mapped):
    with pytest.raises(InputError, match="there is no such map"):
        read_known_map(tmp_path)
    save_arrays(tmp_path / "known_map.npz", known_map_arrays(made_up_map(5)))
    with pytest.raises(InputError, match="holds 5 points of known depth"):
        read_known_map(tmp_path)
    (tmp_path / "known_map.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"known_map\.npz"):
        read_known_map(tmp_path)
    wide = replace(mapped, camera=Pinhole(320, 240, 180.0, 180.0, 159.5, 119.5))
    with pytest.raises(InputError, match="the map was made with images of 320x240"):
        filter_opened(open_mono(sequence(3), MonoConfig(particles=5), known_map=wide))
    words = "made through a lens with equidistant distortion, .* has radial-tangential distortion"
    with pytest.raises(InputError, match=words):
        filter_opened(open_mono(sequence(3), MonoConfig(particles=5), known_map=replace(mapped, camera=FISHEYE)))
