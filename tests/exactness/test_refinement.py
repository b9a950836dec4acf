"""The refinement equals EKF updates of pose and landmarks with fixed linearisation, in any order."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from rbpf.core.linearisation import linearise
from rbpf.core.marginals import Marginals
from rbpf.core.models import NEW, NULL, Observations
from rbpf.core.particles import Prior, Proposed
from rbpf.core.proposals import EkfProposal, refined
from rbpf.lie import SE2, SE3
from tests.exactness.models import Kalman, known
from tests.exactness.scenes import Scene, sensors

TOLERANCE = 1e-9
every_space = pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
compiled_or_not = pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "numpy"])
every_rank = pytest.mark.parametrize("rank", [0, 1, 2, 3, 6])


def rows_of(scene: Scene, groups: list[Observations], particle: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """ν, [H J] over (pose, all landmarks) and R of each measurement that a particle takes as known."""
    d, (_, k, dim) = scene.space.dim, scene.records.mean.shape
    rows = []
    for group in groups:
        ids = np.broadcast_to(known(group.ids), (scene.n, len(group.z)))[particle]
        for z, cov, landmark in zip(group.z, group.cov, ids, strict=True):
            if landmark < 0:
                continue
            mean = scene.records.mean[particle, landmark]
            nu, jac = linearise(group.model, scene.space, z, scene.state[particle], mean)
            matrix = np.zeros((len(z), d + k * dim))
            matrix[:, :d] = jac.state
            matrix[:, d + dim * landmark : d + dim * (landmark + 1)] = jac.landmark
            rows.append((nu, matrix, cov))
    return rows


def sequential(scene: Scene, groups: list[Observations], prior: Prior, rng: np.random.Generator) -> list[Kalman]:
    """One EKF per particle over (increment, all landmarks), told the rows in random order."""
    kalmans = []
    for i in range(scene.n):
        factor = prior.factor[min(i, len(prior.factor) - 1)]
        cov = block_diag(factor @ factor.T, *scene.records.cov[i])
        kalman = Kalman(np.zeros(len(cov)), cov)
        rows = rows_of(scene, groups, i)
        for j in rng.permutation(len(rows)):
            kalman.update(*rows[j])
        kalmans.append(kalman)
    return kalmans


def assert_equal(prior: Prior, proposed: Proposed, kalmans: list[Kalman], log_factor: np.ndarray | float = 0.0) -> None:
    d = prior.space.dim
    mean = np.einsum("nar,nr->na", prior.factor, proposed.mean)
    root = prior.factor @ proposed.root
    np.testing.assert_allclose(mean, [kalman.mean[:d] for kalman in kalmans], atol=TOLERANCE)
    cov = root @ np.swapaxes(root, -1, -2)
    np.testing.assert_allclose(cov, [kalman.cov[:d, :d] for kalman in kalmans], atol=TOLERANCE)
    log_w1 = np.array([kalman.log_evidence for kalman in kalmans]) + log_factor
    np.testing.assert_allclose(proposed.log_w1, log_w1, rtol=TOLERANCE, atol=TOLERANCE)


@every_rank
@compiled_or_not
@every_space
@pytest.mark.parametrize("shared", [True, False], ids=["one noise", "noise per particle"])
def test_refinement_equals_sequential_updates(space, compiled, rank, shared, rng):
    scene = Scene.random(space, rng)
    prior = scene.prior(rank, shared)
    for model in sensors(space, rng):
        groups = [scene.observe(model, np.array([2, 0, 3]))]
        proposed = refined(prior, scene.map(compiled).information(scene.state, groups, prior))
        assert_equal(prior, proposed, sequential(scene, groups, prior, rng))


def test_nothing_is_linearised_any_more_once_that_moves_nothing(rng):
    scene = Scene.random(SE3, rng)
    prior, group, asked = scene.prior(6, shared=True), [scene.observe(sensors(SE3, rng)[0], np.array([2, 0, 3]))], []
    linearise_at = Marginals(SE3, [scene.map(True)]).linearised(prior, group)

    def linearised(increment):
        asked.append(increment)
        return linearise_at(increment)

    counts = []
    for settled in (0.0, 1e-9, 1e-3, 1e9):
        asked.clear()
        found = EkfProposal(iterations=12, settled=settled).propose(prior, linearised, rng)
        counts.append(len(asked))
        if settled == 0.0:
            last = found.mean
        elif settled < 1.0:
            np.testing.assert_allclose(found.mean, last, atol=settled)
    assert counts[0] == 12 and counts[-1] == 2 and counts == sorted(counts, reverse=True) and counts[1] > counts[2] > 2


@compiled_or_not
@every_space
def test_a_landmark_seen_by_two_sensors_is_handled_and_updated_jointly(space, compiled, rng):
    """Landmark 1 by both sensors, landmark 2 twice by one of them, landmark 3 by the other alone."""
    scene = Scene.random(space, rng)
    prior = scene.prior(2, shared=True)
    first, second = sensors(space, rng)
    groups = [scene.observe(first, np.array([1, 2, 0, 2])), scene.observe(second, np.array([3, 1]))]
    proposed = refined(prior, scene.map(compiled).information(scene.state, groups, prior))
    assert_equal(prior, proposed, sequential(scene, groups, prior, rng))

    apart = [refined(prior, scene.map(compiled).information(scene.state, [group], prior)).log_w1 for group in groups]
    assert (np.abs(proposed.log_w1 - sum(apart)) > 1e-3).all()

    # Updated, stacked rows equal sequential conditioning at the sampled state, and so does their density.
    held = scene.map(compiled)
    densities = held.correct(scene.state, np.zeros((scene.n, space.dim)), groups)
    kalmans = sequential(scene, groups, Prior.exactly(space, scene.state), rng)
    d, dim = space.dim, scene.records.mean.shape[-1]
    records = held.read(held.ids)
    np.testing.assert_allclose(densities.all, [kalman.log_evidence for kalman in kalmans], atol=TOLERANCE)
    np.testing.assert_array_equal(densities.after_sampling, 0.0)
    for i, kalman in enumerate(kalmans):
        moved = records.mean[i] - scene.records.mean[i]
        np.testing.assert_allclose(moved.ravel(), kalman.mean[d:], atol=TOLERANCE)
        for k, cov in enumerate(records.cov[i]):
            at = slice(d + dim * k, d + dim * (k + 1))
            np.testing.assert_allclose(cov, kalman.cov[at, at], atol=TOLERANCE)


@compiled_or_not
@every_space
def test_each_particle_uses_its_own_associations(space, compiled, rng):
    """Some particles see one landmark twice; clutter and first sightings cost their densities."""
    scene = Scene.random(space, rng)
    prior = scene.prior(3, shared=False)
    ids = np.array([[0, 1, 2], [1, 0, NULL], [NEW, 1, 1], [NULL, NEW, 3], [0, 0, 0], [3, 2, 1]])
    costs = {"log_new": -2.5, "log_clutter": -4.0}
    model = sensors(space, rng)[0]
    groups = [scene.observe(model, ids, **costs)]
    log_factor = -2.5 * (ids == NEW).sum(axis=1) - 4.0 * (ids == NULL).sum(axis=1)
    proposed = refined(prior, scene.map(compiled).information(scene.state, groups, prior))
    assert_equal(prior, proposed, sequential(scene, groups, prior, rng), log_factor)

    densities = scene.map(compiled).correct(scene.state, np.zeros((scene.n, space.dim)), groups)
    expected = [kalman.log_evidence for kalman in sequential(scene, groups, Prior.exactly(space, scene.state), rng)]
    np.testing.assert_allclose(densities.all, np.array(expected) + log_factor, atol=TOLERANCE)


@every_space
def test_terms_linearised_elsewhere_stay_in_the_priors_chart(space, rng):
    """At any increment ε₀: ν = z − g(ε₀) + G (ε₀ − μ), with g the measurement by the chart's coordinates."""
    scene = Scene.random(space, rng, n=3)
    d, model = space.dim, sensors(space, rng)[0]
    group = scene.observe(model, np.array([0, 2]))
    prior = Prior(space, scene.state, rng.normal(scale=0.2, size=(3, d)), scene.prior(d, False).factor, centred=False)
    at = prior.mean + rng.normal(scale=0.2, size=(3, d))
    marginals = Marginals(space, [scene.map()])
    for increment in (prior.mean, at):
        proposed = refined(prior, marginals.linearised(prior, [group])(increment))
        kalmans = [
            _chart_ekf(scene, group, prior.factor[i], scene.state[i], prior.mean[i], increment[i], i) for i in range(3)
        ]
        mean = np.einsum("nar,nr->na", prior.factor, proposed.mean)
        np.testing.assert_allclose(mean, [kalman.mean[:d] for kalman in kalmans], atol=1e-6)
        np.testing.assert_allclose(proposed.log_w1, [kalman.log_evidence for kalman in kalmans], atol=1e-5)


def _chart_ekf(scene, group, factor, base, mean, at, particle) -> Kalman:
    """Linearised by central differences of the chart's coordinates."""
    d, model, records = scene.space.dim, group.model, scene.records
    kalman = Kalman(np.zeros(d), factor @ factor.T)
    for z, R, landmark in zip(group.z, group.cov, group.ids, strict=True):
        point = records.mean[particle, landmark]
        steps = 1e-6 * np.eye(d)
        plus, minus = (model.predict(scene.space.retract(base, at + sign * steps), point) for sign in (1, -1))
        G = model.residual(plus, minus).T / 2e-6
        nu, jac = linearise(model, scene.space, z, scene.space.retract(base, at), point)
        slope = known(jac.landmark)
        spread = slope @ records.cov[particle, landmark] @ slope.T
        kalman.update(nu + G @ (at - mean), G, R + spread)
    return kalman
