"""COLMAP's pixels and poses in ours; reconstructions of rendered worlds, photos and a kitchen; and those that must fail."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.reading import PathAndMap
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers import open_images
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.colmap import compare
from rbpf.validation.colmap.model import HALF_PX, to_colmap_camera
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from tests.systems import plane_sequences
from tests.validation.camera_scenes import BENT, FISHEYE, PLAIN, WHOLE

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
FEW = compare.ReconstructionOptions(every=1, features=800)


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A desk, seen in frames that are far enough apart to be key frames."""
    folder, world = tmp_path_factory.mktemp("colmap") / "desk", TexturedDesk(frames=10, rate_hz=2.0, texel_m=0.004)
    simulate_images(world, Imaging(known=0, noise_std=1.0), CAMERA, folder, seed=2)
    return open_images(folder), FEW


@pytest.fixture(scope="module")
def found(desk):
    return compare.reconstruct(*desk)


def made(points=None, metric=False, scale=1.0):
    """A reconstruction of a known path, by hand."""
    rng = np.random.default_rng(0)
    poses = SE3.exp(np.cumsum(rng.normal(scale=0.1, size=(8, 6)), axis=0))
    poses[:, 4:] *= scale
    cloud = rng.uniform(-1, 1, (200, 3)) * scale if points is None else points
    count = np.arange(8)
    model = pycolmap.Reconstruction()
    return compare.Reconstruction("by hand", count, count, Trajectory(1_000 * count, poses), cloud, metric, model)


@pytest.mark.slow
def test_a_rendered_desk_is_reconstructed_and_is_right(desk, found):
    sequence, _ = desk
    assert found.fraction >= 0.9
    compared = compare.compare_with_truth(found, sequence.truth)
    assert compared.path.rmse < 0.01 * compared.extent_m
    assert len(found.points) > 100
    assert found.as_dict()["reprojection_error_mean_px"] < 1.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_reconstruction(desk, found):
    again = compare.reconstruct(*desk)
    assert (again.path.world_from_body == found.path.world_from_body).all()
    assert (again.points == found.points).all()


def test_paths_are_compared_after_the_alignment_that_the_scale_asks_for():
    moved, reference = made(scale=3.0), made().path
    similar = compare.compare_with_path(moved, reference)
    assert similar.path.rmse < 1e-12
    assert similar.reference_from_colmap.scale == pytest.approx(1 / 3)
    rigid = compare.compare_with_path(replace(moved, metric=True), reference)
    assert rigid.path.rmse > 0.1
    assert rigid.as_dict()["scale"] == 1.0


def test_the_distance_from_a_surface_does_not_depend_on_how_sparse_the_cloud_is():
    rng, turn = np.random.default_rng(1), SE3.rotation(SE3.exp(np.array([0.3, 0.5, -0.2, 0.0, 0.0, 0.0])))
    wall = np.column_stack([rng.uniform(-1, 1, (300, 2)), np.zeros(300)])
    landmarks = np.column_stack([rng.uniform(-0.8, 0.8, (40, 2)), np.full(40, 0.01)])
    cov = turn @ np.diag([1.0, 1.0, 0.02]) ** 2 @ turn.T
    found = compare.cloud_distance(wall @ turn.T, landmarks @ turn.T, np.repeat(cov[None], 40, axis=0))
    assert found.surface_m == pytest.approx(np.full(40, 0.01), rel=1e-6)
    assert found.sigmas == pytest.approx(np.full(40, 0.5), rel=1e-6)
    assert np.median(found.nearest_m) > 0.02
    assert found.as_dict()["share_within_3_sigmas"] == 1.0


def test_a_straight_path_does_not_let_the_cloud_roll_about_it():
    rng, ours = np.random.default_rng(2), made()
    poses = ours.path.world_from_body.copy()
    poses[:, 4:] = np.linspace(0.0, 0.3, 8)[:, None] * [1.0, 0.5, 0.2]
    reference = Trajectory(ours.path.stamps_ns, poses)
    shaken = poses + np.pad(rng.normal(scale=1e-3, size=(8, 3)), ((0, 0), (4, 0)))
    turn = SE3.exp(np.array([0.5, -1.0, 0.3, 1.0, 2.0, 3.0]))
    world = replace(
        ours,
        path=replace(ours.path, world_from_body=SE3.compose(turn, shaken)),
        points=SE3.transform(turn, ours.points),
    )
    count = len(ours.points)
    points = MapEstimate(np.arange(count), ours.points, np.repeat(np.eye(3)[None], count, axis=0))
    moved = compare.compare_with_path(world, reference, points)
    by_cameras, by_centres = (
        np.linalg.norm(move.transform(world.points) - ours.points, axis=1).max()
        for move in (moved.reference_from_colmap, moved.path.alignment)
    )
    assert by_cameras < 0.03
    assert by_centres > 3.0 * by_cameras, "the centres alone leave the roll open"
    assert moved.reference_from_colmap.scale == pytest.approx(1.0, abs=0.03)


