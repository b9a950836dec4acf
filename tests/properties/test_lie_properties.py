"""What holds in every group for any input Hypothesis can think of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rbpf.lie import SE2, SE3, Euclidean, LieGroup, Product

GROUPS = [SE2, SE3, Euclidean(3), Product(SE3, Euclidean(6))]
every_group = pytest.mark.parametrize("group", GROUPS, ids=repr)


def vectors(bound: float) -> st.SearchStrategy[np.ndarray]:
    """Three vectors as long as the longest tangent; each group takes what it needs."""
    return arrays(float, (3, 12), elements=st.floats(-bound, bound))


def near(group: LieGroup, a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    return bool(np.abs(group.local(a, b)).max() <= tolerance)


@every_group
@given(vectors(20.0))
def test_composition_is_associative_and_inverses_cancel(group, tangents):
    a, b, c = group.exp(tangents[:, : group.dim])
    scale = 1.0 + np.abs(tangents).max()
    left, right = group.compose(group.compose(a, b), c), group.compose(a, group.compose(b, c))
    assert near(group, left, right, 1e-13 * scale)
    assert near(
        group,
        group.inverse(group.compose(a, b)),
        group.compose(group.inverse(b), group.inverse(a)),
        1e-13 * scale,
    )


@every_group
@given(vectors(1.0))
def test_chart_round_trip_inside_its_radius(group, tangents):
    # Three components of at most one turn by less than pi.
    x, xi = group.exp(tangents[0, : group.dim]), tangents[1, : group.dim]
    np.testing.assert_allclose(group.local(x, group.retract(x, xi)), xi, rtol=0.0, atol=1e-14)


@every_group
@given(vectors(20.0))
def test_log_inverts_exp_as_an_element(group, tangents):
    x = group.exp(tangents[0, : group.dim])
    assert near(group, x, group.exp(group.log(x)), 1e-13 * (1.0 + np.abs(tangents).max()))


@every_group
@given(vectors(3.0))
def test_adjoint_is_a_homomorphism(group, tangents):
    a, b, _ = group.exp(tangents[:, : group.dim])
    together = group.adjoint(group.compose(a, b))
    np.testing.assert_allclose(together, group.adjoint(a) @ group.adjoint(b), atol=1e-12)


@every_group
@given(vectors(3.0))
def test_adjoint_is_left_jacobian_over_right_jacobian(group, tangents):
    xi = tangents[0, : group.dim]
    left = group.adjoint(group.exp(xi)) @ group.right_jacobian(xi)
    np.testing.assert_allclose(left, group.left_jacobian(xi), atol=1e-12)


@pytest.mark.parametrize(("group", "n"), [(SE2, 2), (SE3, 3)], ids=["SE2", "SE3"])
@given(vectors(20.0))
def test_moving_a_point_there_and_back(group, n, tangents):
    a, point = group.exp(tangents[0, : group.dim]), tangents[1, :n]
    back = group.inverse_transform(a, group.transform(a, point))
    np.testing.assert_allclose(back, point, rtol=0.0, atol=1e-12)
