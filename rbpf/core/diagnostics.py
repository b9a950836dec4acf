"""Consistency checks of a filter: NEES and its band, ancestors, motion corrections; and a monitor for divergence.

A filter gives no error when it fails, so `Health` monitors every step for these signs, and reports each once: normalised
innovations that stay large, evidence that drops and stays low, weight on one or two particles, descent from one or two
parents, a state component that all particles share. Each is a median over the last steps, so that a single outlier, or the
first fix that resolves an ambiguity, does not trigger it.
"""

import math
import warnings
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from rbpf.core.genealogy import History
from rbpf.core.particles import Estimate, Prior, Proposed
from rbpf.lie import Finite, LieGroup, Product

WINDOW = 20  #: Steps with observations over which the median of a sign is taken.
LARGE = 4.0  #: Normalised innovation squared per degree of freedom; the median of a consistent filter is 0.45 to 1.
#: Mean of the same over all measurements, at a noise stated twice as large as it is; and the least number of measured
#: components for it.
SMALL, ENOUGH = 0.25, 200.0
FEW = 0.02  #: Fraction of the particles that counts as few; at least two particles.
EVIDENCE_SIGMA = 6.0
EVERY = 10  #: Steps between counts of distinct states.


@dataclass(frozen=True)
class Band:
    """Two-sided band of a normalised error: `low` and `high`, with `expected` between them."""

    low: float
    expected: float
    high: float


def nees(space: LieGroup, estimate: Estimate, truth: np.ndarray) -> float:
    """Normalised estimation error squared eᵀP⁺e, e = Log(mean⁻¹ truth), truth (E,); its mean is d for a consistent filter."""
    error = space.local(estimate.mean, truth)
    return float(error @ np.linalg.pinv(estimate.cov, hermitian=True) @ error)


def chi_square_quantile(probability: Any, dof: float) -> Any:
    """Quantile of the χ² distribution, for a number or an array of probabilities."""
    # As in `scipy.stats`, which takes half a second to import.
    return 2.0 * gammaincinv(0.5 * dof, probability)


def chi_square_band(dof: float, runs: int = 1, probability: float = 0.95) -> Band:
    """Band of the mean over `runs` independent χ² variables of `dof` degrees of freedom each.

    A consistent filter stays inside with the given probability (Bar-Shalom, Li, Kirubarajan 2001, §5.4).
    """
    tail = 0.5 * (1.0 - probability)
    low, high = chi_square_quantile([tail, 1.0 - tail], dof * runs) / runs
    return Band(float(low), float(dof), float(high))


def ancestors_by_step(history: History) -> np.ndarray:
    """Number of particles of each stored step that have descendants among the current ones, (T,) int."""
    counts = [np.full(len(b.states), history.lineage.distinct(b.generation)) for b in history.blocks]
    return np.concatenate([np.zeros(0, dtype=np.int64), *counts])


def coalescence_steps(history: History) -> int | None:
    """Steps back from the last one to the latest common ancestor of all particles; None if no stored step has one."""
    single = np.flatnonzero(ancestors_by_step(history) == 1)
    return int(history.stamps_ns.size - 1 - single[-1]) if single.size else None


@dataclass(frozen=True)
class Correction:
    """The correction of one step's motion by its observations, and its covariance expected of a consistent filter.

    The increment is μ + L u with u ~ N(0, I) before the observations. Given them, u has mean û and covariance C, within +
    between particles. By the law of total variance û has covariance I − C, and it is independent between steps: an odometer
    with a bias of b standard deviations shifts û by (I − C) b, and wrong noise makes it too large or small.
    """

    mean: np.ndarray  #: (r,) û.
    cov: np.ndarray  #: (r, r) I − C.


def motion_correction(mixture: tuple[Prior, Proposed | None, np.ndarray]) -> Correction | None:
    """The correction of a step's motion, from `StepReport.mixture`; None after a proposal that did not linearise."""
    _, proposed, log_weights = mixture
    if proposed is None:
        return None
    n = log_weights.size
    weights = np.exp(log_weights)
    centres = np.broadcast_to(proposed.mean, (n, proposed.mean.shape[1]))
    roots = np.broadcast_to(proposed.root, (n, *proposed.root.shape[1:]))
    mean = weights @ centres
    spread = np.sqrt(weights)[:, None] * (centres - mean)
    within = np.einsum("n,nab,ncb->ac", weights, roots, roots)
    return Correction(mean, np.eye(mean.size) - within - spread.T @ spread)


class HealthWarning(UserWarning):
    """The filter has probably diverged, or is overconfident."""


