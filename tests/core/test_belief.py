"""What a sensor is told before it measures, against Monte Carlo over the whole mixture."""

from itertools import product

import numpy as np
import pytest

from rbpf.core.genealogy import Lineage
from rbpf.core.marginals import KalmanSubstate, Marginals
from rbpf.core.models import Belief, Part, Records
from rbpf.core.particles import Prior
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, LieGroup, SE2Group, SE3Group
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import AnchoredPoint, MixturePoint, Point, ring
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition

N, K, DRAWS = 12, 3, 100_000
STD = 0.01


def prior_of(space: LieGroup, rng: np.random.Generator, centred: bool, scale: float = STD) -> Prior:
    """Bases around the origin; the factor has one column too few: singular, as in a plane."""
    base = space.retract(space.identity((N,)), 0.02 * rng.normal(size=(N, space.dim)))
    mean = np.zeros((1, space.dim)) if centred else 0.5 * rng.normal(size=(1, space.dim))
    factor = scale * rng.normal(size=(N, space.dim, space.dim - 1))
    return Prior(space, base, mean, factor, centred)


def belief_of(prior: Prior, dim: int, rng: np.random.Generator, ahead: np.ndarray) -> tuple[Belief, Records]:
    """Landmarks around points `ahead` (K, D) of the robot, different in every particle."""
    assert isinstance(prior.space, SE2Group | SE3Group)
    landmark_map = LandmarkMap(prior.space)
    marginals = Marginals(prior.space, [landmark_map])
    marginals.begin(N, Lineage(N))
    world = prior.space.transform(prior.predicted()[0], ahead)
    factor = STD * rng.normal(size=(N, K, dim, dim))
    mean = world + 0.02 * rng.normal(size=(N, K, dim))
    records = Records(mean, factor @ np.swapaxes(factor, -1, -2))
    landmark_map.add_records(records, Point(dim))
    return Belief(np.log(rng.dirichlet(np.ones(N))), prior, marginals.parts), records


