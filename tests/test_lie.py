"""Group axioms, charts, Jacobians and means of every group; SE(2) and SE(3) against matrix exponentials and SciPy."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from rbpf.lie import SE2, SE3, Euclidean, LieGroup, Product, SE2Group, SE3Group

GROUPS = [SE2, SE3, Euclidean(3), Product(SE3, Euclidean(6))]
ANGLES = [0.0, 1e-160, 1e-7, 1e-2, 1.0, 1.0 + 1e-9, 3.0, np.pi - 1e-9]
BATCHES = [(), (2, 3), (0,)]
every_group = pytest.mark.parametrize("group", GROUPS, ids=repr)
every_angle = pytest.mark.parametrize("angle", ANGLES)
every_batch = pytest.mark.parametrize("shape", BATCHES, ids=str)


def rotations(group: LieGroup) -> int:
    """How many leading entries of a tangent turn something."""
    return {SE2: 1, SE3: 3}.get(group, 3 if isinstance(group, Product) else 0)


def tangents(group: LieGroup, rng: np.random.Generator, shape: tuple[int, ...], angle: float) -> np.ndarray:
    """Random tangents that turn by the given angle."""
    xi = rng.normal(size=(*shape, group.dim))
    if rotations(group):
        turning = xi[..., : rotations(group)]
        turning *= angle / np.linalg.norm(turning, axis=-1, keepdims=True)
    return xi


def random_elements(group: LieGroup, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return group.exp(rng.normal(size=(*shape, group.dim)))


def matrix(group: SE2Group | SE3Group, a: np.ndarray) -> np.ndarray:
    """Homogeneous matrices (…, D + 1, D + 1) of rigid motions."""
    out = np.tile(np.eye(group.point_dim + 1), (*a.shape[:-1], 1, 1))
    out[..., :-1, :-1], out[..., :-1, -1] = group.rotation(a), group.translation(a)
    return out


def assert_same(group: LieGroup, a: np.ndarray, b: np.ndarray, atol: float = 1e-14) -> None:
    """As elements of the group."""
    np.testing.assert_allclose(group.local(a, b), 0.0, atol=atol)


@every_group
@every_batch
def test_group_axioms(group, shape, rng):
    a, b, c = (random_elements(group, rng, shape) for _ in range(3))
    one, compose, inverse = group.identity(shape), group.compose, group.inverse
    assert_same(group, compose(compose(a, b), c), compose(a, compose(b, c)))
    assert_same(group, compose(a, inverse(a)), one)
    assert_same(group, compose(inverse(a), a), one)
    np.testing.assert_allclose(compose(a, one), a, atol=1e-15)
    np.testing.assert_allclose(compose(one, a), a, atol=1e-15)
    np.testing.assert_allclose(group.between(a, compose(a, b)), b, atol=1e-14)
    assert compose(a, b).shape == (*shape, group.size)


@every_group
def test_leading_axes_broadcast(group, rng):
    a, b = random_elements(group, rng, (4, 1)), random_elements(group, rng, (3,))
    xi = rng.normal(size=(3, group.dim))
    for function, second in ((group.compose, b), (group.retract, xi), (group.local, b)):
        together = function(a, second)
        assert together.shape[:-1] == (4, 3)
        for i, j in np.ndindex(4, 3):
            np.testing.assert_allclose(together[i, j], function(a[i, 0], second[j]), rtol=1e-14, atol=1e-14)


@every_group
def test_lists_and_views_are_accepted_and_never_written(group, rng):
    a = random_elements(group, rng, (6,))
    xi = rng.normal(size=(6, group.dim))
    np.testing.assert_array_equal(group.retract(a.tolist(), xi.tolist()), group.retract(a, xi))
    a.flags.writeable = xi.flags.writeable = False
    fortran = np.asfortranarray(a)[::2]
    np.testing.assert_array_equal(group.retract(fortran, xi[::2]), group.retract(a[::2].copy(), xi[::2]))
    np.testing.assert_array_equal(group.mean(fortran, np.ones(3) / 3), group.mean(a[::2].copy(), np.ones(3) / 3))
    result = group.retract(a, xi)
    assert result.flags.c_contiguous and result.flags.writeable


@every_group
@every_angle
def test_exp_and_log_retract_and_local_are_inverse_to_the_last_digits(group, angle, rng):
    xi, x, n = tangents(group, rng, (20,), angle), random_elements(group, rng, (20,)), rotations(group)
    with np.errstate(all="raise", under="ignore"):
        back = group.log(group.exp(xi))
        y = group.retract(x, xi)
        np.testing.assert_allclose(y, group.compose(x, group.exp(xi)), rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(group.local(x, y), xi, rtol=0.0, atol=2e-14)
        np.testing.assert_allclose(group.local(x, y), group.log(group.between(x, y)), rtol=0.0, atol=2e-14)
    np.testing.assert_allclose(back[:, :n], xi[:, :n], rtol=0.0, atol=4e-15 * angle)
    np.testing.assert_allclose(back[:, n:], xi[:, n:], rtol=0.0, atol=1e-14)


@every_group
@every_angle
def test_adjoint_and_jacobians(group, angle, rng):
    """The adjoint moves an increment to the left; the Jacobians are central differences, and inverse to one another."""
    a, xi = random_elements(group, rng, (20,)), tangents(group, rng, (20,), angle)
    left = group.compose(group.exp(np.einsum("nij,nj->ni", group.adjoint(a), xi)), a)
    assert_same(group, group.compose(a, group.exp(xi)), left, 5e-14)
    with np.errstate(all="raise", under="ignore"):
        eye = np.broadcast_to(np.eye(group.dim), (20, group.dim, group.dim))
        both = group.left_jacobian(xi) @ group.left_jacobian_inverse(xi)
        np.testing.assert_allclose(both, eye, atol=2e-14)
        both = group.right_jacobian_inverse(xi) @ group.right_jacobian(xi)
        np.testing.assert_allclose(both, eye, atol=2e-14)
    # A step of 1e-5 truncates at 1e-10 and rounds at 1e-10.
    xi, step = xi[:4, None], 1e-5 * np.eye(group.dim)
    centre = group.exp(xi)
    right = group.local(centre, group.exp(xi + step)) - group.local(centre, group.exp(xi - step))
    numeric = np.swapaxes(right, -1, -2) / 2e-5
    np.testing.assert_allclose(group.right_jacobian(xi[:, 0]), numeric, atol=2e-9)
    by_left = np.einsum("nij,njk->nik", group.adjoint(centre[:, 0]), numeric)
    np.testing.assert_allclose(group.left_jacobian(xi[:, 0]), by_left, atol=2e-8)


@every_group
def test_interpolation_meets_its_ends_and_adds_up(group, rng):
    a, b = random_elements(group, rng, (2, 7))
    near = group.retract(a, 0.3 * group.local(a, b))
    assert_same(group, group.interpolate(a, b, 0.0), a)
    assert_same(group, group.interpolate(a, b, 1.0), b)
    assert group.interpolate(a[0], b[0], np.linspace(0.0, 1.0, 7)).shape == (7, group.size)
    np.testing.assert_allclose(group.interpolate(a, b, np.full(7, 0.3)), near, atol=1e-14)


@every_group
def test_weighted_mean_is_stationary_and_moves_with_its_cloud(group, rng):
    cloud = group.exp(0.5 * rng.normal(size=(30, group.dim)))
    weights = rng.dirichlet(np.ones(30))
    mean = group.mean(cloud, weights)
    np.testing.assert_allclose(weights @ group.local(mean, cloud), np.zeros(group.dim), atol=1e-14)
    shift = random_elements(group, rng, ())
    assert_same(group, group.compose(shift, mean), group.mean(group.compose(shift, cloud), weights), 1e-13)
    assert_same(group, mean, LieGroup._mean_from(group, cloud[3], cloud, weights))


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
    np.testing.assert_allclose(SE2.exp(SE2.log([np.pi, 1.0, 2.0])), [np.pi, 1.0, 2.0], rtol=1e-15)


def test_log_takes_the_shorter_way_for_both_signs_of_the_quaternion(rng):
    x = SE3.exp(rng.normal(size=(50, 6)))
    negative = x * np.array([-1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(SE3.log(negative), SE3.log(x))
    assert np.linalg.norm(SE3.log(x)[:, :3], axis=-1).max() <= np.pi


@pytest.mark.parametrize(
    "angle", [np.pi, -np.pi, 3 * np.pi, np.nextafter(np.pi, 4.0), np.nextafter(-np.pi, 0.0), 100.0, -1e-300]
)
def test_plane_angles_stay_in_the_half_open_turn(angle):
    for theta in SE2.normalise([angle, 1.0, 2.0])[0], SE2.retract([angle, 1.0, 2.0], np.zeros(3))[0]:
        assert -np.pi < theta <= np.pi
        np.testing.assert_allclose(np.exp(1j * theta), np.exp(1j * angle), atol=1e-14)
    assert np.isnan(SE2.local(np.zeros(3), [np.inf, 1.0, 2.0])).all()


@pytest.mark.parametrize("group", [SE2, SE3], ids=repr)
@pytest.mark.parametrize("angle", [*ANGLES, np.pi])
def test_closed_forms_equal_matrix_exponentials(group, angle, rng):
    n = group.dim
    turning = 1 if group is SE2 else 3
    for xi in rng.normal(size=(5, n)):
        xi[:turning] *= angle / np.linalg.norm(xi[:turning])
        np.testing.assert_allclose(matrix(group, group.exp(xi)), expm(hat(xi)), atol=5e-15)
        np.testing.assert_allclose(group.adjoint(group.exp(xi)), expm(ad(group, xi)), atol=1e-14)
        # The upper right block of exp [[ad, 1], [0, 0]] is the integral of exp(s ad): J_l.
        augmented = np.block([[ad(group, xi), np.eye(n)], [np.zeros((n, 2 * n))]])
        np.testing.assert_allclose(group.left_jacobian(xi), expm(augmented)[:n, n:], atol=1e-14)


def test_mean_survives_the_seam_of_the_angle():
    mean = SE2.mean([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]], [0.5, 0.5])
    assert abs(mean[0]) == pytest.approx(np.pi, abs=1e-14)


@pytest.mark.parametrize(("group", "n"), [(SE2, 2), (SE3, 3), (Euclidean(2), 2)], ids=["SE2", "SE3", "Euclidean"])
def test_how_points_move_matches_a_numeric_derivative(group, n, rng):
    points, step = rng.normal(size=(4, n)), 1e-6 * np.eye(group.dim)
    ahead, back = (group.transform(group.exp(sign * step)[:, None], points) for sign in (1.0, -1.0))
    np.testing.assert_allclose(group.transform_jacobian(points), np.moveaxis(ahead - back, 0, -1) / 2e-6, atol=1e-9)


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
        matrix(group, group.inverse(a)) @ matrix(group, a), matrix(group, group.identity((6, 1))), atol=1e-14
    )
    if group is SE3:
        np.testing.assert_array_equal(SE3.matrix(a), matrix(SE3, a))
        np.testing.assert_allclose(SE3.local(a, SE3.from_matrix(SE3.matrix(a))), np.zeros((6, 1, 6)), atol=1e-14)


@pytest.mark.parametrize("axis", [*np.eye(3), -np.eye(3)[1], np.array([0.6, 0.0, -0.8])])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 2.0, np.pi])
def test_quaternions_from_matrices_at_every_largest_component(axis, angle):
    x = SE3.exp(np.r_[angle * axis, 1.0, 2.0, 3.0])
    back = SE3.from_matrix(SE3.matrix(x))
    np.testing.assert_allclose(SE3.local(x, back), np.zeros(6), atol=1e-15)
    assert back[3] >= 0.0


def test_rotations_agree_with_scipy(rng):
    for alone in (np.eye(3), np.tile(np.eye(3), (4, 1, 1))):  # a rotation is no rigid motion
        with pytest.raises(IndexError):
            SE3.from_matrix(alone)
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
