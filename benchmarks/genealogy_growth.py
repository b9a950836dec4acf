"""Nodes of the genealogy against steps and particles; theory: T + C·N log N (P. Jacob et al., 2015)."""

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


def grow(n: int, steps: int, threshold: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, int]:
    """Steps (S,), nodes after them (S,) and resamplings of a lineage all of whose generations are retained."""
    lineage = Lineage(n)
    lineage.retain(0)
    log_weights = np.zeros(n)
    at, nodes = np.unique(np.geomspace(1, steps, SAMPLES).astype(int)), []
    resamplings = 0
    for t in range(1, steps + 1):
        log_weights += SPREAD * rng.normal(size=n)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        if effective_sample_size(weights) < threshold * n:
            lineage.advance(Systematic().ancestors(weights, rng))
            lineage.retain(lineage.generation)
            log_weights[:] = 0.0
            resamplings += 1
        if t in at:
            nodes.append(lineage.nodes)
    return at, np.array(nodes), resamplings


def run(settings: Settings) -> list[Row]:
    """Growth under always-resampling and under the effective sample size, and the constant C of each."""
    steps = STEPS // 4 if settings.quick else STEPS
    rng = np.random.default_rng(0)
    curves = {
        label: {n: grow(n, steps, threshold, rng) for n in PARTICLES}
        for label, threshold in (("always", np.inf), ("ESS < N/2", 0.5))
    }
    plot(curves, steps)
    return [row(label, curves[label]) for label in curves]


def row(label: str, curves: dict[int, tuple[np.ndarray, np.ndarray, int]]) -> Row:
    """The largest map of C over N: it must not grow with N."""
    constants = {n: (nodes[-1] - resamplings) / (n * np.log(n)) for n, (_, nodes, resamplings) in curves.items()}
    smallest, largest = constants[PARTICLES[0]], constants[PARTICLES[-1]]
    n = PARTICLES[-1]
    nodes, resamplings = curves[n][1][-1], curves[n][2]
    return Row(
        f"genealogy nodes, {label}",
        largest,
        "C at N=2000",
        f"C at N={PARTICLES[0]}",
        smallest,
        largest / smallest,
        higher=False,
        aim="T + C N log N, C < 1 and not growing",
        met=bool(largest < 1.0 and largest <= 1.5 * smallest),
        notes=(
            f"N={n}: {nodes} nodes after {resamplings} resamplings, a dense tree has {n * resamplings}; C by N: "
            + ", ".join(f"{size}: {value:.2f}" for size, value in constants.items())
        ),
        tolerance=0.5,
    )


def plot(curves: dict[str, dict[int, tuple[np.ndarray, np.ndarray, int]]], steps: int) -> None:
    """Nodes against steps and against particles, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    FIGURES.mkdir(exist_ok=True)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for axis, (label, by_n) in zip(axes, curves.items(), strict=True):
        for n, (at, nodes, _) in by_n.items():
            axis.loglog(at, nodes, label=f"N = {n}")
        axis.loglog(at, at, "k--", linewidth=0.8, label="T")
        axis.set(xlabel="steps T", title=f"resampled {label}")
    axes[0].set_ylabel("nodes")
    axes[1].legend(fontsize=7)
    figure.savefig(FIGURES / "genealogy_steps.png", dpi=90)
    plt.close(figure)

    figure, axis = plt.subplots(figsize=(4.8, 3.6), layout="constrained")
    sizes = np.array(PARTICLES)
    for label, by_n in curves.items():
        extra = np.array([nodes[-1] - resamplings for _, nodes, resamplings in by_n.values()])
        constant = float(np.median(extra / (sizes * np.log(sizes))))
        (line,) = axis.loglog(sizes, extra, "o", label=f"resampled {label}, T = {steps}")
        theory = constant * sizes * np.log(sizes)
        axis.loglog(sizes, theory, "--", color=line.get_color(), label=f"{constant:.2f} N log N")
    axis.set(xlabel="particles N", ylabel="nodes less one per resampling")
    axis.legend(fontsize=7)
    figure.savefig(FIGURES / "genealogy_particles.png", dpi=90)
    plt.close(figure)
