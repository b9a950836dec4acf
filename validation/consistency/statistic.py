"""Consistency statistics: values that are known for a consistent filter, with confidence intervals.

Most of them are a ratio r of squared errors to their expectation by the filter: 1 for a consistent filter, 9 if its
standard deviations are three times too small. From ν effective degrees of freedom, the 95 % interval of r is

    [r ν / χ²_ν(0.975), r ν / χ²_ν(0.025)]

The zone of a statistic is the tolerated error of standard deviations, the interval shows whether this can be decided
(docs/how_to/report.md); no threshold depends on a run.

Errors of a filter are correlated in time, so that T steps count for less than T independent ones. For a sum of squares of
zero-mean Gaussian numbers e_t with covariances C_ts = E[e_t e_sᵀ], mean and variance are those of a scaled χ² with

    ν = (Σ_t tr C_tt)² / Σ_ts ‖C_ts‖²

degrees of freedom (F. Satterthwaite, "An approximate distribution of estimates of variance components", 1946). The
covariances are estimated from the series itself, up to the first lag without correlation
(C. Geyer, "Practical Markov chain Monte Carlo", 1992).
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import betaincinv, chdtr, ndtri

from rbpf.core.diagnostics import chi_square_quantile
from rbpf.lie import LieGroup

LEVEL = 0.95  #: Confidence level of all intervals.
#: The standard deviations of poses and landmarks may be wrong by this factor: they rest on few independent samples.
STATE_FACTOR = 2.0
#: The same for measurements and motions: they rest on thousands, and an error in them recurs in every step.
NOISE_FACTOR = 1.1
#: Tolerated bias of a motion per step, in its standard deviations: over 16 steps it accumulates to as much as the noise.
BIAS = 0.25
BIAS_OF_MOTION = "bias of the motion"
INFORMED = 0.05  #: Directions of the motion with a smaller fraction of information by observations are left out.
PROBABILITIES = 0.5, 0.9, 0.95  #: Of credible regions.
_NOTHING = 1e-12  #: Variances below this fraction of the largest, or of one, count as zero.


@dataclass(frozen=True)
class Statistic:
    """One number about a filter's consistency."""

    name: str  #: short description.
    value: float  #: of this run.
    low: float  #: end of its 95 % interval;  high: the other.
    high: float
    zone: tuple[float, float]  #: tolerated range.
    samples: float  #: effective degrees of freedom or number of independent samples behind it.
    #: a ratio of variances, a bias in standard deviations, a fraction of cases, or the deviation of a stated calibration from
    #: the measured one, in standard deviations.
    kind: Literal["ratio", "bias", "share", "calibration"] = "ratio"

    @property
    def outcome(self) -> Literal["supports", "contradicts", "leaves open"]:
        """Its conclusion about the filter."""
        if self.low > self.zone[1] or self.high < self.zone[0]:
            return "contradicts"
        return "supports" if self.zone[0] <= self.low and self.high <= self.zone[1] else "leaves open"

    def entries(self) -> dict[str, Any]:
        """For JSON; bounds that are infinite are null."""
        values = asdict(self) | {"outcome": self.outcome}
        found = {name: None if isinstance(v, float) and not np.isfinite(v) else v for name, v in values.items()}
        return found | {"zone": [bound if np.isfinite(bound) else None for bound in self.zone]}

    @classmethod
    def of_entries(cls, entries: dict[str, Any]) -> "Statistic":
        """The inverse of `entries`."""
        low, high = entries["zone"]
        zone = (-np.inf if low is None else low, np.inf if high is None else high)
        top = np.inf if entries["high"] is None else entries["high"]
        names = ("name", "value", "low", "samples", "kind")
        return cls(**{name: entries[name] for name in names}, high=top, zone=zone)


@dataclass(frozen=True)
class WhitenedErrors:
    """Errors of T poses, whitened by the filter's covariances, e = cov^(−1/2) Log(mean⁻¹ truth)."""

    errors: np.ndarray  #: (T, d); zero along directions that are exact for the filter.
    ranks: np.ndarray  #: (T,) number of the other directions.

    @property
    def nees(self) -> np.ndarray:
        """(T,) normalised errors squared; the mean of a consistent filter's is the rank."""
        return np.square(self.errors).sum(axis=1)


def whitened_errors(space: LieGroup, mean: np.ndarray, cov: np.ndarray, truth: np.ndarray) -> WhitenedErrors:
    """Errors of estimates (T, E) with covariances (T, d, d) in the right chart, from the truth (T, E).

    The symmetric root is taken, so that the axes are the chart's own at all times.
    """
    roots, ranks = inverse_roots(cov)
    return WhitenedErrors(np.einsum("tab,tb->ta", roots, space.local(mean, truth)), ranks)


