"""Runs as other programs read them: COLMAP models and PLY files, read back by COLMAP and by hand; `rbpf export`."""

import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from rbpf.cli import main
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.folder import write_run
from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import filter_opened, open_robot_log
from rbpf.runs.results import load
from rbpf.runs.trajectory import read_tum
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import ImageSequence, Part
from rbpf.sensors.readers.images.decoding import FileImages
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.colmap.model import LEFT, RIGHT, build_model, from_colmap_pose, image_id, image_name, lay_out
from rbpf.validation.exports import MAP, PATH, export_colmap, export_ply, write_ply
from rbpf.validation.gtsam.observations import observation_table, reprojection
from rbpf.validation.report.live import recording
from rbpf.validation.simulation.robot import RobotWorld, simulated_log
from tests.validation.camera_scenes import BENT, FISHEYE, STEREO, scene

SMALL = Pinhole(64, 48, 50.0, 50.0, 31.5, 23.5)


def estimate_of(log, names=None):
    """The truth as an estimate; landmarks in another order than their names'."""
    names = list(log.truth.landmarks) if names is None else names
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    std = np.linspace(0.01, 0.2, len(names))
    points = np.array([log.truth.landmarks[name] for name in names])
    summary = MapEstimate(np.array(names), points, std[:, None, None] ** 2 * np.eye(3))
    return PathAndMap(stamps, log.truth.poses, np.empty((0, 6, 6)), summary)


def read_ply(path):
    """Elements by name as structured arrays, of a binary PLY file."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n")
    codes, found, start = {"float": "<f4", "uchar": "u1", "int": "<i4"}, {}, 0
    for element in head.decode().split("element ")[1:]:
        (name, count), *fields = (line.removeprefix("property ").split() for line in element.splitlines())
        found[name] = np.frombuffer(body, [(field, codes[kind]) for kind, field in fields], int(count), start)
        start += found[name].nbytes
    return found


def reprojection_errors(model):
    """Distances (px) by image and landmark, from COLMAP's own projection."""
    found = {}
    for image in model.images.values():
        for point2 in image.points2D:
            if point2.has_point3D():
                projected = image.project_point(model.point3D(point2.point3D_id).xyz)
                found[image.name, point2.point3D_id] = np.linalg.norm(projected - point2.xy)
    return found


@pytest.mark.parametrize(("camera", "kind"), [(BENT, "binary"), (BENT, "text"), (FISHEYE, "binary")])
def test_a_model_read_back_by_colmap_has_our_poses_points_tracks_and_residuals(tmp_path, camera, kind):
    log = scene(camera=camera, frames=5, points=12, known=3)
    estimate = estimate_of(log)
    export_colmap(estimate, log, tmp_path / "model", kind)
    model = pycolmap.Reconstruction(tmp_path / "model")
    assert model.num_images() == 5 and model.num_points3D() == 12
    for t, pose in enumerate(log.truth.poses):
        image = model.find_image_with_name(image_name(t))
        assert SE3.local(pose, from_colmap_pose(image.cam_from_world())) == pytest.approx(np.zeros(6), abs=1e-12)
    table = observation_table(log)
    points = np.array([log.truth.landmarks[name] for name in table.names.tolist()])
    ours = np.linalg.norm(reprojection(table, log.truth.poses, points)[0], axis=1)
    theirs = reprojection_errors(model)
    assert len(theirs) == len(ours)
    ids = estimate.landmarks.ids.tolist()
    for row, (step, index) in enumerate(zip(table.steps.tolist(), table.index.tolist(), strict=True)):
        key = image_name(step), ids.index(int(table.names[index])) + 1
        assert theirs[key] == pytest.approx(ours[row], abs=1e-9)


def test_a_stereo_pair_is_a_rig_whose_right_camera_sees_what_was_measured():
    log = scene(camera=STEREO, frames=3, points=8, noise_px=1e-7)
    table = observation_table(log)
    points = np.array([log.truth.landmarks[name] for name in table.names.tolist()])
    model = build_model(table, log.truth.poses, points)
    assert model.num_rigs() == 1 and model.num_frames() == 3 and model.num_images() == 6
    assert max(reprojection_errors(model).values()) < 1e-5
    left, right = (model.image(image_id(1, side, True)) for side in (LEFT, RIGHT))
    gap = from_colmap_pose(right.cam_from_world())[4:] - from_colmap_pose(left.cam_from_world())[4:]
    assert np.linalg.norm(gap) == pytest.approx(STEREO.baseline_m)


def test_maps_and_paths_are_whole_ply_files(tmp_path):
    estimate = estimate_of(scene(frames=4, points=10))
    export_ply(estimate, tmp_path)
    vertices = read_ply(tmp_path / MAP)["vertex"]
    places = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    assert places == pytest.approx(estimate.landmarks.mean, abs=1e-6)
    assert vertices["sigma_m"] == pytest.approx(np.linspace(0.01, 0.2, 10), rel=1e-6)
    path = read_ply(tmp_path / PATH)
    assert len(path["vertex"]) == 4
    assert [tuple(edge) for edge in path["edge"].tolist()] == [(0, 1), (1, 2), (2, 3)]
    reread = pycolmap.Reconstruction()
    reread.import_PLY(tmp_path / MAP)
    assert reread.num_points3D() == 10