def draw(belief: Belief, records: Records, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """States (DRAWS, E) and landmarks (DRAWS, K, D) of the mixture."""
    prior = belief.prior
    i = rng.choice(N, size=DRAWS, p=belief.weights)
    noise = rng.normal(size=(DRAWS, prior.factor.shape[2]))
    increment = prior.mean + np.einsum("nar,nr->na", prior.factor[i], noise)
    chol = np.linalg.cholesky(records.cov)[i]
    landmark = records.mean[i] + np.einsum("nkab,nkb->nka", chol, rng.normal(size=(DRAWS, K, chol.shape[-1])))
    return prior.space.retract(prior.base[i], increment), landmark


# In the second one the bearings lie on both sides of the cut.
AHEAD_2D = {"ahead": [[3.0, 1.0], [2.0, -2.0], [4.0, 0.0]], "behind": [[-3.0, 0.0], [-2.0, 0.01], [-4.0, -0.01]]}
AHEAD_3D = np.array([[3.0, 1.0, 0.5], [2.0, -2.0, -1.0], [4.0, 0.0, 0.3]])


@pytest.mark.parametrize("centred", [True, False], ids=["centred", "driven"])
@pytest.mark.parametrize(
    ("kind", "ahead"), [*product((RangeBearing, RelativePosition), AHEAD_2D.values()), (RangeBearing, AHEAD_3D)]
)
def test_projections_are_those_of_draws(kind, ahead, centred, rng):
    space, dim = (SE2, 2) if len(ahead[0]) == 2 else (SE3, 3)
    model, (belief, records) = kind(space), belief_of(prior_of(space, rng, centred), dim, rng, np.array(ahead))
    mean, cov = belief.project(model, np.arange(K))
    state, landmark = draw(belief, records, rng)
    offset = model.residual(model.predict(state[:, None], landmark), mean)
    expected = np.einsum("nka,nkb->kab", offset, offset) / DRAWS
    std = np.sqrt(np.einsum("kaa->ka", expected))
    # The linearisation errs by about the variance over the distance; Monte Carlo by 1/√DRAWS.
    assert (np.abs(offset.mean(axis=0)) < 0.03 * std).all()
    scale = std[:, :, None] * std[:, None, :]
    assert (np.abs(cov - expected) < 0.02 * scale).all()


def test_innovations_of_every_pair(rng):
    belief, records = belief_of(prior_of(SE2, rng, centred=True), 2, rng, np.array(AHEAD_2D["behind"]))
    model = RangeBearing(SE2)
    z = np.array([[3.0, 3.1], [2.0, -3.1]])
    noise = np.stack([np.diag([0.1, 0.2]), np.diag([0.3, 0.4])])
    nu, cov = belief.predictions(model, z, noise, np.array([2, 0]))
    assert nu.shape == (N, 2, 2, 2) and cov.shape == (N, 2, 2, 2, 2)
    for i, k, m in np.ndindex(N, 2, 2):
        landmark = records.mean[i, (2, 0)[m]]
        expected = model.residual(z[k], model.predict(belief.state[i], landmark))
        np.testing.assert_allclose(nu[i, k, m], expected, atol=1e-12)
        by_state, by_landmark, _ = (np.asarray(block) for block in model.jacobians(belief.state[i], landmark))
        moved = by_state @ belief.prior.factor[i]
        within = by_landmark @ records.cov[i, (2, 0)[m]] @ by_landmark.T
        np.testing.assert_allclose(cov[i, k, m], within + moved @ moved.T + noise[k], atol=1e-12)


def test_moments_are_those_of_draws_whatever_is_named(rng):
    """A point, a ring of Gaussians, a point in an anchor's frame, and a substate."""
    landmark_map, substate = LandmarkMap(SE2), KalmanSubstate(SE2, np.zeros(2), np.diag([1.0, 4.0]))
    marginals = Marginals(SE2, [landmark_map, substate])
    marginals.begin(N, Lineage(N))
    places, within = rng.normal(size=(N, 1, 2)), np.tile(0.25 * np.eye(2), (N, 1, 1, 1))
    anchors = np.concatenate([rng.normal(size=(N, 1, 1)), places], axis=-1)
    circle = ring(places[:, 0], np.array([2.0]), 0.3, 9)
    landmark_map.add_records(Records(places, within), Point(2))
    landmark_map.add_records(circle, MixturePoint(9))
    landmark_map.add_records(Records(np.ones((N, 1, 2)), within, anchors), AnchoredPoint(SE2))
    substate.mean = rng.normal(size=(N, 2))
    log_weights = np.log(rng.dirichlet(np.ones(N)))
    belief = Belief(log_weights, Prior.exactly(SE2, SE2.identity((N,))), marginals.parts)

    i, noise, of = rng.choice(N, DRAWS, p=np.exp(log_weights)), rng.normal(size=(DRAWS, 2)), rng.choice(9, DRAWS)
    spread = np.linalg.cholesky(circle.cov[i, 0, of])
    drawn = {
        2: SE2.transform(anchors[i, 0], 1.0 + 0.5 * noise),
        0: places[i, 0] + 0.5 * noise,
        1: circle.mean[i, 0, of] + np.einsum("nab,nb->na", spread, noise),
        Part.SUBSTATE: substate.mean[i] + noise * [1.0, 2.0],
    }
    found = zip(*belief.moments([2, 0, 1]), strict=True)
    for (mean, cov), draws in zip([*found, belief.moments(Part.SUBSTATE)], drawn.values(), strict=True):
        scale = np.trace(np.cov(draws.T))
        np.testing.assert_allclose(mean, draws.mean(axis=0), atol=0.02 * np.sqrt(scale))
        np.testing.assert_allclose(cov, np.cov(draws.T), atol=0.02 * scale)
    np.testing.assert_array_equal(belief.moments(Part.LANDMARK)[0], belief.moments([0, 1, 2])[0])
    np.testing.assert_allclose(belief.moments(Part.STATE)[1], np.zeros((3, 3)), atol=1e-15)
    for wrong, sentence in (([7], "no landmark 7"), (Part("beacons"), "does not hold a beacons")):
        with pytest.raises(InputError, match=sentence):
            belief.moments(wrong)
