"""Landmarks of several components enter through w₂: evidence and posteriors against enumeration."""

from itertools import product

import numpy as np
import pytest
from scipy.linalg import block_diag

from rbpf.core.filter import Filter
from rbpf.core.models import Observations, Records
from rbpf.core.proposals import EkfProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.lie import Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import MixturePoint, Point
from tests.exactness.models import (
    SEEDS,
    Frame,
    Kalman,
    LinearMotion,
    Relative,
    Scripted,
    assert_unbiased,
    deviation,
    known,
)

pytestmark = pytest.mark.slow

PLANE = Euclidean(2)
R = np.array([[0.3, 0.05], [0.05, 0.25]])
Q = np.array([[0.2, 0.05], [0.05, 0.1]])
MEANS = np.array([[[3.0, 1.0], [3.8, 0.2]], [[-2.0, 4.0], [-1.5, 5.0]]])
"""Of two landmarks of two components; a third landmark is a point."""
COVS = np.array([[0.3 * np.eye(2), 0.5 * np.eye(2)], [[[0.4, 0.1], [0.1, 0.3]], [[0.2, 0.0], [0.0, 0.6]]]])
WEIGHTS = np.array([[0.7, 0.3], [0.4, 0.6]])
POINT_MEAN, POINT_COV = np.array([1.0, -3.0]), 0.4 * np.eye(2)
SEEN = [(0, 2), (0, 1, 2), (0, 1, 1)]
"""Landmarks seen in each step; in the third, one is seen twice."""


def add_landmarks(held: LandmarkMap, n: int) -> None:
    """The three landmarks, the same in n particles."""
    log_weights = np.log(np.tile(WEIGHTS, (n, 1, 1)))
    held.add_records(
        Records(np.tile(MEANS, (n, 1, 1, 1)), np.tile(COVS, (n, 1, 1, 1, 1)), None, log_weights), MixturePoint(2)
    )
    held.add_records(Records(np.tile(POINT_MEAN, (n, 1, 1)), np.tile(POINT_COV, (n, 1, 1, 1))), Point(2))


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    rng = np.random.default_rng(41)
    landmarks = np.array([[3.6, 0.4], [-1.7, 4.6], [1.3, -3.2]])
    position, out = np.zeros(2), []
    for seen in SEEN:
        position = position + rng.multivariate_normal(np.zeros(2), Q)
        z = landmarks[list(seen)] - position + rng.multivariate_normal(np.zeros(2), R, size=len(seen))
        out.append(Frame([Observations(z, np.tile(R, (len(seen), 1, 1)), Relative(), ids=np.array(seen))]))
    return out


def enumerate_components(frames: list[Frame], noise: np.ndarray) -> dict[tuple[int, ...], Kalman]:
    """A joint Kalman filter of position and three landmarks for each choice of components."""
    out = {}
    for choice in product(range(2), repeat=2):
        means = [MEANS[i, c] for i, c in enumerate(choice)]
        covs = [COVS[i, c] for i, c in enumerate(choice)]
        kalman = Kalman(
            np.concatenate([np.zeros(2), *means, POINT_MEAN]), block_diag(np.zeros((2, 2)), *covs, POINT_COV)
        )
        kalman.log_evidence = float(np.log(WEIGHTS[0, choice[0]] * WEIGHTS[1, choice[1]]))
        pick = np.eye(8)
        for frame in frames:
            kalman.predict(pick, block_diag(noise, np.zeros((6, 6))))
            for z, landmark in zip(frame.groups[0].z, known(frame.groups[0].ids), strict=True):
                kalman.update(z, pick[2 + 2 * landmark : 4 + 2 * landmark] - pick[:2], R)
        out[choice] = kalman
    return out


def build(proposal, resampler, n, noise_factor, rng) -> Filter:
    held = LandmarkMap(PLANE)
    filter_ = Filter(LinearMotion(np.eye(2), noise_factor), Scripted(), held, proposal, resampler, n, rng)
    add_landmarks(held, n)
    return filter_


def test_on_a_known_path_the_components_are_enumerated_exactly(frames):
    exact = enumerate_components(frames, np.zeros((2, 2)))
    total = np.logaddexp.reduce([kalman.log_evidence for kalman in exact.values()])
    filter_ = build(EkfProposal(), Systematic(), 3, np.zeros((2, 0)), np.random.default_rng(0))
    for frame in frames:
        filter_.step(frame)
    assert filter_.log_evidence == pytest.approx(total, abs=1e-9)
    records = filter_.belief().read([0, 1])
    assert records.log_weights is not None
    for choice, kalman in exact.items():
        joint = records.log_weights[0, 0, choice[0]] + records.log_weights[0, 1, choice[1]]
        assert joint == pytest.approx(kalman.log_evidence - total, abs=1e-9)
        for i, c in enumerate(choice):
            at = slice(2 + 2 * i, 4 + 2 * i)
            np.testing.assert_allclose(records.mean[:, i, c], np.tile(kalman.mean[at], (3, 1)), atol=1e-9)
            np.testing.assert_allclose(records.cov[:, i, c], np.tile(kalman.cov[at, at], (3, 1, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("proposal", "resampler"),
    [(EkfProposal(), EssTriggered(Systematic(), 0.8)), (EkfProposal(exact=False), Systematic())],
    ids=["ekf", "linearised"],
)
def test_evidence_and_component_weights_are_unbiased(frames, proposal, resampler, stream):
    """In a linear model E06's weight w₂ := p(late observations | x) is exact as well."""
    exact = enumerate_components(frames, Q)
    total = np.logaddexp.reduce([kalman.log_evidence for kalman in exact.values()])
    posterior = np.array([[sum(np.exp(k.log_evidence - total) for c, k in exact.items() if c[i] == 0)] for i in (0, 1)])
    log_ratio, components = [], []
    for seed in range(SEEDS):
        filter_ = build(proposal, resampler, 80, np.linalg.cholesky(Q), np.random.default_rng([stream, seed]))
        for frame in frames:
            filter_.step(frame)
        log_ratio.append(filter_.log_evidence - total)
        log_weights = known(filter_.belief().read([0, 1]).log_weights)
        first = filter_.particles.weights @ np.exp(log_weights[..., 0])
        components.append(np.exp(log_ratio[-1]) * (first - posterior[:, 0]))
    assert_unbiased(np.array(log_ratio))
    assert deviation(np.array(components), 0.0) <= 3.5
