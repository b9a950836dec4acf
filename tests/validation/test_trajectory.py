"""Trajectories and which poses of two belong together."""

import numpy as np
import pytest
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.runs.trajectory import Trajectory, associate

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
    reference = at_times([4, 31, 50, 65, 100])
    left, right = associate(estimate, reference)
    assert rows(left) == [0, 1, 3]
    assert rows(right) == [0, 1, 3]


def test_of_two_equally_near_the_earlier_is_taken():
    left, right = associate(at_times([10]), at_times([5, 15]))
    assert (rows(left), rows(right)) == ([0], [0])
    left, right = associate(at_times([5, 15]), at_times([10]))
    assert (rows(left), rows(right)) == ([0], [0])


def test_the_largest_difference_is_exact_at_present_day_stamps():
    start = 1_403_636_579_763_555_584
    estimate, reference = at_times([0.0]), at_times([0.0])
    now = Trajectory(estimate.stamps_ns + start, estimate.world_from_body)
    later = Trajectory(reference.stamps_ns + start + 10 * MS, reference.world_from_body)
    assert len(associate(now, later)[0]) == 1
    with pytest.raises(InputError, match=r"within 0\.01 s"):
        associate(now, Trajectory(later.stamps_ns + 1, later.world_from_body))


def test_counted_steps_pair_only_with_themselves():
    estimate = Trajectory(np.array([0, 1, 2, 5]), SE3.identity((4,)))
    reference = Trajectory(np.array([1, 3, 5, 6]), SE3.identity((4,)))
    left, right = associate(estimate, reference, max_difference_ns=0)
    assert left.stamps_ns.tolist() == right.stamps_ns.tolist() == [1, 5]


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


@pytest.mark.parametrize("seed", range(5))
def test_pairs_are_those_of_evo_where_none_is_contested(seed):
    rng = np.random.default_rng(seed)
    reference = at_times(np.cumsum(rng.uniform(9.0, 11.0, size=400)).tolist())
    estimate = at_times(np.cumsum(rng.uniform(30.0, 60.0, size=90)).tolist())
    left, right = associate(estimate, reference, 4 * MS)
    evo_right, evo_left = sync.associate_trajectories(in_evo(reference), in_evo(estimate), max_diff=0.004)
    assert rows(left) == evo_left.positions_xyz[:, 0].astype(int).tolist()
    assert rows(right) == evo_right.positions_xyz[:, 0].astype(int).tolist()


def in_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    quat_wxyz = trajectory.world_from_body[:, [3, 0, 1, 2]]
    return PoseTrajectory3D(trajectory.positions, quat_wxyz, trajectory.stamps_ns * 1e-9)


def test_planar_poses_become_turns_about_z():
    planar = np.array([[0.3, 1.0, 2.0], [-2.0, -4.0, 0.5]])
    trajectory = Trajectory.from_planar(np.array([0, 1]), planar)
    np.testing.assert_allclose(trajectory.positions, [[1.0, 2.0, 0.0], [-4.0, 0.5, 0.0]])
    inside = SE3.matrix(trajectory.world_from_body)[:, :2][:, :, [0, 1, 3]]
    np.testing.assert_allclose(inside, SE2.matrix(planar)[:, :2], atol=1e-15)


@pytest.mark.parametrize(
    ("stamps_ns", "poses", "words"),
    [
        (np.arange(3), SE3.identity((2,)), r"found \(3,\) and \(2, 7\)"),
        (np.arange(2), np.full((2, 7), [0, 0, 0, 1, 0, np.nan, 0]), "row 0"),
        (np.array([5, 6, 4]), SE3.identity((3,)), "order of time, row 2"),
    ],
)
def test_what_is_no_trajectory_is_said(stamps_ns, poses, words):
    with pytest.raises(InputError, match=words):
        Trajectory(stamps_ns, poses)


def test_an_empty_trajectory_has_no_partner():
    with pytest.raises(InputError, match="empty"):
        associate(Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 7))), at_times([0]))
