"""Trajectory files: every digit survives, and what is wrong is named with its line."""

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.trajectory import Trajectory, read_kitti, read_tum, write_tum

POSE = "1.0 2.0 3.0 0.0 0.0 0.0 1.0"


def test_tum_keeps_every_bit_and_every_nanosecond(tmp_path, wander):
    poses = wander(20, 1).world_from_body
    stamps = np.sort(np.random.default_rng(2).integers(-10, 2_000_000_000_000_000_000, size=20))
    stamps[:2] = [-1_000_000_001, -1]
    write_tum(tmp_path / "a.tum", Trajectory(stamps, poses))
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.stamps_ns, stamps)
    np.testing.assert_array_equal(back.positions, poses[:, 4:])
    np.testing.assert_allclose(back.world_from_body[:, :4], poses[:, :4], rtol=1e-15, atol=1e-16)
    assert [file.name for file in tmp_path.iterdir()] == ["a.tum"]


def test_evo_reads_what_is_written(tmp_path, wander):
    trajectory = wander(30, 3)
    write_tum(tmp_path / "a.tum", trajectory)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    np.testing.assert_array_equal(theirs.positions_xyz, trajectory.positions)
    np.testing.assert_array_equal(theirs.timestamps, trajectory.stamps_ns / 1e9)
    np.testing.assert_allclose(theirs.poses_se3, SE3.matrix(trajectory.world_from_body), atol=1e-12)


def test_tum_skips_comments_and_scales_short_quaternions(tmp_path):
    (tmp_path / "a.tum").write_text("# a comment\n\n12.0000000019 1 2 3 0 0.6 0 0.799\n")
    trajectory = read_tum(tmp_path / "a.tum")
    assert trajectory.stamps_ns.tolist() == [12_000_000_001]
    assert np.linalg.norm(trajectory.world_from_body[0, :4]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (f"0.0 {POSE}\n0.1 1 2 3 0 0 1\n", r"line 2: expected 8 columns .*found 7"),
        (f"# x\n0.0 {POSE}\n0.1 1 2 x 0 0 0 1\n", r"line 3: expected tz .*'x'"),
        ("0.0 1 2 nan 0 0 0 1\n", r"line 1: expected tz"),
        ("0.0 1 2 3 0 0 0 0.9\n", r"line 1: .*length 1, found length 0.9"),
        (f"0.5 {POSE}\n0.25 {POSE}\n", r"line 2: time runs backwards from 0.5 to 0.25"),
        ("# nothing\n", r"expected rows of timestamp"),
        ("", r"empty"),
    ],
)
def test_a_malformed_tum_file_is_refused_with_its_line(tmp_path, content, words):
    (tmp_path / "a.tum").write_text(content)
    with pytest.raises(InputError, match=rf"a\.tum.*{words}"):
        read_tum(tmp_path / "a.tum")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.tum: no such file"):
        read_tum(tmp_path / "none.tum")


def test_writing_that_fails_keeps_the_old_file_and_leaves_nothing_behind(tmp_path, wander, monkeypatch):
    target = tmp_path / "a.tum"
    target.write_text("old")

    def fail(self: Path, text: str, **options: str) -> int:
        self.touch()
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_text", fail)
    with pytest.raises(InputError, match="cannot be written: disk full"):
        write_tum(target, wander(3, 4))
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_kitti_is_read_row_by_row(tmp_path, wander):
    poses = wander(10, 5).world_from_body
    np.savetxt(tmp_path / "a.txt", SE3.matrix(poses)[:, :3].reshape(10, 12), fmt="%.9e")
    trajectory = read_kitti(tmp_path / "a.txt")
    np.testing.assert_array_equal(trajectory.stamps_ns, np.arange(10))
    np.testing.assert_allclose(SE3.local(poses, trajectory.world_from_body), 0.0, atol=1e-7)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1", "line 2: expected 12 columns"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "line 2: expected a rotation matrix"),
        ("1 0 0 0 0 1.1 0 0 0 0 1 0", "line 2: expected a rotation matrix"),
    ],
)
def test_a_malformed_kitti_file_is_refused_with_its_line(tmp_path, row, words):
    (tmp_path / "a.txt").write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{row}\n")
    with pytest.raises(InputError, match=rf"a\.txt, {words}"):
        read_kitti(tmp_path / "a.txt")
