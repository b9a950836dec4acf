"""`rbpf run stereo` from end to end, on a few small rendered pairs."""

import importlib
import json
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from rbpf.cli import main
from rbpf.lie import SE3
from rbpf.runs.trajectory import read_tum
from rbpf.validation.colmap.compare import ReconstructionOptions
from tests.cli.run_outputs import BATCH, FILES, OF_CAMERAS, REQUIRED, names, outputs, untimed_summary
from tests.cli.sequences import PAIRS, run_stereo, sentence

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("keypoints_once")]
OWN_FILES = {"odometry.tum", "tracking.png", "observations_frames.csv", "annotated.mp4"}
OWN_ENTRIES = {
    "dof", "updates", "distance_m", "sift_features", "landmarks_mean_per_particle", "vo_ate_rmse_m", "log_evidence"
}  # fmt: skip


@pytest.fixture(scope="module")
def finished(room, tmp_path_factory, keypoints_once):
    out = tmp_path_factory.mktemp("finished") / "run"
    assert run_stereo(room, out) == 0
    return out


def table(path: Path) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", names=True)


def test_what_it_leaves(finished):
    assert names(finished) == FILES | BATCH | OWN_FILES
    entries = json.loads((finished / "summary.json").read_text())
    assert entries.keys() >= REQUIRED | OF_CAMERAS | OWN_ENTRIES
    assert entries["frames"] == PAIRS and entries["particles"] == 50 and entries["dof"] == 6
    assert np.isfinite(entries["log_evidence"])
    assert "problems" not in entries and "failure" not in entries
    assert 0 < entries["landmarks_mean_per_particle"] < entries["sift_features"]
    # Of about a metre.
    assert entries["distance_m"] > 0.3 and max(entries["ate_rmse_m"], entries["vo_ate_rmse_m"]) < 0.01


def test_the_files_agree(finished):
    entries = untimed_summary(finished)
    path, alone = read_tum(finished / "trajectory.tum"), read_tum(finished / "odometry.tum")
    assert len(path) == len(alone) == PAIRS
    np.testing.assert_allclose(path.world_from_body[0], SE3.identity(), atol=1e-12)
    steps = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    assert entries["distance_m"] == pytest.approx(steps.sum())
    rows, times = table(finished / "diagnostics.csv"), table(finished / "timings.csv")
    assert rows["updated"].sum() == entries["updates"]
    assert entries["observations_per_update"] == pytest.approx(rows["observed"][rows["updated"] > 0].mean())
    stages = sum(times[f"{name}_ms"] for name in ("features", "odometry", "matching", "filter"))
    assert (stages <= times["milliseconds"] + 1e-3).all()
    landmarks = table(finished / "map.csv")
    assert landmarks["landmark"].sum() == entries["landmarks_mean_per_particle"]
    assert (landmarks["sightings"][landmarks["landmark"] > 0] >= 3).all()
    np.testing.assert_array_equal(np.load(finished / "map.npz")["id"], landmarks["id"])


def test_ctrl_c_leaves_a_run_that_resumes_to_the_same_bytes(finished, room, tmp_path):
    """A real signal to a real process, in the middle of an update; the pair is finished first."""
    arguments = ["run", "stereo", str(room), "--out", str(tmp_path / "cut")]
    command = [sys.executable, "-c", _WAITING, *arguments]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, text=True, **pipes)
    assert process.stdout is not None
    assert process.stdout.readline() == "updating\n"
    process.send_signal(signal.SIGINT)
    _, error = process.communicate("go on\n", timeout=120)
    assert process.returncode == 130, error
    said = re.search(rf"stopped after (\d) of {PAIRS}; the same command with --resume", " ".join(error.split()))
    assert said is not None and 3 <= int(said[1]) < PAIRS
    assert {path.name for path in (tmp_path / "cut").iterdir()} == {"checkpoint.npz"}
    assert main([*arguments, "--resume"]) == 0
    again, whole = outputs(tmp_path / "cut"), outputs(finished)
    assert again.keys() == whole.keys()
    assert [name for name in whole if again[name] != whole[name]] == []


_WAITING = """
import sys
from rbpf.core.filter import Filter
step = Filter.step
def waiting(self, *arguments):
    if self.steps == 2:
        print("updating", flush=True)
        sys.stdin.readline()
    return step(self, *arguments)
Filter.step = waiting
from rbpf.cli import main
sys.exit(main())
"""


def test_options(room, tmp_path):
    """Three degrees of freedom, another seed, a setting, and a recording for the viewer."""
    pytest.importorskip("rerun")
    out, recording = tmp_path / "run", tmp_path / "run.rrd"
    arguments = ["--dof", "3", "--seed", "4", "--set", "proposal.kind=ekf", "--rerun", str(recording)]
    assert run_stereo(room, out, *arguments) == 0
    settings = yaml.safe_load((out / "config.yaml").read_text())
    assert (settings["dof"], settings["seed"], settings["proposal"]["kind"]) == (3, 4, "ekf")
    np.testing.assert_allclose(read_tum(out / "trajectory.tum").positions[:, 1], 0.0, atol=1e-12)
    assert recording.stat().st_size > 10_000


def test_bad_arguments(room, tmp_path, capsys):
    assert run_stereo(room, tmp_path / "run", "--set", "map.gate=-1") == 2
    assert "map.gate must be above 0" in " ".join(capsys.readouterr().err.split())


def test_the_batch_stands_beside(finished):
    """The optimum of the same pixels is nearer to the truth than odometry, and near the filter."""
    entries = untimed_summary(finished)
    assert len(read_tum(finished / "batch.tum")) == entries["batch_frames"] == PAIRS
    assert entries["batch_ate_rmse_m"] < entries["vo_ate_rmse_m"]
    assert 0.0 < entries["filter_minus_batch_rmse_m"] < 0.01


def test_a_run_is_compared_with_a_reconstruction(finished, tmp_path, monkeypatch, capsys):
    """The baseline tells the scale; so few pairs must all be key frames, and begin with a smaller angle."""
    importlib.import_module("rbpf.validation.colmap.compare")  # names the class as the type of an argument
    near = ReconstructionOptions(every=1, features=800, least_angle_deg=4.0)
    monkeypatch.setattr("rbpf.validation.colmap.compare.ReconstructionOptions", lambda **_: near)
    folder = shutil.copytree(finished, tmp_path / "run")
    assert main(["validate", str(folder), "--against", "colmap"]) == 0
    assert "(rms) from COLMAP's reconstruction" in " ".join(capsys.readouterr().err.split())
    figures = json.loads((folder / "validation_colmap.json").read_text())["figures"]
    assert figures["run_registered"] == figures["run_key_frames"] == PAIRS
    assert figures["run_alignment"] == figures["truth_alignment"] == "rigid"
    assert figures["truth_ate_rmse_m"] < 0.01 and figures["run_ate_rmse_m"] < 0.03
    assert figures["run_landmarks"] > 10 and figures["run_surface_median_m"] < 0.05
    assert "Against COLMAP" in (folder / "report.html").read_text()


def test_a_recording_that_is_gone_cannot_be_compared_and_the_report_is_written(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("/room", "/nowhere"))
    (folder / "report.html").unlink()
    capsys.readouterr()
    assert main(["validate", str(folder), "--against", "colmap"]) == 2
    assert "nowhere" in sentence(capsys)
    assert "Not compared with colmap" in (folder / "report.html").read_text()
