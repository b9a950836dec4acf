"""`rbpf calibrate`: pictures of a board in, a camera.yaml that the readers take out; bad input in one sentence."""

import json

import cv2
import numpy as np
import pytest

from rbpf.cli import main
from rbpf.sensors.readers import open_images
from rbpf.sensors.readers.images.calibration import read_calibration
from tests.cli.mono_sequences import sentence
from tests.sensors.board_pictures import BOARD, CAMERA, pictures

pytestmark = pytest.mark.slow

BOARD_OPTIONS = ("--board", "9x6", "--square", str(BOARD.square_m))


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("board") / "images"
    folder.mkdir()
    for number, image in enumerate(pictures()):
        cv2.imwrite(str(folder / f"{number:02d}.png"), image)
    return folder


def calibrate(images, out, *arguments, board=BOARD_OPTIONS):
    return main(["calibrate", str(images), *board, "--out", str(out), *arguments])


def test_the_camera_is_written_for_the_readers(images, tmp_path, capsys):
    assert calibrate(images, tmp_path / "out", "--json") == 0
    entries = json.loads(capsys.readouterr().out)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "camera.yaml", "calibration.json", "calibration.png"
    }  # fmt: skip
    camera = read_calibration(tmp_path / "out" / "camera.yaml").camera
    assert (camera.width, camera.height) == (CAMERA.width, CAMERA.height)
    np.testing.assert_allclose(camera.params[:4], CAMERA.params[:4], atol=0.5)
    assert (
        entries["fx"] == pytest.approx(camera.fx, abs=1e-5) and {"fx", "fy", "cx", "cy", "k1"} <= entries["std"].keys()
    )
    assert 0.0 < entries["reprojection_rms_px"] < 0.08 and entries["views"] >= 10
    assert open_images(images, tmp_path / "out" / "camera.yaml").camera == camera


def test_a_camera_that_is_not_known_well_is_said_to_be(images, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rbpf.cli.cameras.LOOSE", 1e-5)
    assert calibrate(images, tmp_path / "out") == 0
    assert "0.0 % of its focal length only, and a run with it will bend" in " ".join(capsys.readouterr().err.split())


def blank(folder):
    cv2.imwrite(str(folder / "a.png"), np.full((480, 640), 128, np.uint8))


def few(folder):
    for number, image in enumerate(pictures()[:3]):
        cv2.imwrite(str(folder / f"{number}.png"), image)


def mixed(folder):
    few(folder)
    cv2.imwrite(str(folder / "9.png"), cv2.resize(pictures()[4], (480, 360)))


def damaged(folder):
    (folder / "a.png").write_bytes(b"no image")


@pytest.mark.parametrize(
    ("fill", "board", "words"),
    [
        (blank, "9x6", "no chessboard of 9x6 inner corners is found in 1 images"),
        (few, "10x7", "a chessboard of 9x6 corners is seen: --board counts the places where four"),
        (few, "9x6", "expected at least 5, better 15"),
        (mixed, "9x6", "9.png has 480x360 px, the images before it 640x480"),
        (damaged, "9x6", "none of its images can be read"),
        (lambda folder: None, "9x6", "expected images in it"),
        (few, "9", "inner corners as 9x6"),
        (few, "9x2", "at least 3x3"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, capsys, fill, board, words):
    folder = tmp_path / "images"
    folder.mkdir()
    fill(folder)
    assert calibrate(folder, tmp_path / "out", board=("--board", board, "--square", "0.024")) == 2
    assert words in " ".join(sentence(capsys).split())
    assert not (tmp_path / "out").exists()


def test_no_such_input(tmp_path, capsys):
    assert calibrate(tmp_path / "nothing", tmp_path / "out") == 2
    assert "no such file or folder" in sentence(capsys)
    (tmp_path / "notes.txt").write_text("hello")
    assert calibrate(tmp_path / "notes.txt", tmp_path / "out") == 2
    assert "neither a folder nor a video" in sentence(capsys)