def test_bad_input_is_refused(tmp_path):
    log = scene(frames=4, points=8)
    shorter = replace(log, frames=log.frames[:3])
    with pytest.raises(InputError, match="4 poses and 3 frames"):
        export_colmap(estimate_of(log), shorter, tmp_path / "model")
    with pytest.raises(InputError, match="row 1"):
        write_ply(tmp_path / "a.ply", np.array([[0, 0, 0], [0, np.nan, 0.0]]), np.zeros((2, 3), dtype=np.uint8))
    assert not list(tmp_path.iterdir())


def test_a_multi_view_stereo_tool_finds_the_images_of_a_run(tmp_path):
    # A folder of six images, the third of which cannot be read; then every second one, and these made smaller.
    files = [tmp_path / f"photo {t}.png" for t in range(6)]
    rng = np.random.default_rng(0)
    for file in files:
        Image.fromarray(rng.integers(0, 255, (SMALL.height, SMALL.width, 3), dtype=np.uint8)).save(file)
    log = scene(camera=SMALL, frames=6, points=12)
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    source = FileImages(stamps, (SMALL.height, SMALL.width), files)
    whole = ImageSequence("six", SMALL, stamps, None, None, source)
    files[2].unlink()
    for part, expected in ((Part(), "photo 5.png"), (Part(resize_px=32), "000005.png")):
        out = tmp_path / f"run with {expected}"
        names = lay_out(part.apply(whole), out / "images", 6)
        assert names[5, LEFT] == expected and len(names) == 5
        assert (out / "images" / expected).is_symlink() == (part.resize_px is None)
        model = export_colmap(estimate_of(log), log, out / "sparse", names=names)
        assert model.compute_mean_reprojection_error() > 0.0 and model.num_images() == 5
        pycolmap.undistort_images(out / "dense", out / "sparse", out / "images")
        assert {path.name for path in (out / "dense" / "images").iterdir()} == set(names.values())
    assert lay_out(Part(every=2).apply(whole), tmp_path / "half", 6) == {
        (0, LEFT): "photo 0.png",
        (2, LEFT): "photo 4.png",
    }


@pytest.mark.slow
def test_names_that_are_no_text_reach_rerun_in_part(tmp_path):
    """Of a recording's name what cannot be read is replaced; of a file's it is refused, before anything is written."""
    with recording(tmp_path / "run.rrd", "log\udcff") as (_, stream):
        assert stream.get_recording_id() == "log?"
    assert (tmp_path / "run.rrd").stat().st_size > 0
    with pytest.raises(InputError, match="no path that is not UTF-8"), recording(tmp_path / "run\udcff.rrd", "log"):
        pass
    assert [file.name for file in tmp_path.iterdir()] == ["run.rrd"]


@pytest.fixture(scope="module", params=["planar", "spatial"])
def run(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    log = simulated_log(RobotWorld(steps=20, spatial=request.param == "spatial"), 0)
    write_run(filter_opened(open_robot_log(log, RangeBearingConfig(particles=20))), folder, {"recording": "here"})
    return folder


@pytest.mark.slow
def test_all_formats_hold_the_run(run, tmp_path, capsys):
    capsys.readouterr()
    formats = ["tum", "kitti", "ply", "colmap", "rerun", "npz"]
    assert main(["export", str(run), "--format", *formats, "--out", str(tmp_path), "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    names = {"trajectory.tum", "trajectory_kitti.txt", "map.ply", "path.ply", "colmap", "run.rrd", "run.npz"}
    assert {path.name for path in tmp_path.iterdir()} == names and len(files) == len(names)
    estimate = load(run).estimate
    poses = estimate.trajectory.world_from_body
    np.testing.assert_array_equal(read_tum(tmp_path / "trajectory.tum").stamps_ns, estimate.stamps_ns)
    kitti = SE3.from_matrix(np.loadtxt(tmp_path / "trajectory_kitti.txt").reshape(-1, 3, 4))
    for path in (read_tum(tmp_path / "trajectory.tum").world_from_body, kitti):
        assert np.abs(SE3.local(path, poses)).max() < 1e-9
    with np.load(tmp_path / "run.npz") as archive:
        np.testing.assert_array_equal(archive["world_from_body"], estimate.world_from_body)
        np.testing.assert_array_equal(archive["landmarks"], estimate.landmarks.mean)
        np.testing.assert_array_equal(archive["cov_landmarks"], estimate.landmarks.cov)
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    assert model.num_points3D() == estimate.landmarks.ids.size and model.num_images() == len(poses)
    assert (tmp_path / "map.ply").read_bytes().startswith(b"ply")
    assert (tmp_path / "run.rrd").read_bytes()[:4] == b"RRF2"
