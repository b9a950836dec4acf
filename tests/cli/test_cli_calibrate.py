"""`rbpf calibrate`: pictures of a board in, a camera.yaml that the readers take out; bad input in one sentence."""

import json

import cv2
import numpy as np
import pytest
import yaml

from rbpf.cli import main
from rbpf.lie import SE3
from rbpf.runs.measurement_files import read_feature_log
from rbpf.runs.trajectory import read_tum
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import open_images
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from tests.cli.sequences import FRAMES, run, sentence, summary
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
        (few, "9x6", "detected in 2 images, expected at least 5, better 15"),
        (mixed, "9x6", "9.png has 480x360 px, the images before it 640x480"),
        (damaged, "9x6", "none of its images can be read"),
        (lambda folder: None, "9x6", "expected images in it"),
        (few, "9", "inner corners as 9x6"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, capsys, fill, board, words):
    folder = tmp_path / "images"
    folder.mkdir()
    fill(folder)
    assert calibrate(folder, tmp_path / "out", board=("--board", board, "--square", "0.024")) == 2
    assert words in " ".join(sentence(capsys).split()) and not (tmp_path / "out").exists()


def test_no_such_input(tmp_path, capsys):
    assert calibrate(tmp_path / "nothing", tmp_path / "out") == 2
    assert "no such file or folder" in sentence(capsys)
    (tmp_path / "notes.txt").write_text("hello")
    assert calibrate(tmp_path / "notes.txt", tmp_path / "out") == 2
    assert "neither a folder nor a video" in sentence(capsys)


# `rbpf run mono --board` and `rbpf simulate desk --board`.


def test_a_rendered_board_is_what_a_run_starts_from(tmp_path, capsys):
    size = ["--frames", "8", "--width", "320", "--height", "240", "--board", "6x4", "--square", "0.04"]
    assert main(["simulate", "desk", "--out", str(tmp_path / "desk"), *size]) == 0
    board = ("--board", "6x4", "--square", "0.04")
    assert run(tmp_path / "desk", tmp_path / "run", *board, known=False) == 0
    entries = summary(tmp_path / "run")
    assert entries["known_points"] == 12 and entries["frames_tracked"] == 8
    assert "path_rmse_m" not in entries and entries["ate_rmse_m"] < 0.01
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert (config["board"], config["square_m"]) == ("6x4", 0.04)
    first = read_tum(tmp_path / "run" / "trajectory.tum").world_from_body[0]
    entry = yaml.safe_load((tmp_path / "desk" / "chessboard.yaml").read_text())[0]
    truth = np.loadtxt(tmp_path / "desk" / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    where = SE3.inverse_transform(np.array(entry["world_from_board"]), truth[0, 1:4])
    assert np.linalg.norm(first[4:] - where) < 0.01 * np.linalg.norm(where)
    assert run(tmp_path / "desk", tmp_path / "other", "--board", "9x6", "--square", "0.04", known=False) == 2
    assert "no chessboard of 9x6 inner corners" in sentence(capsys)


def test_markers_are_what_a_run_starts_from(tmp_path, capsys):
    """A sheet of markers under a camera that moves sideways, by homographies."""
    patterns = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    sheet = cv2.aruco.GridBoard((5, 4), 0.06, 0.02, patterns).generateImage((800, 640), marginSize=20)
    folder = tmp_path / "sheet"
    folder.mkdir()
    camera = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
    across, texels = 0.06 * 5 + 0.02 * 4, 800 - 40
    for t in range(10):
        at = np.array([0.19 + 0.004 * t, 0.15, -0.45])  # in the board's frame: z goes into the sheet
        corners = np.array([[0.0, 0, 0], [across, 0, 0], [across, 0.3, 0], [0, 0.3, 0]]) - at
        metres = texels / across
        drawn = 20 + metres * (corners + at)[:, :2] - 0.5
        homography = cv2.getPerspectiveTransform(drawn.astype(np.float32), camera.project(corners).astype(np.float32))
        image = cv2.warpPerspective(sheet, homography, (320, 240), flags=cv2.INTER_AREA, borderValue=190)
        noise = np.random.default_rng(t).normal(0.0, 1.0, image.shape)
        cv2.imwrite(str(folder / f"{t}.png"), np.clip(cv2.GaussianBlur(image, (0, 0), 0.8) + noise, 0, 255))
    lens = "fx: 260\nfy: 260\ncx: 159.5\ncy: 119.5\nwidth: 320\nheight: 240\n"
    (folder / "camera.yaml").write_text(lens)
    board = ("--aruco", "5x4", "--marker", "0.06", "--gap", "0.02")
    assert run(folder, tmp_path / "run", *board, known=False) == 0
    assert summary(tmp_path / "run")["known_points"] == 12
    path = read_tum(tmp_path / "run" / "trajectory.tum").positions
    truth = np.array([[0.19 + 0.004 * t, 0.15, -0.45] for t in range(10)])
    assert np.linalg.norm(path - truth, axis=1).max() < 0.01
    again = ["run", "--from", str(tmp_path / "run" / "config.yaml"), "--no-video", "--no-batch"]
    assert main(again) == 0
    repeated = (tmp_path / "run-again" / "trajectory.tum").read_bytes()
    assert repeated == (tmp_path / "run" / "trajectory.tum").read_bytes()
    assert run(folder, tmp_path / "other", *board, "--dictionary", "6x6_50", known=False) == 2
    assert "no marker of a board of 5x4 from 6X6_50" in " ".join(sentence(capsys).split())


def test_a_room_has_no_board(tmp_path, capsys):
    assert main(["simulate", "room", "--out", str(tmp_path / "room"), "--board", "9x6", "--square", "0.02"]) == 2
    assert "a room has no chessboard" in sentence(capsys)


# A fisheye camera of 140° from end to end: rendered, run over with one and with two cameras, adjusted, calibrated.

WIDE = Pinhole(320, 240, 131.0, 131.0, 159.5, 119.5, (-0.03, 0.02, -0.012, 0.002), "equidistant")
EDGE = np.deg2rad(55.0)
"""Farther from the axis than a pinhole camera of the other tests sees."""


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered") / "wide"
    simulate_images(TexturedDesk(frames=FRAMES, texel_m=0.003), Imaging(noise_std=1.0), WIDE, folder, seed=1)
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
    assert entries["ate_rmse_m"] < 0.01 and entries["batch_ate_rmse_m"] < 0.01
    assert 10 <= entries["observations_per_frame"] <= 25
    log = read_feature_log(finished)
    assert log.camera == WIDE
    uv = WIDE.unproject(np.concatenate([frame.z for frame in log.frames]))
    assert (np.arctan(np.hypot(*uv.T)) > EDGE).sum() > FRAMES, "nothing was measured where only a fisheye sees"


def test_its_run_is_validated_and_calibrates_its_camera(finished, tmp_path, capsys):
    assert main(["validate", str(finished), "--against", "gtsam", "--json"]) == 0
    capsys.readouterr()
    assert main(["recalibrate", str(finished), "--out", str(tmp_path / "out"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    camera = read_calibration(tmp_path / "out" / "camera.yaml").camera
    assert camera.distortion_model == "equidistant" and camera.distortion[1:] == WIDE.distortion[1:]
    assert told["k1"] == {"before": WIDE.distortion[0], "after": pytest.approx(camera.distortion[0], abs=1e-8)}
    assert abs(camera.fx / WIDE.fx - 1.0) < 0.02
