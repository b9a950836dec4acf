"""The evidence is unbiased, whatever the proposal, resampler and trigger: of linear models, of curved ones, and on SE(2)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest

from rbpf.core import models as base
from rbpf.core.filter import Filter
from rbpf.core.likelihoods import GaussianWithOutliers
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Residual, Stratified, Systematic
from rbpf.lie import SE2, Euclidean
from rbpf.motion.odometry import Odometry, OdometryMotion
from tests.exactness.models import (
    SEEDS,
    Curved,
    Frame,
    Kalman,
    LinearMotion,
    LinearObservation,
    Scripted,
    assert_unbiased,
    deviation,
    log_ratios,
    single,
)

pytestmark = pytest.mark.slow

PROPOSALS = {"prior": PriorProposal(), "ekf": EkfProposal(), "iterated": EkfProposal(iterations=3)}
SCHEDULES: dict[str, base.Resampler] = {
    "always": Stratified(),
    "triggered": EssTriggered(Residual(), 0.5),
    "never": EssTriggered(Systematic(), 0.0),
}
"""That each scheme is unbiased by itself is tested in `tests/core/test_resampling.py`."""
every_schedule = pytest.mark.parametrize("schedule", SCHEDULES)


@dataclass(frozen=True)
class World:
    """A linear-Gaussian model with measurements drawn from it, and their exact log-evidence."""

    motion: LinearMotion
    frames: list[Frame]
    marginalised: Callable[[], list[base.Conditional]]
    log_evidence: float

    def build(self, proposal: str, schedule: str, rng: np.random.Generator) -> Filter:
        parts, resampler = self.marginalised(), SCHEDULES[schedule]
        return Filter(self.motion, Scripted(), parts, PROPOSALS[proposal], resampler, 80, rng)

    def log_ratios(self, proposal: str, schedule: str, stream: int, seeds: int = SEEDS) -> np.ndarray:
        return log_ratios(partial(self.build, proposal, schedule), self.frames, self.log_evidence, stream, seeds)


def simulate(
    motion: LinearMotion, model: LinearObservation, R: np.ndarray, kalman: Kalman, steps: int, seed: int
) -> list[Frame]:
    """Measurements of a draw from the model, told to a Kalman filter of the full state as well."""
    rng = np.random.default_rng(seed)
    F, Q, drift = motion.joint()
    H = model.joint_matrix(motion)
    truth = rng.multivariate_normal(kalman.mean, kalman.cov)
    frames = []
    for _ in range(steps):
        truth = F @ truth + drift + rng.multivariate_normal(np.zeros(len(truth)), Q)
        z = H @ truth + rng.multivariate_normal(np.zeros(len(R)), R)
        kalman.predict(F, Q, drift)
        kalman.update(z, H, R)
        frames.append(Frame([single(z, R, model)]))
    return frames


@pytest.fixture(scope="module")
def position_alone() -> World:
    """A sampled position and velocity; the position is measured."""
    motion = LinearMotion(np.array([[1.0, 1.0], [0.0, 1.0]]), np.diag([0.2, 0.8]))
    kalman = Kalman(np.zeros(2), np.zeros((2, 2)))
    frames = simulate(motion, LinearObservation([[1.0, 0.0]]), np.array([[0.25]]), kalman, steps=4, seed=2)
    return World(motion, frames, list, kalman.log_evidence)


@pytest.fixture(scope="module")
def driven_by_acceleration() -> World:
    return accelerated(0.4)


def accelerated(variance: float) -> World:
    """The same with a marginalised acceleration whose noise is correlated; it is measured too, with such a variance."""
    factor = np.array([[0.2, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.1, 0.2]])
    F, B, A = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]]), np.array([[0.9]])
    motion = LinearMotion(F, factor, B, A, np.array([0.1]))
    model = LinearObservation([[1.0, 0.0], [0.0, 0.0]], [[0.0], [0.5]])
    law = np.array([0.2]), np.array([[0.16]])
    kalman = Kalman(np.array([0.0, 0.0, 0.2]), np.diag([0.0, 0.0, 0.16]))
    frames = simulate(motion, model, np.diag([0.4, variance]), kalman, steps=4, seed=1)
    return World(motion, frames, lambda: [KalmanSubstate(motion.space, *law)], kalman.log_evidence)


@pytest.mark.parametrize(("proposal", "schedule"), [("prior", "always"), ("ekf", "triggered"), ("prior", "never")])
def test_evidence_of_linear_models_is_unbiased(position_alone, driven_by_acceleration, proposal, schedule, stream):
    """Of a state alone, and with a Kalman substate by the other proposal."""
    assert_unbiased(position_alone.log_ratios(proposal, schedule, stream))
    other = "ekf" if proposal == "prior" else "prior"
    assert_unbiased(driven_by_acceleration.log_ratios(other, schedule, stream))


@every_schedule
def test_in_a_linear_model_iterating_changes_nothing(position_alone, driven_by_acceleration, schedule, stream):
    for world in (position_alone, driven_by_acceleration):
        once, often = (world.log_ratios(proposal, schedule, stream, 4) for proposal in ("ekf", "iterated"))
        np.testing.assert_allclose(often, once, atol=1e-9)


@pytest.mark.parametrize("proposal", ["prior", "ekf"])
def test_the_trigger_resamples_now_and_then(position_alone, driven_by_acceleration, proposal):
    """Else the tests above would not tell it from always or never."""
    for world in (position_alone, driven_by_acceleration):
        filters = [world.build(proposal, "triggered", np.random.default_rng(seed)) for seed in range(20)]
        reports = [[filter_.step(frame).resampled for frame in world.frames] for filter_ in filters]
        assert 0.1 < np.mean(reports) < 0.9


def test_marginalising_and_refining_lower_the_spread():
    """All are unbiased; of as many particles, what is marginalised and what the proposal looks at lower the spread."""
    world = accelerated(0.005)
    marginalised, refined = (world.log_ratios(name, "always", 0, 100) for name in ("prior", "ekf"))
    F, Q, drift = world.motion.joint()
    motion, model = LinearMotion(F, np.linalg.cholesky(Q)), LinearObservation([[1.0, 0.0, 0.0], [0.0, 0.0, 0.5]])

    def all_sampled(seed: int) -> float:
        rng = np.random.default_rng(seed)
        start = rng.multivariate_normal([0.0, 0.0, 0.2], np.diag([0.0, 0.0, 0.16]), size=80)
        filter_ = Filter(motion, Scripted(), (), PriorProposal(), SCHEDULES["always"], 80, rng, start)
        for frame in world.frames:
            filter_.step(Frame([replace(frame.groups[0], model=model)]), drift)
        return filter_.log_evidence - world.log_evidence

    sampled = np.array([all_sampled(seed) for seed in range(100)])
    assert refined.std() < 0.8 * marginalised.std()
    assert marginalised.std() < 0.8 * sampled.std()


# The exact ratio keeps the evidence of nonlinear sampled models unbiased; the linearised weight does not.

Function = Callable[[np.ndarray], np.ndarray]


class Moving(base.MotionModel):
    """x' = f(x) + w on the line."""

    def __init__(self, f: Function, std: float):
        self.f, self.std = f, std
        self.space = Euclidean(1)

    def transition(self, state, control, dt):
        return base.Transition(self.f(state), np.full((1, 1, 1), self.std))