def inverse_roots(cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Symmetric P^(−1/2) (T, d, d) of covariances, zero along directions without variance, and their ranks (T,)."""
    values, vectors = np.linalg.eigh(cov)
    used = values > _NOTHING * np.maximum(values[:, -1:], _NOTHING)
    scale = np.where(used, 1.0 / np.sqrt(np.where(used, values, 1.0)), 0.0)
    return (vectors * scale[:, None, :]) @ vectors.mT, used.sum(axis=1)


def degrees_of_freedom(white: np.ndarray) -> float:
    """Effective degrees of freedom ν of Σ_t |e_t|², of errors (T, d) whitened by their own covariances; 0 without any.

    The mean of a consistent series is zero and is not subtracted: an error of constant sign is one sample, however long it
    lasts.
    """
    total = white.shape[0]
    power = float(np.square(white).sum())
    if not power > 0.0:
        return float(white.size)
    shared = float(np.square(white.T @ white).sum())
    for lag in range(1, total):
        lagged = white[:-lag].T @ white[lag:]
        if np.trace(lagged) <= 0.0:
            break
        shared += 2.0 * float(np.square(lagged).sum()) * total / (total - lag)
    return float(np.clip(total * power**2 / shared, 1.0, white.size))


def correlation_time(series: np.ndarray) -> float:
    """Integrated autocorrelation time of a series (T,), at least 1: T values are worth T / time independent ones.

    Sums of neighbouring autocorrelations are added up to the first that is not positive (Geyer 1992, §3.3).
    """
    centred = series - series.mean() if series.size else series
    power = float(np.square(centred).sum())
    if series.size < 4 or not power > 0.0:
        return 1.0
    spectrum = np.abs(np.fft.rfft(centred, 2 * series.size)) ** 2
    correlation = np.fft.irfft(spectrum)[: series.size] / power
    pairs = correlation[: series.size // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    kept = pairs[: negative[0]] if negative.size else pairs
    return max(1.0, 2.0 * float(kept.sum()) - 1.0)


def variance_ratio(name: str, value: float, dof: float, factor: float) -> Statistic:
    """A ratio r of squared errors to their expected value, of `dof` effective degrees of freedom ν.

    Standard deviations may be wrong by `factor` in either direction.
    """
    tail = 0.5 * (1.0 - LEVEL)
    low, high = (value * dof / bound for bound in chi_square_quantile([1.0 - tail, tail], dof))
    return Statistic(name, value, float(low), float(high), (factor**-2, factor**2), dof)


def posterior_ratio(
    name: str, cov: np.ndarray, cov_posterior: np.ndarray, delta: np.ndarray, same_data: bool = False
) -> Statistic | None:
    """Ratio of a filter's T squared errors expected by a better posterior to those claimed by the filter.

    If a better posterior N(m_b, P_b) replaces the truth, an estimate m_f with covariance P_f has the expected normalised
    squared error tr P_f⁻¹ (P_b + δ δᵀ), δ = m_b − m_f: the rank of P_f for an optimal filter. An online estimate uses fewer
    measurements than the posterior, so δ is random, with covariance P_f − P_b; the interval is for this part. If both use the
    same data (`same_data`), as for a map, nothing is random, and the median over the estimates is reported, which is robust
    to a few landmarks with a prior only in the filter, or with false matches. None without any uncertain estimate. P_f, P_b
    (T, d, d) and δ (T, d) are in one chart.
    """
    roots, ranks = inverse_roots(cov)
    total = int(ranks.sum())
    if not total:
        return None
    claimed = np.einsum("tab,tbc,tca->t", roots, cov_posterior, roots)
    white = np.einsum("tab,tb->ta", roots, delta)
    if same_data:
        each = ((claimed + np.square(white).sum(axis=1)) / np.maximum(ranks, 1))[ranks > 0]
        value = float(np.median(each))
        return Statistic(name, value, value, value, (STATE_FACTOR**-2, STATE_FACTOR**2), float(each.size))
    fixed, white = float(claimed.sum()) / total, white[ranks > 0]
    apart = float(np.square(white).sum()) / total
    found = variance_ratio(name, apart, max(degrees_of_freedom(white), 1.0), STATE_FACTOR)
    return replace(found, value=fixed + apart, low=fixed + found.low, high=fixed + found.high)


def map_ratio(name: str, positions: np.ndarray, white: np.ndarray) -> Statistic:
    """Ratio of the squared errors of a map's landmarks (M, D), whitened (M, d), to their expected value.

    Errors of neighbours are correlated: a map rotated by a heading error has one error, however many landmarks. The part of
    the errors explained by an affine displacement field, k = d (d + 1) parameters, is therefore one block, and the rest
    another (Satterthwaite over both).
    """
    value = float(np.square(white).mean())
    design = np.column_stack([np.ones(len(positions)), positions - positions.mean(axis=0)])
    fitted = design @ np.linalg.lstsq(design, white, rcond=None)[0]
    count = min(design.shape[1] * white.shape[1], white.size)
    smooth, rest = float(np.square(fitted).sum()), float(np.square(white - fitted).sum())
    dof = (smooth + rest) ** 2 / (smooth**2 / count + rest**2 / max(white.size - count, 1)) if value else count
    return variance_ratio(name, value, max(dof, 1.0), STATE_FACTOR)


def step_ratio(name: str, squares: np.ndarray, dofs: np.ndarray, factor: float = NOISE_FACTOR) -> Statistic | None:
    """Ratio of squared errors (T,), each χ² of `dofs` (T,) for a consistent filter and independent from step to step.

    Correlated steps, or more scatter than that of χ², reduce the number of samples. None without any.
    """
    used = np.isfinite(squares) & (dofs > 0)
    squares, dofs = squares[used], dofs[used]
    if not squares.size:
        return None
    total = float(dofs.sum())
    value = float(squares.sum()) / total
    standard = (squares - value * dofs) / np.sqrt(2.0 * dofs)
    excess = float(standard.var()) / value**2 if value > 0.0 else 1.0
    dof = total / (correlation_time(standard) * max(excess, 1.0))
    return variance_ratio(name, value, max(dof, 1.0), factor)


def motion_statistics(correction: np.ndarray, cov: np.ndarray) -> list[Statistic]:
    """Size and bias of the observations' corrections of the motion: corrections (T, r), (T, r, r) of the log.

    See `rbpf.core.diagnostics.Correction`; rows of NaN are left out.
    """
    known = np.isfinite(correction).all(axis=1)
    correction, cov = correction[known], cov[known]
    values, vectors = np.linalg.eigh(cov)
    informed = values > INFORMED
    turned = np.einsum("tab,ta->tb", vectors, correction)
    squares = np.where(informed, np.square(turned) / np.where(informed, values, 1.0), 0.0).sum(axis=1)
    size = step_ratio("motion against measurements", squares, informed.sum(axis=1).astype(float))
    # The least-squares bias b of the corrections, û = cov b: its most significant informed component.
    values, vectors = np.linalg.eigh(cov.sum(axis=0))
    informed = values > 1.0
    sizes = [] if size is None else [size]  # all steps together may be informative even if no single one is
    if not informed.any():
        return sizes
    along = (vectors.T @ correction.sum(axis=0))[informed] / values[informed]
    std = np.sqrt(max([1.0, *(s.value for s in sizes)]) / values[informed])
    margin = float(ndtri(0.5 + 0.5 * LEVEL ** (1.0 / along.size)))  # all components together
    lows = np.maximum(np.abs(along) - margin * std, 0.0)
    worst = int(np.argmax(lows)) if lows.any() else int(np.argmax(np.abs(along) + margin * std))
    bias, top = float(np.abs(along[worst])), float((np.abs(along) + margin * std).max())
    zone, samples = (-np.inf, BIAS), len(correction)
    return [*sizes, Statistic(BIAS_OF_MOTION, bias, float(lows[worst]), top, zone, samples, "bias")]


def coverage(nees: np.ndarray, dim: int, samples: float) -> list[Statistic]:
    """Coverage of the credible regions, for each of `PROBABILITIES`.

    From normalised squared errors (T,) of `dim` degrees of freedom each, worth `samples` independent samples.
    """
    out, tail = [], 0.5 * (1.0 - LEVEL)
    for probability in PROBABILITIES:
        bound = float(chi_square_quantile(probability, dim))
        fraction = float((nees <= bound).mean())
        # Clopper and Pearson's interval, for a number of samples that need not be whole
        hits = fraction * samples
        low = float(betaincinv(hits, samples - hits + 1.0, tail)) if hits > 0.0 else 0.0
        high = float(betaincinv(hits + 1.0, samples - hits, 1.0 - tail)) if hits < samples else 1.0
        zone = (float(chdtr(dim, bound / STATE_FACTOR**2)), float(chdtr(dim, bound * STATE_FACTOR**2)))
        zone = (zone[0], zone[1] if zone[1] < 0.999 else 1.0)
        name = f"poses inside the {100 * probability:g} % region"
        out.append(Statistic(name, fraction, low, high, zone, samples, "share"))
    return out
