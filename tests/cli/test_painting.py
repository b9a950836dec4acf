"""The pictures of one run of each system as they are meant to be looked at; other tests paint them small and plain."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rbpf.cli import main
from tests.cli.sequences import run, run_stereo

pytestmark = pytest.mark.slow

PICTURES = {"path.png", "map.png", "particles.png", "timings.png", "error.png", "groundtruth_nees.png"}


@pytest.fixture(scope="module")
def plain_pictures() -> None:
    """Not here."""


def check(out: Path) -> None:
    """Each picture is large, shows something, and nothing of it touches the edge: no label is cut off."""
    names = {path.name for path in out.glob("*.png")}
    assert names >= PICTURES
    for name in names:
        image = cv2.imread(str(out / name))
        assert image.shape[0] > 350 and image.shape[1] > 600, name
        edge = np.concatenate([image[:2].ravel(), image[-2:].ravel(), image[:, :2].ravel(), image[:, -2:].ravel()])
        assert (edge == 255).all(), name
        assert 0.005 < (image < 200).any(axis=-1).mean() < 0.7, name
        assert (out / name).with_suffix(".pdf").read_bytes().endswith(b"%%EOF\n"), name
    assert (out / "report.html").read_text().count("data:image/png;base64,") == len(names)


def test_a_robot_among_landmarks_one_camera_and_two(desk, room, tmp_path):
    log, out = tmp_path / "log", tmp_path / "run"
    assert main(["simulate", "range-bearing", "--out", str(log), "--steps", "20", "--landmarks", "30"]) == 0
    assert main(["run", "range-bearing", str(log), "--out", str(out), "--particles", "30"]) == 0
    assert run(desk, tmp_path / "one") == run_stereo(room, tmp_path / "two", "--no-video", "--no-batch") == 0
    for each in (out, tmp_path / "one", tmp_path / "two"):
        check(each)