@dataclass(frozen=True)
class Scalar:
    """A model on the line, five measurements drawn from it, and their log-evidence on a grid."""

    f: Function
    std: float
    h: Function
    variance: float
    start: float
    likelihood: base.Likelihood | None = None

    def measurements(self, seed: int, outlier: float = 0.0) -> np.ndarray:
        rng = np.random.default_rng(seed)
        x, z = np.array(self.start), []
        for step in range(5):
            x = self.f(x) + self.std * rng.normal()
            z.append(self.h(x) + np.sqrt(self.variance) * rng.normal() + outlier * (step == 2))
        return np.array(z)

    def log_evidence(self, zs: np.ndarray, points: int = 3001) -> float:
        x, dx = np.linspace(-15.0, 15.0, points, retstep=True)
        forward = _normal(x - self.f(x)[:, None], self.std**2) * dx
        density, total = _normal(x - self.f(np.array(self.start)), self.std**2), 0.0
        for step, z in enumerate(zs):
            density = density @ forward if step else density
            density = density * self._density(z - self.h(x))
            mass = density.sum() * dx
            density, total = density / mass, total + float(np.log(mass))
        return total

    def log_ratios(self, zs: np.ndarray, proposal: base.Proposal, stream: int, seeds: int) -> np.ndarray:
        model, cov = Curved(self.h), np.array([[self.variance]])
        frames = [Frame([single(z, cov, model, likelihood=self.likelihood)]) for z in zs]

        def build(rng: np.random.Generator) -> Filter:
            trigger, start = EssTriggered(Systematic()), np.array([self.start])
            return Filter(Moving(self.f, self.std), Scripted(), (), proposal, trigger, 100, rng, start)

        return log_ratios(build, frames, self.log_evidence(zs), stream, seeds)

    def _density(self, nu: np.ndarray) -> np.ndarray:
        inlier = _normal(nu, self.variance)
        if self.likelihood is None:
            return inlier
        log_inlier, log_outlier = self.likelihood.params
        return np.exp(log_inlier) * inlier + np.exp(log_outlier)


