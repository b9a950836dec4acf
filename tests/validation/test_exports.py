"""`rbpf export`: what other programs read is the run's own path and map."""

import json

import numpy as np
import pycolmap
import pytest

from rbpf.cli import main
from rbpf.lie import SE3
from rbpf.runs.results import load
from rbpf.runs.trajectory import read_kitti, read_tum

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=["planar", "spatial"])
def run(request, tmp_path_factory, plain_pictures):
    folder = tmp_path_factory.mktemp(request.param)
    more = ["--spatial"] if request.param == "spatial" else []
    assert main(["simulate", "range-bearing", "--out", str(folder / "log"), "--steps", "20", *more]) == 0
    out = ["--out", str(folder / "run"), "--particles", "20", "--no-batch"]
    assert main(["run", "range-bearing", str(folder / "log"), *out]) == 0
    return folder / "run"


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
    for path in (read_tum(tmp_path / "trajectory.tum"), read_kitti(tmp_path / "trajectory_kitti.txt")):
        assert np.abs(SE3.local(path.world_from_body, poses)).max() < 1e-9
    with np.load(tmp_path / "run.npz") as archive:
        np.testing.assert_array_equal(archive["world_from_body"], estimate.world_from_body)
        np.testing.assert_array_equal(archive["landmarks"], estimate.landmarks.mean)
        np.testing.assert_array_equal(archive["cov_landmarks"], estimate.landmarks.cov)
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    assert model.num_points3D() == estimate.landmarks.ids.size and model.num_images() == len(poses)
    assert (tmp_path / "map.ply").read_bytes().startswith(b"ply")
    assert (tmp_path / "run.rrd").read_bytes()[:4] == b"RRF2"


def test_what_is_no_run_is_refused(tmp_path, capsys):
    assert main(["export", str(tmp_path), "--format", "tum"]) == 2
    assert "no config.yaml: expected the folder" in capsys.readouterr().err
    assert not (tmp_path / "export").exists()
