"""The bootstrap filter of `rbpf` compared with `particles` and Stone Soup: the same model, N, data and resampling.

A random walk in the plane, x_t = x_{t−1} + w, w ~ N(0, Q), with measured distances from two beacons,
z = |x − b| + v, v ~ N(0, R). Systematic resampling at every step.
"""

from collections.abc import Callable
from datetime import datetime, timedelta
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.rows import Row, Settings, SkippedError, Timing, interleaved
from rbpf.core.filter import Filter
from rbpf.core.models import Belief, MotionModel, ObservationModel, Observations, Part, Sensor, Transition
from rbpf.core.proposals import PriorProposal
from rbpf.core.resampling import Systematic
from rbpf.lie import Euclidean

SIZES = (100, 1_000, 10_000, 100_000)
BEACONS = np.array([[0.0, -10.0], [10.0, 0.0]])
STD_WALK, STD_RANGE, STD_START = 0.3, 0.2, 1.0
STEPS = 40
EPOCH = datetime(2020, 1, 1)


def distances(points: np.ndarray) -> np.ndarray:
    """Distances of points (…, 2) from both beacons, (…, 2)."""
    return np.hypot(points[..., :1] - BEACONS[:, 0], points[..., 1:] - BEACONS[:, 1])


def simulate(rng: np.random.Generator, steps: int = STEPS) -> np.ndarray:
    """Measurements (T, 2)."""
    walk = STD_START * rng.normal(size=2) + np.cumsum(STD_WALK * rng.normal(size=(steps, 2)), axis=0)
    return distances(walk) + STD_RANGE * rng.normal(size=(steps, 2))


class Walk(MotionModel):
    """Random walk in the plane."""

    space = Euclidean(2)

    def transition(self, state: np.ndarray, control: Any, dt: float) -> Transition:
        return Transition(state, STD_WALK * np.eye(2)[None])


