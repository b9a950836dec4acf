"""On SE(2) proposal and prior are densities in one chart: evidence against quadrature and many particles."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import MotionModel, ObservationModel, Part, Transition
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import Systematic
from rbpf.lie import SE2
from rbpf.motion.odometry import Odometry, OdometryMotion
from tests.exactness.models import SEEDS, Frame, Scripted, assert_unbiased, single

pytestmark = pytest.mark.slow

R = np.array([[0.3, 0.1], [0.1, 0.2]])
COV = np.array([[0.25, 0.08, 0.05], [0.08, 0.3, 0.0], [0.05, 0.0, 0.1]])
PROPOSALS = {
    "prior": PriorProposal(),
    "ekf": EkfProposal(),
    "iterated": EkfProposal(iterations=3),
    "begun elsewhere": EkfProposal(iterations=2, start=np.array([0.3, -0.2, 0.1])),
}
every_proposal = pytest.mark.parametrize("proposal", PROPOSALS.values(), ids=PROPOSALS)
LEVER = np.array([1.5, 0.5])
START = np.array([0.4, 1.0, -2.0])
DELTA = np.array([0.5, 1.2, 0.1])
FIX = np.array([3.2, 0.6])


class Antenna(ObservationModel):
    """The position of an antenna away from the robot's origin; a substate is its drift."""

    dim = 2

    def __init__(self, drifting: bool = False):
        self.reads = frozenset({Part.STATE, Part.SUBSTATE}) if drifting else frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        world = SE2.transform(state, LEVER)
        return world if substate is None else world + 0.5 * substate


class Turning(MotionModel):
    """x' = x Exp(B s + w₁), s' = A s + w₂: turn rate and speed are marginalised."""

    space = SE2
    B = np.array([[1.0, 0.0], [0.0, 1.0], [0.2, 0.1]])
    A = np.array([[0.9, 0.1], [0.0, 0.8]])
    L = np.vstack([np.linalg.cholesky(COV), 0.2 * np.ones((2, 3))])

    def transition(self, state, control, dt):
        return Transition(state, self.L[None], self.B[None], self.A[None], np.zeros((1, 2)))


def positions(state: np.ndarray) -> np.ndarray:
    """Of the antenna, written out."""
    theta, x, y = np.moveaxis(state, -1, 0)
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([x + c * LEVER[0] - s * LEVER[1], y + s * LEVER[0] + c * LEVER[1]], axis=-1)


def moved(state: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """x Exp(ξ), written out: the chord of an arc."""
    omega, u, v = np.moveaxis(xi, -1, 0)
    a, b = np.sin(omega) / omega, (1.0 - np.cos(omega)) / omega
    forward, left = a * u - b * v, b * u + a * v
    c, s = np.cos(state[..., 0]), np.sin(state[..., 0])
    return np.stack(
        [state[..., 0] + omega, state[..., 1] + c * forward - s * left, state[..., 2] + s * forward + c * left], axis=-1
    )


def density(nu: np.ndarray, cov: np.ndarray) -> np.ndarray:
    squared = np.einsum("...a,ab,...b->...", nu, np.linalg.inv(cov), nu)
    return np.exp(-0.5 * squared) / np.sqrt(np.linalg.det(2.0 * np.pi * cov))


def hermite(mean: np.ndarray, cov: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, n) and weights (M,) of Gauss-Hermite quadrature under N(mean, cov)."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)
    n = mean.size
    points = np.stack(np.meshgrid(*[nodes] * n, indexing="ij"), axis=-1).reshape(-1, n)
    product = np.prod(np.stack(np.meshgrid(*[weights] * n, indexing="ij"), axis=-1), axis=-1).ravel()
    return mean + points @ np.linalg.cholesky(cov).T, product / product.sum()


def one_step(motion, control, z, model, proposal, stream, substate=None) -> np.ndarray:
    """Log-evidence of one frame, per seed."""

    def run(seed: int) -> float:
        parts = () if substate is None else KalmanSubstate(SE2, *substate)
        rng = np.random.default_rng([stream, seed])
        filter_ = Filter(motion, Scripted(), parts, proposal, Systematic(), 100, rng, START)
        return filter_.step(Frame([single(z, R, model)]), control).log_evidence

    return np.array([run(seed) for seed in range(SEEDS)])


@pytest.fixture(scope="module")
def after_one_step() -> float:
    """Exact log-evidence of one fix after one odometry increment."""
    predicted = SE2.compose(START, DELTA)
    exact = [
        float(np.log(weights @ density(FIX - positions(moved(predicted, xi)), R)))
        for xi, weights in (hermite(np.zeros(3), COV, order) for order in (32, 40))
    ]
    assert exact[0] == pytest.approx(exact[1], abs=5e-5)
    return exact[1]


@every_proposal
def test_one_step_against_quadrature(after_one_step, proposal, stream):
    log_evidence = one_step(OdometryMotion(SE2), Odometry(DELTA, COV), FIX, Antenna(), proposal, stream)
    assert_unbiased(log_evidence - after_one_step)
    assert log_evidence.std() / np.sqrt(SEEDS) < 0.01


@pytest.mark.parametrize("drifting", [False, True], ids=["state only", "reads the substate"])
def test_one_step_driven_by_a_substate_against_quadrature(drifting, stream):
    """The chart stands at the transition's mean, away from where the increment is expected."""
    z, mean, cov = np.array([2.5, 0.3]), np.array([0.5, 0.8]), np.diag([0.1, 0.3])
    stack, noise = np.vstack([Turning.B, Turning.A]), Turning.L @ Turning.L.T
    joint = stack @ cov @ stack.T + noise
    gain = joint[3:, :3] @ np.linalg.inv(joint[:3, :3])
    xi, weights = hermite(Turning.B @ mean, joint[:3, :3], 32)
    later = Turning.A @ mean + (xi - Turning.B @ mean) @ gain.T
    rest = joint[3:, 3:] - gain @ joint[:3, 3:]
    expected, spread = (0.5 * later, R + 0.25 * rest) if drifting else (0.0, R)
    exact = float(np.log(weights @ density(z - positions(moved(START, xi)) - expected, spread)))
    proposal = EkfProposal(iterations=3 if drifting else 1)
    log_evidence = one_step(Turning(), None, z, Antenna(drifting), proposal, stream, (mean, cov))
    assert_unbiased(log_evidence - exact)
    assert log_evidence.std() / np.sqrt(SEEDS) < 0.005
