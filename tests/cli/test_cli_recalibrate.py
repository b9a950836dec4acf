"""`rbpf recalibrate`: a camera.yaml from what a run measured; bad input in one sentence."""

import json

import pytest

from rbpf.cli import main
from rbpf.sensors.readers.images.calibration import read_calibration
from tests.cli.mono_sequences import CAMERA, run, sentence

pytestmark = pytest.mark.slow


def test_a_run_calibrates_its_camera(desk, tmp_path, capsys):
    assert run(desk, tmp_path / "run") == 0
    capsys.readouterr()
    assert main(["recalibrate", str(tmp_path / "run"), "--out", str(tmp_path / "out"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    camera = read_calibration(tmp_path / "out" / "camera.yaml").camera
    assert told["fx"] == {"before": CAMERA.fx, "after": pytest.approx(camera.fx, abs=1e-6)}
    assert told["k1"]["after"] == pytest.approx(camera.distortion[0], abs=1e-8)
    assert told["error_after"] <= told["error_before"]
    assert (camera.width, camera.height, camera.cx) == (CAMERA.width, CAMERA.height, CAMERA.cx)


def test_a_folder_without_a_run(tmp_path, capsys):
    assert main(["recalibrate", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "expected the folder of a finished run" in sentence(capsys)
    assert not (tmp_path / "out").exists()


def test_a_run_without_a_camera(tmp_path, capsys):
    log = tmp_path / "log"
    assert main(["simulate", "range-bearing", "--out", str(log), "--steps", "20"]) == 0
    assert main(["run", "range-bearing", str(log), "--particles", "5", "--out", str(tmp_path / "run")]) == 0
    assert main(["recalibrate", str(tmp_path / "run"), "--out", str(tmp_path / "out")]) == 2
    assert "no run of one camera" in sentence(capsys)
