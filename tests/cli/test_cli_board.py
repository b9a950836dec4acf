"""`rbpf run mono --board` and `rbpf simulate desk --board`."""

import numpy as np
import pytest
import yaml

from rbpf.cli import main
from rbpf.lie import SE3
from rbpf.validation.trajectory_files import read_tum
from tests.cli.mono_sequences import run, sentence, summary


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
    assert run(tmp_path / "desk", tmp_path / "run", "--board", "9x6", "--square", "0.04", known=False) == 2
    assert "no chessboard of 9x6 inner corners" in sentence(capsys)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--board", "9x6"), "both its inner corners and the side of its squares"),
        (("--square", "0.02"), "both its inner corners and the side of its squares"),
        (("--board", "nine", "--square", "0.02"), "inner corners as 9x6"),
        (("--board", "9x6", "--square", "-1"), "must be positive"),
        (("--board", "9x6", "--square", "0.02", "--known-points", "here.csv"), "give one of the two"),
    ],
)
def test_a_board_that_makes_no_sense_is_refused(desk, tmp_path, capsys, arguments, words):
    assert run(desk, tmp_path / "run", *arguments, known=False) == 2
    assert words in sentence(capsys)
    assert not (tmp_path / "run").exists()


def test_a_room_has_no_board(tmp_path, capsys):
    assert (
        main(["simulate", "room", "--out", str(tmp_path / "room"), "--board", "9x6", "--square", "0.02"]) == 2
    )
    assert "a room has no chessboard" in sentence(capsys)