class Distances(ObservationModel):
    """Distances of the state from the beacons."""

    dim = 2
    reads = frozenset({Part.STATE})

    def predict(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> np.ndarray:
        return distances(state)


class Ranging(Sensor):
    """A frame is a measurement (2,)."""

    def observe(self, frame: np.ndarray, belief: Belief) -> list[Observations]:
        return [Observations(frame[None], STD_RANGE**2 * np.eye(2)[None], Distances())]


class OurRun:
    """`rbpf`."""

    def __init__(self, n: int, data: np.ndarray, seed: int, lag: int | None = 1) -> None:
        rng = np.random.default_rng(seed)
        start = STD_START * rng.normal(size=(n, 2))
        self.filter = Filter(Walk(), Ranging(), (), PriorProposal(), Systematic(), n, rng, start, lag=lag)
        self.frames = list(data)[::-1]

    def step(self) -> None:
        self.filter.step(self.frames.pop())

    def log_evidence(self) -> float:
        return self.filter.log_evidence

    def mean(self) -> np.ndarray:
        return self.filter.particles.weights @ self.filter.particles.state


class ParticlesRun:
    """`particles`, by N. Chopin."""

    def __init__(self, n: int, data: np.ndarray, seed: int) -> None:
        import particles
        from particles import distributions, state_space_models

        class Model(state_space_models.StateSpaceModel):
            def PX0(self) -> Any:  # noqa: N802 - the library's name
                return distributions.MvNormal(cov=(STD_START**2 + STD_WALK**2) * np.eye(2))

            def PX(self, t: int, xp: np.ndarray) -> Any:  # noqa: N802
                return distributions.MvNormal(loc=xp, cov=STD_WALK**2 * np.eye(2))

            def PY(self, t: int, xp: np.ndarray, x: np.ndarray) -> Any:  # noqa: N802
                return distributions.MvNormal(loc=distances(x), cov=STD_RANGE**2 * np.eye(2))

        np.random.seed(seed)  # noqa: NPY002 - the library draws from the global state
        model = state_space_models.Bootstrap(ssm=Model(), data=data)
        self.smc = particles.SMC(fk=model, N=n, resampling="systematic", ESSrmin=1.0, collect="off")

    def step(self) -> None:
        next(self.smc)

    def log_evidence(self) -> float:
        return float(self.smc.logLt)

    def mean(self) -> np.ndarray:
        return np.average(self.smc.X, axis=0, weights=self.smc.W)


class StoneSoupRun:
    """Stone Soup, which gives no evidence."""

    def __init__(self, n: int, data: np.ndarray, seed: int) -> None:
        from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
        from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, RandomWalk
        from stonesoup.predictor.particle import ParticlePredictor
        from stonesoup.resampler.particle import SystematicResampler
        from stonesoup.types.array import StateVectors
        from stonesoup.types.state import ParticleState
        from stonesoup.updater.particle import ParticleUpdater

        class Model(NonLinearGaussianMeasurement):
            @property
            def ndim_meas(self) -> int:
                return 2

            def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
                return StateVectors(distances(np.asarray(state.state_vector).T).T)

        np.random.seed(seed)  # noqa: NPY002 - the library draws from the global state
        walk = CombinedLinearGaussianTransitionModel([RandomWalk(STD_WALK**2)] * 2)
        model = Model(ndim_state=2, mapping=(0, 1), noise_covar=STD_RANGE**2 * np.eye(2))
        self.predictor = ParticlePredictor(walk)
        self.updater = ParticleUpdater(model, SystematicResampler())
        start = STD_START * np.random.default_rng(seed).normal(size=(2, n))
        weight = np.full(n, -np.log(n))
        self.state: Any = ParticleState(StateVectors(start), timestamp=EPOCH, log_weight=weight)
        self.frames = list(enumerate(data, start=1))[::-1]

    def step(self) -> None:
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis

        t, z = self.frames.pop()
        now = EPOCH + timedelta(seconds=t)
        prediction = self.predictor.predict(self.state, timestamp=now)
        self.state = self.updater.update(SingleHypothesis(prediction, Detection(z[:, None], timestamp=now)))
        self.state.parent = None

    def mean(self) -> np.ndarray:
        return np.asarray(self.state.mean).ravel().astype(float)


PEERS: dict[str, Callable[..., Any]] = {"particles": ParticlesRun, "stonesoup": StoneSoupRun}


def run(settings: Settings) -> list[Row]:
    """Time per step of each filter at each N, and the agreement of their estimates."""
    present = {name: kind for name, kind in PEERS.items() if find_spec(name) is not None}
    if not present:
        raise SkippedError("neither particles nor stonesoup is installed")
    data = simulate(np.random.default_rng(0))
    agreement = evidence_agreement(data, settings.repetitions(30)) if "particles" in present else "no peer's evidence"
    return [row for n in SIZES for row in figures(n, data, present, settings, agreement)]


def evidence_agreement(data: np.ndarray, runs: int, n: int = 1_000) -> str:
    """Mean log-evidence of `rbpf` and of `particles` over some seeds."""
    logs = np.array([[evidence(kind, n, data, seed) for seed in range(runs)] for kind in (OurRun, ParticlesRun)])
    error = np.sqrt(logs.var(axis=1, ddof=1).sum() / runs)
    gap = logs[0].mean() - logs[1].mean()
    if abs(gap) > 4.0 * error:
        raise RuntimeError(f"log-evidence differs from that of particles by {gap:.3f} ± {error:.3f}")
    ours, theirs = logs[0].mean(), logs[1].mean()
    return f"log-evidence at N={n}: {ours:.3f}, particles {theirs:.3f}, ± {error:.3f} on the difference"


def evidence(kind: Callable[..., Any], n: int, data: np.ndarray, seed: int) -> float:
    run_ = kind(n, data, seed)
    for _ in data:
        run_.step()
    return run_.log_evidence()


def figures(
    n: int, data: np.ndarray, present: dict[str, Callable[..., Any]], settings: Settings, agreement: str
) -> list[Row]:
    """One row per peer."""
    seconds: dict[str, list[float]] = {}
    for seed in range(settings.repetitions(6)):
        contestants = {name: kind(n, data, seed) for name, kind in {"rbpf": OurRun, **present}.items()}
        times = interleaved({name: c.step for name, c in contestants.items()}, len(data) - 2)
        for name, timing in times.items():
            seconds.setdefault(name, []).extend(timing.seconds)
    medians = {name: Timing(np.array(values)).median * 1e3 for name, values in seconds.items()}
    means = {name: c.mean() for name, c in contestants.items()}
    return [row(n, name, medians, means, agreement) for name in present]


def row(n: int, name: str, medians: dict[str, float], means: dict[str, np.ndarray], agreement: str) -> Row:
    apart = float(np.linalg.norm(means["rbpf"] - means[name]))
    return Row(
        f"bootstrap N={n} vs {name}",
        medians["rbpf"],
        "ms",
        name,
        medians[name],
        medians[name] / medians["rbpf"],
        notes=f"last posterior means {apart:.3f} m apart (measured to {STD_RANGE} m); {agreement}",
        tolerance=0.5,
        optional=True,
    )
