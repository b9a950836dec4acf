"""Group axioms, charts, Jacobians and means: the same tests for every group, every angle and any input."""

import numpy as np
import pytest

from rbpf.lie import SE2, SE3, Euclidean, LieGroup, Product

GROUPS = [SE2, SE3, Euclidean(3), Product(SE3, Euclidean(6))]
ANGLES = [0.0, 1e-160, 1e-7, 1e-2, 1.0, 1.0 + 1e-9, 3.0, np.pi - 1e-9]
BATCHES = [(), (2, 3), (0,)]
every_group = pytest.mark.parametrize("group", GROUPS, ids=repr)
every_angle = pytest.mark.parametrize("angle", ANGLES)
every_batch = pytest.mark.parametrize("shape", BATCHES, ids=str)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20061)


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
    result = group.retract(a, xi)
    assert result.flags.c_contiguous
    assert result.flags.writeable


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