def test_what_cannot_be_compared_is_refused():
    ours = made()
    late = Truth(ours.path.stamps_ns + 10**12, ours.path.world_from_body)
    with pytest.raises(InputError, match="covers 0 of 8 key frames"):
        compare.compare_with_truth(ours, late)
    with pytest.raises(InputError, match="same clock"):
        compare.compare_with_path(ours, replace(ours.path, stamps_ns=late.stamps_ns))
    with pytest.raises(InputError, match="share 2 instants"):
        compare.compare_with_path(ours, ours.path.take(np.arange(2)))
    with pytest.raises(InputError, match="3 or more points"):
        compare.cloud_distance(ours.points[:2], ours.points, np.repeat(np.eye(3)[None], len(ours.points), axis=0))


def test_too_few_key_frames_are_refused():
    sequence = plane_sequences.sequence(5)
    with pytest.raises(InputError, match="has 1 readable key frames of 5 images, expected 3"):
        compare.reconstruct(sequence, compare.ReconstructionOptions(every=10))
    dark = plane_sequences.sequence(4, lambda t, image: None if t % 2 else image)
    with pytest.raises(InputError, match="has 2 readable key frames"):
        compare.reconstruct(dark, FEW)


def test_a_run_without_images_is_refused(tmp_path):
    from rbpf import __version__

    (tmp_path / "config.yaml").write_text(f"rbpf: {__version__}\nsystem: range-bearing\n")
    with pytest.raises(InputError, match="needs a run over images"):
        compare.compare_folder_with_colmap(tmp_path)


@pytest.mark.slow
@pytest.mark.real_data
def test_photos_with_measured_poses_are_met_within_one_per_cent(data_dir):
    sequence = open_images(data_dir / "photos_fountain_p11")
    found = compare.reconstruct(sequence, compare.ReconstructionOptions(every=1, features=1000))
    compared = compare.compare_with_truth(found, sequence.truth)
    assert found.fraction == 1.0
    assert compared.path.max < 0.01 * compared.extent_m
    assert compared.path.rmse < 0.01, "a laser scanner's truth is good to a centimetre"


@pytest.mark.slow
@pytest.mark.real_data
def test_the_kitchen_is_reconstructed_as_well_as_by_the_reference(data_dir):
    sequence = open_images(data_dir / "mono_redkitchen_a")
    truth = sequence.truth
    points = MapEstimate(np.arange(2), np.zeros((2, 3)), np.repeat(np.eye(3)[None], 2, axis=0))
    estimate = PathAndMap(truth.stamps_ns, truth.poses, np.empty((0, 6, 6)), points)
    run, own = compare.compare_with_colmap(estimate, sequence, compare.ReconstructionOptions(every=24, features=1000))
    assert run.reconstruction.fraction >= 0.9
    assert own.path.rmse < 0.05, "the reference reconstruction is 0.038 m from this truth"
    assert run.path.rmse == pytest.approx(own.path.rmse, rel=0.05)


@pytest.mark.parametrize(
    ("camera", "model"), [(PLAIN, "PINHOLE"), (BENT, "OPENCV"), (WHOLE, "FULL_OPENCV"), (FISHEYE, "OPENCV_FISHEYE")]
)
def test_the_simplest_model_that_fits_projects_as_we_do_but_for_half_a_pixel(camera, model):
    points = np.random.default_rng(0).uniform([-0.6, -0.5, 1.0], [0.6, 0.5, 2.0], (50, 3))
    theirs = to_colmap_camera(camera)
    assert theirs.model_name == model
    assert theirs.img_from_cam(points) - HALF_PX == pytest.approx(camera.project(points), abs=1e-9)
