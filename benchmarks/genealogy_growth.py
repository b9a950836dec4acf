"""Size of the genealogy by steps and particles; theory: T + C·N log N (P. Jacob et al., 2015). Cost of retained paths."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.bootstrap_peers import OurRun, simulate
from benchmarks.rows import Row, Settings
from rbpf.core.genealogy import Lineage
from rbpf.core.particles import effective_sample_size
from rbpf.core.resampling import Systematic

PARTICLES = (50, 100, 200, 500, 1000, 2000)
STEPS = 2_000
SPREAD = 0.6
FIGURES = Path(__file__).parent / "out"


@dataclass(frozen=True)
class Curve:
    """Nodes (T,) and generations (T,) after every step, and the mean variance of N W at resampling.

    In systematic resampling descendants are adjacent, so that the rounding of their numbers cancels within a family:
    family sizes vary only by the variance of the weights.
    """

    n: int
    nodes: np.ndarray
    generations: np.ndarray
    variance: float

    @property
    def extra(self) -> float:
        """Nodes beyond one per generation, on average over the second half."""
        half = self.nodes.size // 2
        return float((self.nodes - self.generations)[half:].mean())

    @property
    def expected(self) -> float:
        """Σ_i (i − 1) t_i, with t_i = 2N/(σ² i (i − 1)) generations of i lineages (J. Kingman, 1982)."""
        return 2.0 * self.n / self.variance * float((1.0 / np.arange(2, self.n + 1)).sum())


def grow(n: int, steps: int, threshold: float, rng: np.random.Generator) -> Curve:
    """A lineage all of whose generations are retained."""
    lineage = Lineage(n)
    lineage.retain(0)
    log_weights = np.zeros(n)
    nodes, generations, variances = np.zeros(steps), np.zeros(steps), []
    for t in range(steps):
        log_weights += SPREAD * rng.normal(size=n)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        if effective_sample_size(weights) < threshold * n:
            ancestors = Systematic().ancestors(weights, rng)
            lineage.advance(ancestors)
            lineage.retain(lineage.generation)
            variances.append(float((n * weights).var()))
            log_weights[:] = 0.0
        nodes[t], generations[t] = lineage.nodes, lineage.generation
    return Curve(n, nodes, generations, float(np.mean(variances)))


def run(settings: Settings) -> list[Row]:
    """Growth with resampling at every step, and by the effective sample size."""
    steps = STEPS // 4 if settings.quick else STEPS
    rng = np.random.default_rng(0)
    curves = {
        label: {n: grow(n, steps, threshold, rng) for n in PARTICLES}
        for label, threshold in (("always", np.inf), ("ESS < N/2", 0.5))
    }
    plot(curves, steps)
    return [*(row(label, by_n, steps) for label, by_n in curves.items()), history()]


def history() -> Row:
    """Whole paths against a lag of one step: 100,000 particles, resampled at every step, the last 20 of 100 steps."""
    milliseconds = []
    for lag in (1, None):
        contestant, seconds = OurRun(100_000, simulate(np.random.default_rng(0), 100), 0, lag), []
        for _ in range(100):
            started = time.perf_counter()
            contestant.step()
            seconds.append(time.perf_counter() - started)
        milliseconds.append(1e3 * float(np.median(seconds[-20:])))
    short, whole = milliseconds
    return Row(
        "history kept, N=100000",
        whole,
        "ms per step",
        "a lag of one step",
        short,
        whole / short,
        higher=False,
        tolerance=0.6,
    )


def row(label: str, curves: dict[int, Curve], steps: int) -> Row:
    """The particle number with the largest genealogy relative to theory."""
    ratios = {n: curve.extra / curve.expected for n, curve in curves.items()}
    n = max(ratios, key=lambda size: ratios[size])
    constants = {size: curve.extra / (size * np.log(size)) for size, curve in curves.items()}
    largest = curves[PARTICLES[-1]]
    return Row(
        f"genealogy nodes, {label}",
        curves[n].extra,
        f"nodes - T, N={n}",
        "coalescent theory",
        curves[n].expected,
        ratios[n],
        higher=False,
        notes=(
            f"{steps} steps, one resampling in {steps / largest.generations[-1]:.1f}; N={largest.n}: "
            f"{largest.nodes[-1]:.0f} nodes of {largest.n * largest.generations[-1]:.0f} made; C by N: "
            + ", ".join(f"{size}: {value:.2f}" for size, value in constants.items())
        ),
        tolerance=0.3,
    )


def plot(curves: dict[str, dict[int, Curve]], steps: int) -> None:
    """Plots nodes by steps and by particles, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    FIGURES.mkdir(exist_ok=True)
    at = np.arange(1, steps + 1)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for axis, (label, by_n) in zip(axes, curves.items(), strict=True):
        for n, curve in by_n.items():
            axis.loglog(at, curve.nodes, label=f"N = {n}")
        axis.loglog(at, at, "k--", linewidth=0.8, label="T")
        axis.set(xlabel="steps T", title=f"resampled {label}")
    axes[0].set_ylabel("nodes")
    axes[1].legend(fontsize=7)
    figure.savefig(FIGURES / "genealogy_steps.png", dpi=90)
    plt.close(figure)

    figure, axis = plt.subplots(figsize=(4.8, 3.6), layout="constrained")
    sizes = np.array(PARTICLES)
    for label, by_n in curves.items():
        extra = np.array([curve.extra for curve in by_n.values()])
        constant = float(np.median(extra / (sizes * np.log(sizes))))
        (line,) = axis.loglog(sizes, extra, "o", label=f"resampled {label}, T = {steps}")
        theory = constant * sizes * np.log(sizes)
        axis.loglog(sizes, theory, "--", color=line.get_color(), label=f"{constant:.2f} N log N")
    axis.set(xlabel="particles N", ylabel="nodes less one per resampling")
    axis.legend(fontsize=7)
    figure.savefig(FIGURES / "genealogy_particles.png", dpi=90)
    plt.close(figure)
