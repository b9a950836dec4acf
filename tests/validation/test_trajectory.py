"""Trajectories, which poses of two belong together, and their files: every digit, and what is wrong by its line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.runs.trajectory import Trajectory, associate, read_tum, write_tum
from tests.validation.worlds import wander

MS = 1_000_000


def at_times(stamps_ms: list[float]) -> Trajectory:
    """Still poses that carry their row as x."""
    poses = SE3.identity((len(stamps_ms),))
    poses[:, 4] = np.arange(len(stamps_ms))
    return Trajectory(np.round(np.array(stamps_ms) * MS).astype(np.int64), poses)


def rows(trajectory: Trajectory) -> list[int]:
    return trajectory.positions[:, 0].astype(int).tolist()


def test_each_pose_takes_the_nearest_and_a_contested_one_goes_to_the_nearest():
    estimate = at_times([0, 30, 33, 60, 200])
    left, right = associate(estimate, at_times([4, 31, 50, 65, 100]))
    assert rows(left) == [0, 1, 3]
    assert rows(right) == [0, 1, 3]


def test_the_largest_difference_is_exact_at_present_day_stamps():
    start = 1_403_636_579_763_555_584
    estimate, reference = at_times([0.0]), at_times([0.0])
    now = Trajectory(estimate.stamps_ns + start, estimate.world_from_body)
    later = Trajectory(reference.stamps_ns + start + 10 * MS, reference.world_from_body)
    assert len(associate(now, later)[0]) == 1
    with pytest.raises(InputError, match=r"within 0\.01 s"):
        associate(now, Trajectory(later.stamps_ns + 1, later.world_from_body))


@given(
    st.lists(st.integers(0, 500), min_size=1, max_size=30).map(sorted),
    st.lists(st.integers(0, 500), min_size=1, max_size=30).map(sorted),
    st.integers(0, 60),
)
def test_pairs_are_close_in_order_and_one_to_one(first, second, limit_ms):
    estimate, reference = at_times(first), at_times(second)
    gaps = np.abs(estimate.stamps_ns[:, None] - reference.stamps_ns[None])
    if gaps.min() > limit_ms * MS:
        with pytest.raises(InputError, match="same clock"):
            associate(estimate, reference, limit_ms * MS)
        return
    left, right = associate(estimate, reference, limit_ms * MS)
    assert len(set(rows(left))) == len(set(rows(right))) == len(left) == len(right)
    assert rows(left) == sorted(rows(left))
    assert rows(right) == sorted(rows(right))
    paired = np.abs(left.stamps_ns - right.stamps_ns)
    assert (paired <= limit_ms * MS).all()
    np.testing.assert_array_equal(paired, gaps[rows(left)].min(1))
    assert paired.min() == gaps.min()


@pytest.mark.parametrize(
    ("stamps_ns", "poses", "words"),
    [
        (np.arange(3), SE3.identity((2,)), r"world_from_body must hold numbers of shape \(T = 3, 7\), got \(2, 7\)"),
        (np.array([5, 6, 4]), SE3.identity((3,)), "stamps_ns must hold numbers in order .sort .*, got 4 at 2"),
    ],
)
def test_what_is_no_trajectory_is_said(stamps_ns, poses, words):
    with pytest.raises(InputError, match=words):
        Trajectory(stamps_ns, poses)


def test_tum_keeps_every_bit_and_every_nanosecond(tmp_path):
    poses = wander(20, 1).world_from_body
    stamps = np.sort(np.random.default_rng(2).integers(-10, 2_000_000_000_000_000_000, size=20))
    stamps[:2] = [-1_000_000_001, -1]
    write_tum(tmp_path / "a.tum", Trajectory(stamps, poses))
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.stamps_ns, stamps)
    np.testing.assert_array_equal(back.positions, poses[:, 4:])
    np.testing.assert_allclose(back.world_from_body[:, :4], poses[:, :4], rtol=1e-15, atol=1e-16)
    assert [file.name for file in tmp_path.iterdir()] == ["a.tum"]


def test_tum_skips_comments_and_scales_short_quaternions(tmp_path):
    (tmp_path / "a.tum").write_text("# a comment\n\n12.0000000019 1 2 3 0 0.6 0 0.799\n")
    trajectory = read_tum(tmp_path / "a.tum")
    assert trajectory.stamps_ns.tolist() == [12_000_000_001]
    assert np.linalg.norm(trajectory.world_from_body[0, :4]) == pytest.approx(1.0, abs=1e-15)


def test_writing_that_fails_keeps_the_old_file_and_leaves_nothing_behind(tmp_path, monkeypatch):
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


def test_planar_poses_become_turns_about_z():
    planar = np.array([[0.3, 1.0, 2.0], [-2.0, -4.0, 0.5]])
    trajectory = Trajectory.from_planar(np.array([0, 1]), planar)
    np.testing.assert_allclose(trajectory.positions, [[1.0, 2.0, 0.0], [-4.0, 0.5, 0.0]])
    inside = SE3.matrix(trajectory.world_from_body)[:, :2][:, :, [0, 1, 3]]
    np.testing.assert_allclose(inside, np.concatenate([SE2.rotation(planar), planar[:, 1:, None]], axis=2), atol=1e-15)
