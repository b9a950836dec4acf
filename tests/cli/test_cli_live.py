"""`rbpf run mono 0`: a camera that is attached, here one that plays a video."""

import cv2
import numpy as np
import pytest
import yaml

from rbpf.cli import main
from rbpf.sensors.readers import open_images


class Player:
    """What cv2.VideoCapture shows of a camera: a folder's images, then it is unplugged."""

    def __init__(self, images):
        self.images = images
        self.given = iter(images)

    def isOpened(self):  # noqa: N802
        return True

    def set(self, *_):
        return True

    def read(self):
        image = next(self.given, None)
        return (False, None) if image is None else (True, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))


def test_a_camera_is_filtered_until_it_is_gone(desk, tmp_path, monkeypatch):
    images = [frame.image for frame in open_images(desk).frames()]
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: Player(images))
    out = tmp_path / "run"
    command = ["run", "mono", "0", "--calibration", str(desk / "camera.yaml"), "--out", str(out), "--no-batch"]
    assert main(command) == 0
    assert np.loadtxt(out / "trajectory.tum").shape == (len(images), 8)
    assert yaml.safe_load((out / "config.yaml").read_text())["recording"] == "0"
    assert not (out / "annotated.mp4").exists()
    assert main(["run", "--from", str(out)]) == 2  # those images are gone


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "needs --calibration"),
        (["--calibration", "camera.yaml", "--resume"], "leave out --resume"),
        (["--calibration", "camera.yaml", "--known-points", "known_points.csv"], "--board or --aruco"),
        (["--calibration", "camera.yaml"], "there is no camera 0"),
    ],
)
def test_what_a_camera_cannot_do(options, words, desk, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(desk)
    assert main(["run", "mono", "0", *options, "--out", str(tmp_path / "run")]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
