"""Nodes of the genealogy against steps and particles; theory: T + C·N log N (P. Jacob et al., 2015)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, Settings
from rbpf.genealogy import Lineage
from rbpf.particles import effective_sample_size
from rbpf.resampling import Systematic

PARTICLES = (50, 100, 200, 500, 1000, 2000)
STEPS = 2_000
SAMPLES = 80
SPREAD = 0.6
FIGURES = Path(__file__).parent / "out"


@dataclass(frozen=True)
class Curve:
    """Nodes (S,) after `steps` (S,), how often it resampled, and the mean variance of the number of descendants."""

    steps: np.ndarray
    nodes: np.ndarray
    resamplings: int
    variance: float

    @property
    def extra(self) -> int:
        """Nodes beyond one per generation."""
        return int(self.nodes[-1]) - self.resamplings


def grow(n: int, steps: int, threshold: float, rng: np.random.Generator) -> Curve:
    """A lineage all of whose generations are retained."""
    lineage = Lineage(n)
    lineage.retain(0)
    log_weights = np.zeros(n)
    at, nodes, variances = np.unique(np.geomspace(1, steps, SAMPLES).astype(int)), [], []
    for t in range(1, steps + 1):
        log_weights += SPREAD * rng.normal(size=n)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        if effective_sample_size(weights) < threshold * n:
            ancestors = Systematic().ancestors(weights, rng)
            lineage.advance(ancestors)
            lineage.retain(lineage.generation)
            variances.append(np.bincount(ancestors, minlength=n).var())
            log_weights[:] = 0.0
        if t in at:
            nodes.append(lineage.nodes)
    return Curve(at, np.array(nodes), len(variances), float(np.mean(variances)))


def run(settings: Settings) -> list[Row]:
    """Growth when every step resamples and when the effective sample size asks for it."""
    steps = STEPS // 4 if settings.quick else STEPS
    rng = np.random.default_rng(0)
    curves = {
        label: {n: grow(n, steps, threshold, rng) for n in PARTICLES}
        for label, threshold in (("always", np.inf), ("ESS < N/2", 0.5))
    }
    plot(curves, steps)
    return [row(label, by_n, steps) for label, by_n in curves.items()]


def row(label: str, curves: dict[int, Curve], steps: int) -> Row:
    """The largest C against 2/σ², its value where pairs of lineages merge at the rate σ²/N (J. Kingman, 1982)."""
    constants = {n: curve.extra / (n * np.log(n)) for n, curve in curves.items()}
    theory = float(np.mean([2.0 / curve.variance for curve in curves.values()]))
    worst = max(constants.values())
    last = curves[PARTICLES[-1]]
    return Row(
        f"genealogy nodes, {label}",
        worst,
        "C of T + C N log N",
        "2 / variance of descendants",
        theory,
        worst / theory,
        higher=False,
        aim="T + C N log N nodes, C <= 2/variance",
        met=worst <= theory,
        notes=(
            f"{steps} steps, one resampling in {steps / last.resamplings:.1f}; N={PARTICLES[-1]}: {last.nodes[-1]} "
            f"nodes, every node kept: {PARTICLES[-1] * last.resamplings}; C by N: "
            + ", ".join(f"{n}: {value:.2f}" for n, value in constants.items())
        ),
        tolerance=0.3,
    )


def plot(curves: dict[str, dict[int, Curve]], steps: int) -> None:
    """Nodes against steps and against particles, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    FIGURES.mkdir(exist_ok=True)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for axis, (label, by_n) in zip(axes, curves.items(), strict=True):
        for n, curve in by_n.items():
            axis.loglog(curve.steps, curve.nodes, label=f"N = {n}")
        axis.loglog(curve.steps, curve.steps, "k--", linewidth=0.8, label="T")
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
