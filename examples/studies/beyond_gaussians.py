"""`rbpf` compared with the package `particles` (N. Chopin) and with numerical integration: two standard models.

    python -m examples.studies.beyond_gaussians

Stochastic volatility, and the growth model (G. Kitagawa 1987), whose posterior has two modes. Both are bootstrap filters
of 1,000 particles, with systematic resampling if the effective sample size falls below half of them.
"""

import inspect
import time
import warnings
from collections.abc import Callable

import numpy as np

from examples.stochastic_volatility import BETA, PHI, SIGMA, LogVariance, Returns, exact, on_a_grid, simulate
from rbpf import Euclidean, Filter, LikelihoodSensor, MotionModel, PriorProposal, Transition

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # about escapes in its docstrings, at compilation
    import particles
    from particles import collectors, distributions, state_space_models

PARTICLES, SEEDS, STEPS = 1000, 20, 100


def grown(x: np.ndarray, t: int) -> np.ndarray:
    """Transition function of the growth model."""
    return x / 2 + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * t)


class Growth(MotionModel):
    """The control is the number of the step."""

    space = Euclidean(1)

    def transition(self, state, control, dt):
        return Transition(grown(state, control) if dt else state, np.full((1, 1, 1), np.sqrt(10.0) * dt))


class Squares(LikelihoodSensor):
    """z = x²/20 + v."""

    def log_likelihood(self, frame, state):
        return -0.5 * ((frame - state[:, 0] ** 2 / 20) ** 2 + np.log(2 * np.pi))


class TheirVolatility(state_space_models.StateSpaceModel):
    def PX0(self):  # noqa: N802 - the library's name
        return distributions.Normal(scale=SIGMA / np.sqrt(1 - PHI**2))

    def PX(self, t, xp):  # noqa: N802
        return distributions.Normal(loc=PHI * xp, scale=SIGMA)

    def PY(self, t, xp, x):  # noqa: N802
        return distributions.Normal(scale=BETA * np.exp(x / 2))


class TheirGrowth(state_space_models.StateSpaceModel):
    def PX0(self):  # noqa: N802
        return distributions.Normal(scale=np.sqrt(5.0))

    def PX(self, t, xp):  # noqa: N802
        return distributions.Normal(loc=grown(xp, t), scale=np.sqrt(10.0))

    def PY(self, t, xp, x):  # noqa: N802
        return distributions.Normal(loc=x**2 / 20)


def growth(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
    """Data (T,), with filtered means (T,) and log-evidence on a grid."""
    x, data = np.sqrt(5.0) * rng.standard_normal(), []
    for t in range(STEPS):
        x = grown(x, t) + np.sqrt(10.0) * rng.standard_normal() if t else x
        data.append(x**2 / 20 + rng.standard_normal())
    grid = np.linspace(-40.0, 40.0, 1201)
    log_p = Squares().log_likelihood
    moves = lambda t: np.exp(-np.square(grid - grown(grid, t)[:, None]) / 20)  # noqa: E731
    return np.array(data), *on_a_grid(grid, np.exp(-(grid**2) / 10), moves, log_p, np.array(data))


def ours(
    motion: MotionModel, sensor: LikelihoodSensor, std: float, data: np.ndarray, seed: int
) -> tuple[np.ndarray, float]:
    """Filtered means (T,) and log-evidence."""
    rng = np.random.default_rng(seed)
    start = std * rng.standard_normal((PARTICLES, 1))
    filter_ = Filter(motion, sensor, (), PriorProposal(), n=PARTICLES, rng=rng, start=start)
    means = [filter_.step(z, t).estimate.mean[0] for t, z in enumerate(data)]
    return np.array(means), filter_.log_evidence


def theirs(model: state_space_models.StateSpaceModel, data: np.ndarray, seed: int) -> tuple[np.ndarray, float]:
    """The same by `particles`."""
    np.random.seed(seed)  # noqa: NPY002 - the library draws from the global state
    bootstrap = state_space_models.Bootstrap(ssm=model, data=data)
    smc = particles.SMC(fk=bootstrap, N=PARTICLES, resampling="systematic", collect=[collectors.Moments()])
    smc.run()
    return np.array([one["mean"] for one in smc.summaries.moments]), float(smc.logLt)


def lines(*classes: type) -> int:
    """Number of lines of code and comments, without empty ones."""
    return sum(bool(line.strip()) for one in classes for line in inspect.getsource(one).splitlines())


def main() -> dict[str, float]:
    """Prints the table."""
    _, returns = simulate(np.random.default_rng(1))
    models: dict[str, tuple] = {
        "stochastic volatility": (
            LogVariance,
            Returns,
            SIGMA / np.sqrt(1 - PHI**2),
            TheirVolatility,
            returns,
            *exact(returns),
        ),
        "growth": (Growth, Squares, np.sqrt(5.0), TheirGrowth, *growth(np.random.default_rng(1))),
    }
    figures = {}
    print(
        "| model | filter | lines | off the exact mean (RMS) | log-evidence (exact) | ms per step |\n|---|---|---|---|---|---|"
    )
    for name, (motion, sensor, std, their, data, means, log_evidence) in models.items():
        runs: dict[str, tuple[int, Callable]] = {
            "rbpf": (lines(motion, sensor), lambda seed, a=motion, b=sensor, c=std, d=data: ours(a(), b(), c, d, seed)),
            "particles": (lines(their), lambda seed, a=their, d=data: theirs(a(), d, seed)),
        }
        for package, (count, run) in runs.items():
            run(0)
            begun = time.perf_counter()
            found = [run(seed) for seed in range(SEEDS)]
            ms = 1e3 * (time.perf_counter() - begun) / SEEDS / len(data)
            off = float(np.sqrt(np.mean([np.square(mean - means) for mean, _ in found])))
            logs = np.array([log for _, log in found])
            told = f"{logs.mean():.2f} ± {logs.std() / np.sqrt(SEEDS):.2f} ({log_evidence:.2f})"
            print(f"| {name} | {package} | {count} | {off:.3f} | {told} | {ms:.2f} |")
            figures |= {
                f"{name}, {package}: off": off,
                f"{name}, {package}: evidence": float(logs.mean()) - log_evidence,
            }
    return figures


if __name__ == "__main__":
    main()
