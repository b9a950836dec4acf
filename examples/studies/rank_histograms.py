"""Simulation-based calibration of a generative model: is the truth ranked uniformly among posterior samples?

Draw parameters from the prior, data given the parameters, and samples from the filter's posterior. If it is exact, the
rank of the true parameter among L samples is uniform on 0 … L, for any model (S. Talts et al., "Validating Bayesian
inference algorithms with simulation-based calibration", 2018). A ∪-shaped histogram shows overconfidence, a ∩-shaped
one underconfidence, a slope bias.

Samples of a particle filter are weighted: the rank follows from the weight below the truth, Σ_i w_i 1[θ_i < θ],
for the effective number of samples, with ties broken at random.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array

Simulate = Callable[[np.random.Generator], tuple[Array, Any]]
"""Parameters (d,) from the prior, and data from them."""
Infer = Callable[[Any, np.random.Generator], tuple[Array, Array]]
"""Given data: samples (N, d) of the posterior, and their weights (N,)."""
LEAST = 20
"""Least number of simulations."""


@final
@dataclass(frozen=True, eq=False)
class Ranks:
    """Ranks of the truth among the samples.

    Attributes:
        names: of the d parameters.
        fractions: (S, d) posterior probability below the true value, in 0 … 1.
        bins: of the histogram.
    """

    names: tuple[str, ...]
    fractions: Array
    bins: int

    def histogram(self) -> NDArray[np.int64]:
        """(bins, d) number of simulations with a fraction in each bin."""
        at = np.minimum((self.fractions * self.bins).astype(int), self.bins - 1)
        return np.stack([np.bincount(column, minlength=self.bins) for column in at.T], axis=1)

    def p_values(self) -> Array:
        """(d,) p-values of the χ² test of uniformity: small if the histogram is not flat."""
        from scipy.stats import chi2

        expected = len(self.fractions) / self.bins
        statistic = (np.square(self.histogram() - expected) / expected).sum(axis=0)
        return np.asarray(chi2.sf(statistic, self.bins - 1))

    def spread(self) -> Array:
        """(d,) variance of the fractions over that of the uniform distribution, 1/12: above 1 is overconfident."""
        return np.asarray(12.0 * np.square(self.fractions - 0.5).mean(axis=0))

    def band(self) -> tuple[int, int]:
        """The 95 % interval of a flat histogram's counts per bin."""
        from scipy.stats import binom

        low, high = binom.ppf([0.025, 0.975], len(self.fractions), 1.0 / self.bins)
        return int(low), int(high)


def calibrate(
    simulate: Simulate, infer: Infer, names: Sequence[str], runs: int = 200, bins: int = 10, seed: int = 0
) -> Ranks:
    """Simulates, filters and ranks.

    Args:
        simulate: draws parameters and data.
        infer: the inference to be checked.
        names: of the parameters.
        runs: number of simulations, each with its own generators.
        bins: of the histogram.
        seed: of everything.

    Raises:
        InputError: there are too few runs for the bins, or samples and weights do not fit the parameters.
    """
    if bins < 2 or runs < max(LEAST, 5 * bins):
        raise InputError(f"{bins} bins need {max(LEAST, 5 * bins)} runs or more to be told apart, got {runs}")
    fractions = []
    for child in np.random.SeedSequence(seed).spawn(runs):
        drawing, filtering, breaking = (np.random.default_rng(s) for s in child.spawn(3))
        truth, data = simulate(drawing)
        samples, weights = infer(data, filtering)
        if samples.shape != (weights.size, len(names)) or truth.shape != (len(names),):
            raise InputError(
                f"expected parameters ({len(names)},) and samples (N, {len(names)}) with weights (N,), got "
                f"{truth.shape}, {samples.shape} and {weights.shape}"
            )
        fractions.append(_below(truth, samples, weights / weights.sum(), breaking))
    return Ranks(tuple(names), np.array(fractions), bins)


def plot_ranks(ranks: Ranks, out: Path, name: str = "ranks.png") -> list[str]:
    """Histograms with the band of a flat one; returns the file's name."""
    from matplotlib.figure import Figure

    from rbpf.runs.plots import COLOURS, save_figures

    figure = Figure(figsize=(4.0 * len(ranks.names), 3.0), layout="constrained")
    panels = figure.subplots(1, len(ranks.names), squeeze=False)[0]
    edges = np.linspace(0.0, 1.0, ranks.bins + 1)
    columns = zip(panels, ranks.names, ranks.histogram().T, ranks.p_values(), strict=True)
    for axes, title, counts, p in columns:
        axes.stairs(counts, edges, fill=True, color=COLOURS["filter"])
        axes.axhspan(*ranks.band(), color=COLOURS["known"], alpha=0.25, label="95 % of the bins, if right")
        axes.set(title=f"{title} (p = {p:.2g})", xlabel="posterior fraction below the truth", ylabel="simulations")
        axes.set_ylim(bottom=0.0)
        axes.legend(loc="lower center", fontsize="small")
    return save_figures({name: figure}, out)


def _below(truth: Array, samples: Array, weights: Array, rng: np.random.Generator) -> Array:
    """(d,) weight below the truth; the next sample's weight is split at random, as N samples have N + 1 gaps."""
    out = np.empty(truth.size)
    for column, value in enumerate(truth.tolist()):
        below = samples[:, column] < value
        tied = samples[:, column] == value
        fraction = float(weights[below].sum()) + rng.random() * float(weights[tied].sum())
        effective = 1.0 / float(np.square(weights).sum())
        out[column] = (fraction * effective + rng.random()) / (effective + 1.0)
    return out
