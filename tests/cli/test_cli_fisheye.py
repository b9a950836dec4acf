"""A fisheye camera of 140° from end to end: rendered, run over with one and with two cameras, adjusted, calibrated."""

import json

import numpy as np
import pytest

from rbpf.cli import main
from rbpf.runs.measurement_files import read_feature_log
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from tests.cli.mono_sequences import FRAMES, run, summary

pytestmark = pytest.mark.slow

CAMERA = Pinhole(320, 240, 131.0, 131.0, 159.5, 119.5, (-0.03, 0.02, -0.012, 0.002), "equidistant")
EDGE = np.deg2rad(55.0)
"""Farther from the axis than a pinhole camera of the other tests sees."""


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered") / "wide"
    simulate_images(TexturedDesk(frames=FRAMES, texel_m=0.003), Imaging(noise_std=1.0), CAMERA, folder, seed=1)
    return folder


@pytest.fixture(scope="module")
def finished(wide, tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "run"
    assert run(wide, out, "--video") == 0
    return out


def test_one_camera_is_as_near_to_the_truth_as_a_pinhole(finished):
    entries = summary(finished)
    assert entries["frames"] == entries["frames_tracked"] == FRAMES and entries["lost_frames"] == 0
    # The bound of tests/cli/test_cli_mono.py.
    assert entries["ate_rmse_m"] < 0.01
    assert entries["batch_ate_rmse_m"] < 0.01
    assert 10 <= entries["observations_per_frame"] <= 25
    log = read_feature_log(finished)
    assert log.camera == CAMERA
    uv = CAMERA.unproject(np.concatenate([frame.z for frame in log.frames]))
    assert (np.arctan(np.hypot(*uv.T)) > EDGE).sum() > FRAMES, "nothing was measured where only a fisheye sees"


def test_its_run_is_validated_and_calibrates_its_camera(finished, tmp_path, capsys):
    assert main(["validate", str(finished), "--against", "gtsam", "--json"]) == 0
    capsys.readouterr()
    assert main(["recalibrate", str(finished), "--out", str(tmp_path / "out"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    camera = read_calibration(tmp_path / "out" / "camera.yaml").camera
    assert camera.distortion_model == "equidistant" and camera.distortion[1:] == CAMERA.distortion[1:]
    assert told["k1"] == {"before": CAMERA.distortion[0], "after": pytest.approx(camera.distortion[0], abs=1e-8)}
    assert abs(camera.fx / CAMERA.fx - 1.0) < 0.02
