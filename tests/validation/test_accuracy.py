"""Errors of trajectories and maps against evo, published numbers and closed forms; alignment against known motions."""

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.trajectory import Similarity, Trajectory, align
from rbpf.validation.metrics.accuracy import ate, landmark_errors, rpe
from tests.validation.worlds import wander

TRANSLATION = metrics.PoseRelation.translation_part
ANGLE_DEG = metrics.PoseRelation.rotation_angle_deg


def disturbed(truth: Trajectory, seed: int) -> Trajectory:
    """An estimate with noise, in another world of another scale."""
    rng = np.random.default_rng(seed)
    noisy = SE3.retract(truth.world_from_body, rng.normal(scale=0.05, size=(len(truth), 6)))
    world = Similarity(0.8, Rotation.random(random_state=rng).as_matrix(), rng.normal(scale=20.0, size=3))
    return Trajectory(truth.stamps_ns, world.transform_poses(noisy))


def in_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    quat_wxyz = trajectory.world_from_body[:, [3, 0, 1, 2]]
    return PoseTrajectory3D(trajectory.positions.copy(), quat_wxyz, trajectory.stamps_ns * 1e-9)


def aligned_in_evo(
    estimate: Trajectory, truth: Trajectory, alignment: str
) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    theirs, reference = in_evo(estimate), in_evo(truth)
    if alignment != "none":
        theirs.align(reference, correct_scale=alignment == "similarity")
    return reference, theirs


@pytest.mark.parametrize("alignment", ["none", "rigid", "similarity"])
def test_absolute_error_is_that_of_evo(alignment):
    truth = wander(150, 0)
    estimate = disturbed(truth, 0)
    evo_ape = metrics.APE(TRANSLATION)
    evo_ape.process_data(aligned_in_evo(estimate, truth, alignment))
    found = ate(estimate, truth, alignment)
    np.testing.assert_allclose(found.distances, evo_ape.error, rtol=1e-9, atol=1e-10)
    for statistic in ("rmse", "mean", "median", "max"):
        theirs = evo_ape.get_statistic(metrics.StatisticsType[statistic])
        assert getattr(found, statistic) == pytest.approx(theirs, rel=1e-9)


@pytest.mark.parametrize("alignment", ["none", "similarity"])
def test_relative_error_is_that_of_evo(alignment):
    truth = wander(150, 1)
    estimate = disturbed(truth, 1)
    found = rpe(estimate, truth, alignment)
    for relation, ours in ((TRANSLATION, found.translations), (ANGLE_DEG, found.rotations_deg)):
        evo_rpe = metrics.RPE(relation, 1, metrics.Unit.frames)
        evo_rpe.process_data(aligned_in_evo(estimate, truth, alignment))
        np.testing.assert_allclose(ours, evo_rpe.error, rtol=1e-6, atol=1e-9)


@pytest.mark.real_data
def test_kitti_00_has_the_published_errors(data_dir):
    folder = data_dir / "evo_reference"
    matrices = (np.loadtxt(folder / f"KITTI_00_{name}.txt").reshape(-1, 3, 4) for name in ("gt", "ORB"))
    truth, estimate = (Trajectory(np.arange(len(poses)), SE3.from_matrix(poses)) for poses in matrices)
    errors = {alignment: ate(estimate, truth, alignment) for alignment in ("none", "rigid", "similarity")}
    assert errors["none"].rmse == pytest.approx(7.790289, abs=1e-5)
    assert errors["rigid"].rmse == pytest.approx(1.303450, abs=1e-5)
    assert errors["similarity"].rmse == pytest.approx(0.937709, abs=1e-5)
    assert errors["similarity"].alignment.scale == pytest.approx(1.004698, abs=1e-6)
    by_frame = rpe(estimate, truth, "rigid")
    assert by_frame.translation_rmse == pytest.approx(0.028120, abs=2e-6)
    assert by_frame.rotation_rmse_deg == pytest.approx(0.114974, abs=2e-6)


def test_landmarks_that_both_maps_have_are_compared():
    truth = {1: np.array([0.0, 0.0]), 2: np.array([4.0, 0.0]), 3: np.array([0.0, 3.0]), 9: np.ones(2)}
    quarter_turn = Similarity(1.0, np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([1.0, 2.0]))
    estimate = {name: quarter_turn.transform(truth[name]) for name in (3, 2, 1)} | {7: np.zeros(2)}
    as_they_are = landmark_errors(estimate, truth)
    np.testing.assert_array_equal(as_they_are.keys, [1, 2, 3])
    np.testing.assert_allclose(as_they_are.distances, np.sqrt([5.0, 9.0 + 36.0, 4.0 + 1.0]))
    aligned = landmark_errors(estimate, truth, "rigid")
    assert aligned.max == pytest.approx(0.0, abs=1e-12)
    assert landmark_errors(truth, estimate, quarter_turn).max == pytest.approx(0.0, abs=1e-12)


