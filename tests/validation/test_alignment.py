"""Alignment against motions that are known, and against a search over all of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.trajectory import Similarity, align

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
    assert found.unique
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
    assert not found.unique
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
