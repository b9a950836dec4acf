"""`rbpf run mono --board` and `rbpf simulate desk --board`."""

import cv2
import numpy as np
import pytest
import yaml

from rbpf.cli import main
from rbpf.lie import SE3
from rbpf.runs.trajectory import read_tum
from rbpf.sensors.camera import Pinhole
from tests.cli.mono_sequences import run, sentence, summary

pytestmark = pytest.mark.slow


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


@pytest.mark.slow
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