def _normal(x: np.ndarray, variance: float) -> np.ndarray:
    return np.exp(-0.5 * x * x / variance) / np.sqrt(2.0 * np.pi * variance)


WORLDS = {
    "square": Scalar(lambda x: 0.8 * x + 1.5 * np.sin(x) + 0.3, 0.8, lambda x: x * x / 5.0, 0.5, 1.0),
    "arctan": Scalar(lambda x: 0.9 * x + 0.3 * np.cos(x), 0.8, lambda x: 2.0 * np.arctan(x), 1.5, 0.5),
}
every_world = pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)


@every_world
def test_the_grid_is_fine_enough(world):
    zs = world.measurements(2)
    assert world.log_evidence(zs) == pytest.approx(world.log_evidence(zs, 1001), abs=1e-9)


@pytest.mark.parametrize(
    ("name", "proposal"), [("arctan", "prior"), ("square", "ekf"), ("arctan", "ekf"), ("square", "iterated")]
)
def test_evidence_is_unbiased(name, proposal, stream):
    world = WORLDS[name]
    assert_unbiased(world.log_ratios(world.measurements(2), PROPOSALS[proposal], stream, 200))


@pytest.mark.parametrize(("name", "iterations"), [("square", 1), ("arctan", 3)])
def test_the_linearised_weight_is_biased(name, iterations, stream):
    """E06's w₂ := 1 fails the same test by far."""
    world = WORLDS[name]
    proposal = EkfProposal(exact=False, iterations=iterations)
    log_ratio = world.log_ratios(world.measurements(2), proposal, stream, 200)
    assert log_ratio.std() <= 0.5
    assert deviation(np.exp(log_ratio), 1.0) > 5.0 + 10.0 * (iterations == 1)


@pytest.mark.parametrize("proposal", ["prior", "ekf"])
def test_evidence_with_outliers_is_unbiased(proposal, stream):
    """The gate decides who moves the proposal, the density of both decides the weight."""
    world = Scalar(lambda x: 0.9 * x, 0.6, lambda x: x, 0.6, 0.5, GaussianWithOutliers(0.1, 20.0))
    zs = world.measurements(4, outlier=5.0)
    assert_unbiased(world.log_ratios(zs, PROPOSALS[proposal], stream, 200))


# On SE(2) proposal and prior are densities in one chart: evidence against quadrature and many particles.

R = np.array([[0.3, 0.1], [0.1, 0.2]])
COV = np.array([[0.25, 0.08, 0.05], [0.08, 0.3, 0.0], [0.05, 0.0, 0.1]])
ON_POSES = PROPOSALS | {"begun elsewhere": EkfProposal(iterations=2, start=np.array([0.3, -0.2, 0.1]))}
LEVER = np.array([1.5, 0.5])
START = np.array([0.4, 1.0, -2.0])
DELTA = np.array([0.5, 1.2, 0.1])
FIX = np.array([3.2, 0.6])


class Antenna(base.ObservationModel):
    """The position of an antenna away from the robot's origin; a substate is its drift."""

    dim = 2

    def __init__(self, drifting: bool = False):
        self.reads = frozenset({base.Part.STATE, base.Part.SUBSTATE}) if drifting else frozenset({base.Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        world = SE2.transform(state, LEVER)
        return world if substate is None else world + 0.5 * substate


class Turning(base.MotionModel):
    """x' = x Exp(B s + w₁), s' = A s + w₂: turn rate and speed are marginalised."""

    space = SE2
    B = np.array([[1.0, 0.0], [0.0, 1.0], [0.2, 0.1]])
    A = np.array([[0.9, 0.1], [0.0, 0.8]])
    L = np.vstack([np.linalg.cholesky(COV), 0.2 * np.ones((2, 3))])

    def transition(self, state, control, dt):
        return base.Transition(state, self.L[None], self.B[None], self.A[None], np.zeros((1, 2)))


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


@pytest.mark.parametrize("proposal", ON_POSES.values(), ids=ON_POSES)
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
