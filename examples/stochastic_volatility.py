"""Likelihoods of any form: stochastic volatility, without a Gaussian observation, compared with numerical integration.

The log-variance x of a price's daily returns y is autoregressive, and y = β exp(x / 2) ε: the measurement is noise
whose variance depends on the state. It cannot be linearised, so particles are weighed by the log-likelihood itself.
"""

from collections.abc import Callable

import numpy as np

from rbpf import Euclidean, Filter, LikelihoodSensor, MotionModel, Transition

PHI, SIGMA, BETA = 0.97, 0.2, 0.01  # per day; BETA is the typical return
DAYS, PARTICLES = 300, 1000


class LogVariance(MotionModel):
    """x' = φ x + σ w."""

    space = Euclidean(1)

    def transition(self, state, control, dt):
        return Transition(PHI**dt * state, np.full((1, 1, 1), SIGMA * dt))


class Returns(LikelihoodSensor):
    """A frame is one return y ~ N(0, β² exp x)."""

    def log_likelihood(self, frame, state):
        variance = BETA**2 * np.exp(state[:, 0])
        return -0.5 * (frame**2 / variance + np.log(2 * np.pi * variance))


def simulate(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Log-variances and returns (T,); the first is drawn from the stationary distribution."""
    x = [SIGMA / np.sqrt(1 - PHI**2) * rng.standard_normal()]
    for _ in range(DAYS - 1):
        x.append(PHI * x[-1] + SIGMA * rng.standard_normal())
    return np.array(x), BETA * np.exp(np.array(x) / 2) * rng.standard_normal(DAYS)


def on_a_grid(
    grid: np.ndarray, start: np.ndarray, moves: Callable, log_p: Callable, data: np.ndarray
) -> tuple[np.ndarray, float]:
    """Filtered means (T,) and log-evidence by numerical integration (G. Kitagawa 1987).

    On points `grid` (G,) of prior density `start` (G,), with transition densities moves(t) (G, G) and log_p(z, x) (G,).
    """
    p, means, log_evidence = start / start.sum(), [], 0.0
    for t, z in enumerate(data):
        if t:
            chances = moves(t)
            p = p @ (chances / chances.sum(axis=1, keepdims=True))
        p = p * np.exp(log_p(z, grid[:, None]))
        log_evidence += np.log(p.sum())
        p = p / p.sum()
        means.append(p @ grid)
    return np.array(means), float(log_evidence)


def exact(returns: np.ndarray) -> tuple[np.ndarray, float]:
    """`on_a_grid` for this model."""
    grid = np.linspace(-6.0, 6.0, 1201)
    moves = np.exp(-0.5 * np.square((grid - PHI * grid[:, None]) / SIGMA))
    start = np.exp(-0.5 * np.square(grid) * (1 - PHI**2) / SIGMA**2)
    return on_a_grid(grid, start, lambda t: moves, Returns().log_likelihood, returns)


def main() -> dict[str, float]:
    """Prints the filtered log-variance and the evidence, and those on the grid."""
    truth, returns = simulate(np.random.default_rng(1))
    rng = np.random.default_rng(0)
    start = SIGMA / np.sqrt(1 - PHI**2) * rng.standard_normal((PARTICLES, 1))
    filter_ = Filter(LogVariance(), Returns(), n=PARTICLES, rng=rng, start=start)
    means = np.array([filter_.step(y).estimate.mean[0] for y in returns])
    means_on_grid, log_evidence = exact(returns)
    off = float(np.sqrt(np.square(means - means_on_grid).mean()))
    print(f"log-variance: {np.std(truth - means):.2f} from the truth, {off:.3f} from the exact mean (RMS)")
    print(f"log-evidence: {filter_.log_evidence:.2f}, exact {log_evidence:.2f}")
    return {"off_exact": off, "evidence": filter_.log_evidence - log_evidence, "error": float(np.std(truth - means))}


if __name__ == "__main__":
    main()