class Health:
    """Monitor of the last steps. Each kind of finding is added to `findings` once, with a `HealthWarning` unless `silent`.

    An underconfident filter is not a finding but one of the `remarks`: its estimates remain valid.

    Args:
        n: number of particles.
        space: the group of the states.
    """

    def __init__(self, n: int, space: LieGroup) -> None:
        self.n = n
        self.findings, self.remarks = dict[str, str](), dict[str, str]()
        self.silent = False
        self._squared, self._rows = 0.0, 0.0
        self._few = max(2.0, FEW * n)
        self._ratios, self._ess, self._parents = (deque[float](maxlen=WINDOW) for _ in range(3))
        self._recent = deque[float](maxlen=WINDOW)
        self._steady = 0.0, 0.0, 0.0  # count, mean and sum of squares of the earlier evidence.
        self._most: np.ndarray | None = None
        groups = space.groups if isinstance(space, Product) else (space,)
        self._continuous = np.repeat([not isinstance(group, Finite) for group in groups], [g.size for g in groups])

    def innovations(self, step: int, nis: float, rows: float, ess: float) -> None:
        """To be called after a step with observations, with the values of its `StepReport`."""
        if rows > 0.0 and math.isfinite(nis):
            self._ratios.append(nis / rows)
            ratio = _lasting(self._ratios, step)
            if ratio > LARGE:
                self._warn_once(
                    "innovations",
                    f"step {step}: squared innovations are {ratio:.0f} times as large as the noise explains, and have "
                    f"been for {WINDOW} steps. The filter has probably diverged: check the noise of motion and measurements, "
                    "use more particles, or marginalise what is sampled",
                )
            # A mean over the whole run: underconfidence is not urgent, and large innovations can only mask it.
            self._squared, self._rows = self._squared + nis, self._rows + rows
            if self._rows >= ENOUGH and self._squared < SMALL * self._rows:
                ratio = self._squared / self._rows
                self.remarks["caution"] = (
                    f"squared innovations are {ratio:.2f} times as large as the noise explains, 1 is right: the "
                    "noise of motion or measurements is stated too large"
                )
            else:
                self.remarks.pop("caution", None)
        self._ess.append(-ess)
        few = -_lasting(self._ess, step)
        if few < self._few:
            self._warn_once(
                "weights",
                f"step {step}: {few:.1f} of {self.n} particles have had all the weight for {WINDOW} steps, too few "
                "to represent the uncertainty of the state: use more particles or a proposal that uses the "
                "measurements, or check their noise",
            )

    def evidence(self, step: int, log_evidence: float) -> None:
        """To be called after a step with observations, with the log-evidence per measured component."""
        if not math.isfinite(log_evidence):
            return
        if len(self._recent) == WINDOW:
            # Values that leave the window are added to the running statistics (B. Welford 1962).
            number, mean, squares = self._steady
            oldest = self._recent[0]
            moved = mean + (oldest - mean) / (number + 1.0)
            self._steady = number + 1.0, moved, squares + (oldest - mean) * (oldest - moved)
        self._recent.append(log_evidence)
        number, mean, squares = self._steady
        if number >= WINDOW and step % 4 == 0:
            sigma = max(math.sqrt(squares / number), 0.1)
            best = sorted(self._recent)[3 * WINDOW // 4]
            if best < mean - EVIDENCE_SIGMA * sigma:
                self._warn_once(
                    "evidence",
                    f"step {step}: the measurements have become improbable, the log-evidence per component fell from "
                    f"{mean:.1f} ± {sigma:.1f} to {best:.1f} and stayed there. The filter has probably diverged: check its "
                    "models, or use more particles",
                )

    def descendants(self, step: int, ancestors: np.ndarray) -> None:
        """To be called after resampling."""
        self._parents.append(-float(np.count_nonzero(np.bincount(ancestors, minlength=self.n))))
        few = -_lasting(self._parents, step)
        if few < self._few:
            self._warn_once(
                "ancestors",
                f"step {step}: all {self.n} particles descend from {few:.0f} of those before, step after step: they share "
                "one past, which makes the covariance too small; use more particles, or marginalise what is sampled",
            )

    def states(self, step: int, state: np.ndarray) -> None:
        """To be called after a step; its states (N, E) are checked every few steps."""
        if step % EVERY:
            return
        ordered = np.sort(state, axis=0)
        distinct = 1 + (ordered[1:] != ordered[:-1]).sum(axis=0)
        self._most = distinct if self._most is None else np.maximum(self._most, distinct)
        lost = np.flatnonzero(self._continuous & (self._most >= self.n / 2) & (distinct <= self._few) & (self.n > 4))
        if lost.size:
            self._warn_once(
                "copies",
                f"step {step}: component {lost[0]} of the state has {distinct[lost[0]]} values left among {self.n} particles. "
                "It has no noise that separates copies of a particle, so it can no longer be corrected: marginalise it "
                "(KalmanSubstate), or give it some noise",
            )

    def _warn_once(self, kind: str, sentence: str) -> None:
        if kind not in self.findings:
            self.findings[kind] = sentence
            if not self.silent:
                warnings.warn(sentence, HealthWarning, stacklevel=4)


def _lasting(values: deque[float], step: int) -> float:
    """The median of a full window, computed every fourth step; else −∞."""
    return sorted(values)[WINDOW // 2] if len(values) == WINDOW and step % 4 == 0 else -math.inf
