"""SE(2) and SE(3) against matrix exponentials, SciPy and GTSAM, at every angle."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from rbpf.lie import SE2, SE3, LieGroup

ANGLES = [0.0, 1e-160, 1e-7, 1e-2, 1.0, 3.0, np.pi - 1e-9, np.pi]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20061)


def hat(xi: np.ndarray) -> np.ndarray:
    """Matrix of the Lie algebra of SE(2) or SE(3)."""
    if xi.size == 3:
        return np.array([[0.0, -xi[0], xi[1]], [xi[0], 0.0, xi[2]], [0.0, 0.0, 0.0]])
    out = np.zeros((4, 4))
    out[:3, :3] = np.cross(np.eye(3), xi[:3])
    out[:3, 3] = xi[3:]
    return out


def ad(group: LieGroup, xi: np.ndarray) -> np.ndarray:
    """Derivative of the adjoint, from the brackets of the basis."""
    basis = [hat(unit) for unit in np.eye(group.dim)]
    columns = [hat(xi) @ generator - generator @ hat(xi) for generator in basis]
    flat = np.stack([generator.ravel() for generator in basis], axis=1)
    return np.linalg.lstsq(flat, np.stack([c.ravel() for c in columns], axis=1))[0]


def test_log_at_exactly_half_a_turn():
    quarter = SE3.log([0.0, 0.6, 0.8, 0.0, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(np.linalg.norm(quarter[:3]), np.pi, rtol=1e-15)
    np.testing.assert_allclose(SE3.exp(quarter), [0.0, 0.6, 0.8, 0.0, 1.0, 2.0, 3.0], atol=1e-15)
    np.testing.assert_array_equal(SE3.log([0.0, 0.6, 0.8, -0.0, 1.0, 2.0, 3.0]), quarter)
    flat = SE2.log([np.pi, 1.0, 2.0])
    np.testing.assert_allclose(SE2.exp(flat), [np.pi, 1.0, 2.0], rtol=1e-15)


def test_log_takes_the_shorter_way_for_both_signs_of_the_quaternion(rng):
    x = SE3.exp(rng.normal(size=(50, 6)))
    negative = x * np.array([-1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(SE3.log(negative), SE3.log(x))
    assert np.linalg.norm(SE3.log(x)[:, :3], axis=-1).max() <= np.pi


@pytest.mark.parametrize(
    "angle", [np.pi, -np.pi, 3 * np.pi, np.nextafter(np.pi, 4.0), np.nextafter(-np.pi, 0.0), 100.0, -1e-300]
)
def test_plane_angles_stay_in_the_half_open_turn(angle):
    theta = SE2.normalise([angle, 1.0, 2.0])[0]
    assert -np.pi < theta <= np.pi
    np.testing.assert_allclose(np.exp(1j * theta), np.exp(1j * angle), atol=1e-14)


@pytest.mark.parametrize("group", [SE2, SE3], ids=repr)
@pytest.mark.parametrize("angle", ANGLES)
def test_closed_forms_equal_matrix_exponentials(group, angle, rng):
    n = group.dim
    turning = 1 if group is SE2 else 3
    for xi in rng.normal(size=(5, n)):
        xi[:turning] *= angle / np.linalg.norm(xi[:turning])
        np.testing.assert_allclose(group.matrix(group.exp(xi)), expm(hat(xi)), atol=5e-15)
        np.testing.assert_allclose(group.adjoint(group.exp(xi)), expm(ad(group, xi)), atol=1e-14)
        # The upper right block of exp [[ad, 1], [0, 0]] is the integral of exp(s ad): J_l.
        augmented = np.block([[ad(group, xi), np.eye(n)], [np.zeros((n, 2 * n))]])
        np.testing.assert_allclose(group.left_jacobian(xi), expm(augmented)[:n, n:], atol=1e-14)


def test_mean_survives_the_seam_of_the_angle():
    mean = SE2.mean([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]], [0.5, 0.5])
    assert abs(mean[0]) == pytest.approx(np.pi, abs=1e-14)


@pytest.mark.parametrize(("group", "n"), [(SE2, 2), (SE3, 3)], ids=["SE2", "SE3"])
def test_points_and_matrices(group, n, rng):
    a = group.exp(rng.normal(size=(6, 1, group.dim)))
    points = rng.normal(size=(4, n))
    world = group.transform(a, points)
    assert world.shape == (6, 4, n)
    rotation, translation = group.rotation(a), group.translation(a)
    np.testing.assert_allclose(world, np.einsum("nlij,lj->nli", rotation, points) + translation, atol=1e-14)
    np.testing.assert_allclose(group.inverse_transform(a, world), np.broadcast_to(points, world.shape), atol=1e-14)
    np.testing.assert_allclose(
        group.matrix(group.inverse(a)) @ group.matrix(a), group.matrix(group.identity((6, 1))), atol=1e-14
    )
    np.testing.assert_allclose(
        group.local(a, group.from_matrix(group.matrix(a))), np.zeros((6, 1, group.dim)), atol=1e-14
    )


@pytest.mark.parametrize("axis", [*np.eye(3), -np.eye(3)[1], np.array([0.6, 0.0, -0.8])])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 2.0, np.pi])
def test_quaternions_from_matrices_at_every_largest_component(axis, angle):
    x = SE3.exp(np.r_[angle * axis, 1.0, 2.0, 3.0])
    back = SE3.from_matrix(SE3.matrix(x))
    np.testing.assert_allclose(SE3.local(x, back), np.zeros(6), atol=1e-15)
    assert back[3] >= 0.0


def test_rotations_agree_with_scipy(rng):
    x = SE3.exp(rng.normal(size=(40, 6)))
    reference = Rotation.from_quat(x[:, :4])
    np.testing.assert_allclose(SE3.rotation(x), reference.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(SE3.log(x)[:, :3], reference.as_rotvec(), atol=1e-14)
    yaw, pitch, roll = rng.uniform(-1.5, 1.5, (3, 40))
    angles = np.stack([yaw, pitch, roll], axis=-1)
    built = SE3.from_ypr(x[:, 4:], yaw, pitch, roll)
    scipys = Rotation.from_euler("ZYX", angles).as_matrix()
    np.testing.assert_allclose(SE3.rotation(built), scipys, atol=1e-15)
    np.testing.assert_array_equal(SE3.translation(built), x[:, 4:])
    np.testing.assert_allclose(np.stack(SE3.ypr(built), axis=-1), angles, atol=1e-14)
    assert SE3.from_ypr([1.0, 2.0, 3.0], yaw, 0.1, 0.2).shape == (40, 7)


@pytest.mark.parametrize("weighted", [False, True])
def test_the_pose_that_brings_points_closest_is_scipys(rng, weighted):
    given, world = rng.normal(size=(5, 3)), rng.normal(size=(4, 5, 3))
    weights = rng.dirichlet(np.ones(5)) if weighted else None
    found = SE3.closest(given, world, weights)
    about = np.full(5, 0.2) if weights is None else weights
    for pose, points in zip(found, world, strict=True):
        middle = about @ points
        turn, _ = Rotation.align_vectors(points - middle, given - about @ given, about)
        np.testing.assert_allclose(SE3.matrix(pose)[:3, :3], turn.as_matrix(), atol=1e-12)
        np.testing.assert_allclose(pose[4:], middle - turn.apply(about @ given), atol=1e-12)
