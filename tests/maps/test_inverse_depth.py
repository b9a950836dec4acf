"""Landmarks of unknown distance: inverse depth on rays and its promotion, and rings and shells of Gaussians."""

import numpy as np
import pytest

from rbpf import gaussian
from rbpf.core.models import Records
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.point import ring, ring_components

LANDMARK = InverseDepth()
ANCHOR = SE3.exp(np.array([0.4, -0.8, 1.2, 2.0, -1.0, 0.5]))
B = np.array([0.3, -0.2, 0.5])


def scattered(n: int, k: int, std_q: float, seed: int = 0) -> Records:
    """Rays of n particles with an anchor each; u, v and q are correlated."""
    rng = np.random.default_rng(seed)
    mean = B + rng.normal(scale=[0.1, 0.1, 0.05], size=(n, k, 3))
    half = rng.normal(size=(n, k, 3, 4)) * np.array([0.01, 0.01, std_q])[:, None] / 2.0
    const = SE3.retract(ANCHOR, rng.normal(scale=0.3, size=(n, k, 6)))
    return Records(mean, half @ np.swapaxes(half, -1, -2), const)


def euclidean(mean: np.ndarray, const: np.ndarray) -> np.ndarray:
    """The point (u, v, 1)/q in the anchor's frame, told in the world."""
    ray = np.concatenate([mean[..., :2], np.ones((*mean.shape[:-1], 1))], axis=-1)
    return SE3.transform(const, ray / mean[..., 2:])


def test_homogeneous_is_the_point_and_at_infinity_the_direction():
    records = scattered(4, 3, 0.01)
    world = LANDMARK.homogeneous(records.mean, records.const)
    np.testing.assert_array_equal(world[..., 3], records.mean[..., 2])
    np.testing.assert_allclose(world[..., :3] / world[..., 3:], euclidean(records.mean, records.const), atol=1e-12)
    direction = LANDMARK.homogeneous(np.array([0.3, -0.2, 0.0]), ANCHOR)
    np.testing.assert_allclose(direction, [*SE3.rotation(ANCHOR) @ [0.3, -0.2, 1.0], 0.0], atol=1e-15)


@pytest.mark.parametrize(
    ("q", "std", "expected"),
    [(0.5, 0.049, True), (0.5, 0.051, False), (0.0, 0.0, False), (-0.5, 0.001, False), (1e-3, 1e-3, False)],
)
def test_ready(q, std, expected):
    mean = np.tile(np.array([0.3, -0.2, q]), (2, 1, 1))
    cov = np.tile(np.diag([1.0, 1.0, std**2]), (2, 1, 1, 1))
    ready = LANDMARK.ready(Records(mean, cov, np.tile(ANCHOR, (2, 1, 1))))
    assert ready.tolist() == [[expected], [expected]]


@pytest.mark.parametrize("ratio", [0.0, -1.0, np.nan])
def test_bad_ratio(ratio):
    with pytest.raises(InputError, match=r"ready_ratio must be above 0"):
        InverseDepth(ratio)


@pytest.mark.parametrize("fraction", [0.02, 0.05, 0.1])
def test_promotion_is_the_law_of_the_point(fraction):
    """Against samples; transforming the mean alone would miss the bias E[1/q] − 1/E[q] ≈ σ²/q³ (E06 §5.1)."""
    std, n = fraction * B[2], 400_000
    cov = np.diag([0.004, 0.003, std]) ** 2
    cov[0, 2] = cov[2, 0] = 0.5 * 0.004 * std
    records = Records(B[None, None], cov[None, None], ANCHOR[None, None])
    found = LANDMARK.promote(records)
    assert found.const is None
    rng = np.random.default_rng(2)
    normal = rng.standard_normal((n, 3)) @ np.linalg.cholesky(cov).T
    points = euclidean(B + np.concatenate([normal, -normal]), ANCHOR)
    mean, error = points.mean(axis=0), 3.0 * fraction**3 / B[2]
    np.testing.assert_allclose(found.mean[0, 0], mean, atol=error + 4.0 * fraction**2 / np.sqrt(n))
    expected = np.cov(points.T)
    np.testing.assert_allclose(found.cov[0, 0], expected, atol=expected.max() * (8.0 * fraction**2 + 0.01))
    naive = np.linalg.norm(euclidean(B, ANCHOR) - mean)
    np.testing.assert_allclose(naive, np.sqrt(1.0 + B[0] ** 2 + B[1] ** 2) * fraction**2 / B[2], rtol=0.15)
    assert np.linalg.norm(found.mean[0, 0] - mean) < 0.1 * naive


@pytest.mark.parametrize("q", [-0.3, 0.0, 0.02, 0.4])
def test_a_particle_that_is_not_ready_keeps_its_line_of_sight(q):
    """Its point lies ahead where it was seen, as uncertain along the ray as far away at most: the particle can live on."""
    std = 0.2
    cov = np.diag([1e-3, 1e-3, std]) ** 2
    found = LANDMARK.promote(Records(np.array([[[0.3, -0.2, q]]]), cov[None, None], ANCHOR[None, None]))
    point = SE3.inverse_transform(ANCHOR, found.mean[0, 0])
    np.testing.assert_allclose(point, np.array([0.3, -0.2, 1.0]) / max(q, std), rtol=1e-6)
    turned = SE3.rotation(ANCHOR).T @ found.cov[0, 0] @ SE3.rotation(ANCHOR)
    np.testing.assert_allclose(np.sqrt(turned[2, 2]), std / max(q, std) ** 2, rtol=1e-4)


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
