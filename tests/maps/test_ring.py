"""Rings and shells of Gaussians: enough of them follow the curve, and fewer are refused."""

import numpy as np
import pytest

from rbpf import gaussian
from rbpf.errors import InputError
from rbpf.maps.point import ring, ring_components


def density(records, points):
    """Log-density (P,) of the first mixture."""
    nu = points[:, None] - records.mean[0, 0]
    cov = np.broadcast_to(records.cov[0, 0], (*nu.shape, nu.shape[-1]))
    return np.logaddexp.reduce(gaussian.log_density(nu, cov) + records.log_weights[0, 0], axis=1)


@pytest.mark.parametrize(("radius", "std"), [(8.0, 0.1), (20.0, 0.5), (1.0, 0.4)])
def test_a_ring_is_as_high_everywhere_and_no_wider_than_the_noise(radius, std):
    records = ring(np.array([[1.0, -2.0]]), np.array([radius]), std)
    angle = np.linspace(0.0, 2 * np.pi, 500)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    on = density(records, [1.0, -2.0] + radius * along)
    assert np.ptp(on) < 0.5, "it is flat along the ring"
    for off in (-2.5 * std, 2.5 * std):
        if radius + off > 0.2 * radius:
            assert (on - density(records, [1.0, -2.0] + (radius + off) * along)).min() > 1.0, "and falls across it"


def test_a_shell_is_as_high_everywhere():
    records = ring(np.zeros((1, 3)), np.array([3.0]), 0.3)
    assert records.mean.shape[2] == ring_components(3.0, 0.3, 3) == 40
    along = np.random.default_rng(0).standard_normal((400, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    on = density(records, 3.0 * along)
    assert np.ptp(on) < 1.0
    assert (on - density(records, 4.2 * along)).min() > 1.0
    np.testing.assert_allclose(np.linalg.norm(records.mean[0, 0], axis=1), 3.0)


def test_too_few_components_are_refused():
    centre, ranges = np.zeros((4, 2)), np.array([2.0, 8.0])
    needed = ring_components(8.0, 0.1)
    assert ring(centre, ranges, 0.1, needed).mean.shape == (4, 2, needed, 2)
    with pytest.raises(InputError, match=r"a range of 8 ± 0\.1 m needs 29 components, not 6: see ring_components"):
        ring(centre, ranges, 0.1, 6)
