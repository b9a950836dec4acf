"""Draws from the batch's posterior: exact in linear worlds, and beside integrals by other means in small curved ones."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

from examples.studies.joint_ekf import joint_ekf
from rbpf.lie import SE2
from rbpf.runs.recordings import filter_opened, open_robot_log
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.gtsam import path_sampling
from rbpf.validation.gtsam.path_sampling import draw_posterior
from rbpf.validation.gtsam.robot import solve
from tests.validation.worlds import linear_log, seen, world


def drawn(m, draws=400, seed=0):
    found = solve(m, marginals=False)
    start = InitialEstimate(found.world_from_body, found.landmarks)
    return draw_posterior(m, start, np.random.default_rng(seed), draws)


def log_normal(e, cov):
    """Log-density of Gaussian errors (…, n)."""
    return -0.5 * ((e @ np.linalg.inv(cov) * e).sum(-1) + np.linalg.slogdet(2 * np.pi * cov)[1])


@pytest.fixture(scope="module")
def linear():
    """Positions measured by a robot whose heading has no noise at all."""
    done = filter_opened(open_robot_log(linear_log(), RangeBearingConfig(particles=2)))
    m = done.system.measurements("linear", done.log)
    covs = m.covs.copy()
    covs[:, 0] = covs[:, :, 0] = 0.0
    return replace(m, covs=covs)


def test_in_a_linear_world_all_draws_count_the_same_and_the_evidence_is_the_kalman_filters(linear):
    found = drawn(linear)
    assert np.ptp(found.log_ratio) < 1e-9
    assert found.ess == pytest.approx(400) and found.error < 1e-10
    assert found.log_evidence == pytest.approx(joint_ekf(linear).log_evidence, abs=1e-6)


def test_in_a_linear_world_the_draws_have_the_moments_of_the_posterior(linear):
    found, batch = drawn(linear, 20_000), solve(linear)
    assert (found.world_from_robot[..., 0] == 0.0).all()
    moves = found.world_from_robot - batch.world_from_body
    for t in (1, 6, 11):
        np.testing.assert_allclose(moves[:, t].mean(0), 0.0, atol=0.03 * np.sqrt(batch.cov_poses[t, 1, 1]))
        np.testing.assert_allclose(np.cov(moves[:, t, 1:].T), batch.cov_poses[t, 1:, 1:], rtol=0.05, atol=2e-4)
    for i, name in enumerate(found.names.tolist()):
        np.testing.assert_allclose(np.cov(found.landmarks[:, i].T), batch.cov_landmarks[name], rtol=0.05, atol=2e-4)


def two_views(dim, kind, bound=False):
    """Two poses and one landmark that both see, with noise so large that the posterior is not Gaussian."""
    m, d = world(dim, kind, bound, steps=2), 3 if dim == 2 else 6
    path = np.stack([m.start, m.space.compose(m.start, m.deltas[0])])
    z = m.model().predict(path, m.space.transform(m.start, np.array([2.0, 1.5, 0.5][:dim])))
    cov = np.zeros((d, d))
    cov[0, 0], cov[-2, -2] = 0.0 if bound else 0.15**2, 0.25**2
    cov[np.diag_indices(d)] += 0.0 if bound else 0.05**2
    noise = np.diag([0.2, 0.15, 0.1][:dim]) ** 2 if kind == "range_bearing" else 0.2**2 * np.eye(dim)
    m = seen(m, np.array([0, 1]), np.array([7, 7]), z, np.stack([noise, noise]))
    return replace(m, covs=cov[None])


def test_a_small_curved_world_has_the_evidence_and_the_mean_of_quadrature():
    m = two_views(2, "range_bearing", bound=True)
    m = replace(m, z=m.z + np.array([[0.0, 0.0], [0.3, -0.6]]), cov_z=4.0 * m.cov_z, covs=4.0 * m.covs)
    model, r = m.model(), m.z[0, 0]
    # The one direction of the motion's noise, and the landmark in the coordinates of its first sighting, on a grid.
    grid = np.linspace(-6.0, 6.0, 81)
    u, a, b = (x.ravel() for x in np.meshgrid(grid, grid, grid, indexing="ij"))
    pose = SE2.retract(SE2.compose(m.start, m.deltas[0]), np.sqrt(m.covs[0, 1, 1]) * u[:, None] * [0.0, 1.0, 0.0])
    first = m.z[0] + np.stack([a, b], axis=-1) * np.sqrt(np.diagonal(m.cov_z[0]))
    point = model.invert(m.start, first)
    each = -0.5 * (u**2 + a**2 + b**2) + np.log(first[:, 0] / r)
    each += log_normal(model.residual(m.z[1], model.predict(pose, point)), m.cov_z[1])
    expected = logsumexp(each) + 3 * np.log((grid[1] - grid[0]) / np.sqrt(2 * np.pi))
    found = drawn(m, 20_000)
    assert found.error < 0.01
    assert found.log_evidence == pytest.approx(expected, abs=4 * found.error)
    assert found.log_ratio.std() > 0.1  # the Gaussian alone would not do
    weights = np.exp(each - logsumexp(each))
    np.testing.assert_allclose(found.weights @ found.landmarks[:, 0], weights @ point, atol=0.02)
    np.testing.assert_allclose(found.weights @ found.world_from_robot[:, 1], weights @ pose, atol=0.02)


@pytest.mark.parametrize("bent", [0.0, np.inf])
@pytest.mark.parametrize(("dim", "kind"), [(2, "range_bearing"), (3, "range_bearing"), (3, "position")])
def test_whichever_way_a_pose_is_drawn_the_evidence_is_that_of_draws_from_the_prior(dim, kind, bent, monkeypatch):
    monkeypatch.setattr(path_sampling, "BENT", bent)
    m, rng, size = two_views(dim, kind), np.random.default_rng(1), 200_000
    model = m.model()
    noise = rng.multivariate_normal(np.zeros(m.space.dim), m.covs[0], size)
    pose = m.space.retract(m.space.compose(m.start, m.deltas[0]), noise)
    first = rng.multivariate_normal(m.z[0], m.cov_z[0], size)
    weight = np.ones(size) if kind == "position" else first[:, 0] ** (dim - 1)
    if kind == "range_bearing" and dim == 3:
        weight *= np.cos(first[:, 2])
    residual = model.residual(m.z[1], model.predict(pose, model.invert(m.start, first)))
    ratio = weight / weight.mean() * np.exp(log_normal(residual, m.cov_z[1]))
    error = ratio.std() / ratio.mean() / np.sqrt(size)
    found = drawn(m, 10_000)
    assert np.hypot(found.error, error) < 0.03
    assert found.log_evidence == pytest.approx(np.log(ratio.mean()), abs=4 * np.hypot(found.error, error))
