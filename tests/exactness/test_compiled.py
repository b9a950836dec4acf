"""The compiled path equals plain NumPy: four kernels, masks, likelihoods, both passes, measurements in any order."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.likelihoods import Gaussian, GaussianWithOutliers, TruncatedMahalanobis
from rbpf.core.linearisation import linearise
from rbpf.core.models import NEW, NULL, Observations
from rbpf.core.proposals import refined
from rbpf.kernels import signature
from rbpf.kernels.signature import BLOCK
from rbpf.lie import SE2, SE3
from rbpf.maps import rows
from tests.exactness.models import known
from tests.exactness.scenes import Scene, sensors

TOLERANCE = 1e-9
PARTICLES = BLOCK + 45  #: More than one block of the kernels, and not a multiple of it.
every_sensor = pytest.mark.parametrize(
    ("space", "which"), [(space, which) for space in (SE2, SE3) for which in (0, 1)], ids=str
)
every_likelihood = pytest.mark.parametrize(
    "likelihood",
    [Gaussian(), TruncatedMahalanobis(4.0), TruncatedMahalanobis(4.0, 9.0), GaussianWithOutliers(0.05, 300.0)],
    ids=lambda x: type(x).__name__,
)


def with_outliers(group: Observations) -> Observations:
    """The second measurement far off, the third at the edge of the gate."""
    return replace(group, z=group.z + np.array([0.0, 0.9, 0.25, 0.0, 0.0])[:, None])


def associations(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Of five measurements: the same in all particles; disjoint sightings; clutter and new_landmarks in some."""
    same = np.array([3, 0, 2, 5, 1])
    if kind == "shared":
        return same
    ids = np.tile(same, (PARTICLES, 1))
    swapped = rng.random(PARTICLES) < 0.5
    ids[swapped, 0], ids[swapped, 1] = 0, 3
    ids[rng.random(PARTICLES) < 0.3, 2] = NULL
    ids[rng.random(PARTICLES) < 0.3, 3] = NEW
    return ids


@pytest.mark.parametrize("kind", ["shared", "per particle"])
@every_likelihood
@every_sensor
def test_refinement_and_update(space, which, likelihood, kind, rng):
    scene = Scene.random(space, rng, n=PARTICLES, k=6)
    model = sensors(space, rng)[which]
    costs = {"log_new": -3.0, "log_clutter": -5.0}
    group = with_outliers(scene.observe(model, associations(kind, rng), likelihood=likelihood, **costs))
    prior = scene.prior(space.dim, shared=kind == "shared")
    maps = [scene.map(compiled) for compiled in (True, False, True)]
    if kind == "shared":  # one block reads rows that lie apart, one those of its neighbours
        for held in maps:
            held.store.lineage.advance(ancestors := np.roll(np.arange(PARTICLES), 2))
            held.resample(ancestors)
    another = maps.pop()

    for each in (group, replace(group, likelihood=likelihood.of_look_ahead())):
        one, other = (refined(prior, held.information(scene.state, [each], prior)) for held in maps)
        for name in ("mean", "root", "log_w1", "nis"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=TOLERANCE, atol=TOLERANCE)
        np.testing.assert_array_equal(one.rows, other.rows)

    zero = np.zeros((PARTICLES, space.dim))
    one_density, other_density = (held.correct(scene.state, zero, [group]) for held in maps)
    np.testing.assert_allclose(one_density.all, other_density.all, rtol=TOLERANCE, atol=TOLERANCE)
    order = rng.permutation(5)
    shuffled = replace(group, z=group.z[order], cov=group.cov[order], ids=known(group.ids)[..., order])
    in_order = another.correct(scene.state, zero, [shuffled])
    np.testing.assert_allclose(in_order.all, one_density.all, rtol=TOLERANCE, atol=TOLERANCE)
    one_map, other_map = (held.read(held.ids) for held in maps)
    np.testing.assert_allclose(one_map.mean, other_map.mean, rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(one_map.cov, other_map.cov, rtol=TOLERANCE, atol=TOLERANCE)
    assert np.abs(one_map.mean - scene.records.mean).max() > 0.01
    if not isinstance(likelihood, Gaussian):
        inlier = likelihood.inlier(*_innovations(scene, group))
        assert 0.05 < inlier.mean() < 0.95


@pytest.mark.parametrize("kind", ["shared", "per particle"])
@every_sensor
def test_particles_taken_in_parts_are_those_taken_together(space, which, kind, rng, monkeypatch):
    """In NumPy, and where a model without a kernel hands its rows to the compiled drivers, on one thread and on several."""
    scene = Scene.random(space, rng, n=PARTICLES, k=6)
    group = with_outliers(
        scene.observe(sensors(space, rng)[which], associations(kind, rng), likelihood=GaussianWithOutliers(0.05, 300.0))
    )
    monkeypatch.setattr(type(group.model), "kernel", lambda _: None)
    prior = scene.prior(space.dim, shared=kind == "shared")
    found = []
    for pairs, compiled in ((10**9, False), (64, False), (10**9, True), (64, True)):
        monkeypatch.setattr(rows, "PAIRS_AT_ONCE", pairs)
        monkeypatch.setattr(signature, "PAIRS_PER_THREAD", pairs // 64)
        held = scene.map(compiled)
        terms = held.information(scene.state, [group], prior)
        densities = held.correct(scene.state, np.zeros((PARTICLES, space.dim)), [group])
        records = held.read(held.ids)
        outliers = terms.log_factor - 0.5 * terms.log_det
        found.append((terms.info, outliers, terms.rows, densities.all, records.mean, records.cov))
    for together, in_parts, *by_kernels in zip(*found, strict=True):
        np.testing.assert_allclose(in_parts, together, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(by_kernels, np.array([together] * 2), rtol=1e-11, atol=1e-11)


def _innovations(scene: Scene, group: Observations) -> tuple[np.ndarray, np.ndarray]:
    ids = np.abs(np.atleast_2d(known(group.ids))[0])
    state, mean = scene.state[:, None], scene.records.mean[:, ids]
    jac = known(linearise(group.model, scene.space, group.z, state, mean)[1].landmark)
    cov = jac @ scene.records.cov[:, ids] @ np.swapaxes(jac, -1, -2) + group.cov
    return group.model.residual(group.z, group.model.predict(state, mean)), cov