def test_unpaired_trajectories_and_foreign_maps_are_refused():
    with pytest.raises(InputError, match="found 5 and 6; pair them with associate"):
        ate(wander(5, 1), wander(6, 1))
    with pytest.raises(InputError, match="two poses or more"):
        rpe(wander(1, 1), wander(1, 2))
    with pytest.raises(InputError, match="None of the 1 estimated landmarks"):
        landmark_errors({1: np.zeros(3)}, {2: np.zeros(3), 3: np.zeros(3)})


SEEDS = st.integers(0, 2**32 - 1)


def random_rotation(rng: np.random.Generator, dim: int) -> np.ndarray:
    if dim == 3:
        return Rotation.random(random_state=rng).as_matrix()
    c, s = np.cos(angle := rng.uniform(-np.pi, np.pi)), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def residual(found: Similarity, x: np.ndarray, y: np.ndarray) -> float:
    return float(np.square(y - found.transform(x)).sum())


@given(SEEDS, st.sampled_from([2, 3]), st.booleans())
def test_recovers_a_known_similarity(seed, dim, with_scale):
    rng = np.random.default_rng(seed)
    x = rng.normal(scale=5.0, size=(8, dim)) + 100.0
    scale = rng.uniform(0.1, 10.0) if with_scale else 1.0
    truth = Similarity(scale, random_rotation(rng, dim), rng.normal(scale=50.0, size=dim))
    found = align(x, truth.transform(x), with_scale)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)
    np.testing.assert_allclose(found.scale, scale, rtol=1e-10)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-7)


@pytest.mark.parametrize("mirrored", [False, True])
def test_no_rotation_found_by_search_is_closer(mirrored):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6, 3))
    y = x * [1.0, 1.0, -1.0 if mirrored else 1.0] + rng.normal(scale=0.3, size=(6, 3))
    found = align(x, y, with_scale=True)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)

    def cost(parameters: np.ndarray) -> float:
        rotation = Rotation.from_rotvec(parameters[:3]).as_matrix()
        return residual(Similarity(np.exp(parameters[3]), rotation, parameters[4:]), x, y)

    starts = [np.r_[Rotation.random(random_state=rng).as_rotvec(), 0.0, y.mean(0)] for _ in range(12)]
    best = min(minimize(cost, start, tol=1e-12).fun for start in starts)
    assert residual(found, x, y) == pytest.approx(best, rel=1e-6)


def test_a_mirrored_planar_set_is_turned_over_in_space_but_not_in_the_plane():
    x = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    y = x * [1.0, -1.0]
    assert residual(align(x, y), x, y) > 0.1
    x3, y3 = (np.column_stack([points, np.zeros(3)]) for points in (x, y))
    assert residual(align(x3, y3), x3, y3) == pytest.approx(0.0, abs=1e-20)


@given(SEEDS)
def test_points_on_a_line_turn_by_the_angle_between_the_lines(seed):
    rng = np.random.default_rng(seed)
    start, direction, turned = rng.normal(size=(3, 3))
    direction, turned = (v / np.linalg.norm(v) for v in (direction, turned))
    along = np.array([[-1.0], [0.0], [0.5], [3.0]])
    found = align(1000.0 * start + along * direction, along * turned)
    np.testing.assert_allclose(found.rotation @ direction, turned, atol=1e-6)
    angle = Rotation.from_matrix(found.rotation).magnitude()
    assert np.cos(angle) == pytest.approx(direction @ turned, abs=1e-6)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_poses_move_as_the_points_of_their_body_do():
    rng = np.random.default_rng(5)
    moved = Similarity(2.5, random_rotation(rng, 3), rng.normal(size=3))
    world_from_body = SE3.exp(rng.normal(size=(4, 6)))
    body_points = rng.normal(size=(4, 3))
    after = SE3.transform(moved.transform_poses(world_from_body), 2.5 * body_points)
    np.testing.assert_allclose(after, moved.transform(SE3.transform(world_from_body, body_points)), atol=1e-12)


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [
        (np.zeros((3, 3)), np.zeros((4, 3)), r"\(3, 3\) and \(4, 3\)"),
        (np.zeros((0, 3)), np.zeros((0, 3)), "N >= 1"),
        (np.zeros((3, 4)), np.zeros((3, 4)), "2-D or 3-D"),
        (np.full((3, 3), np.nan), np.zeros((3, 3)), "finite"),
    ],
)
def test_what_cannot_be_aligned_is_said(x, y, words):
    with pytest.raises(InputError, match=words):
        align(x, y)
