"""A filter that fails says nothing by itself: signs of it, looked for in every step, and told once each.

Innovations that stay several times as large as stated, evidence that falls and stays below all that was before, weight on a
particle or two, descendants of a parent or two, a number of the state that all particles share. Each is judged by a median
over the last steps, so that an outlier, or a first fix that decides between guesses, is none.
"""

import math
import warnings
from collections import deque

import numpy as np

from rbpf.lie import Finite, LieGroup, Product

WINDOW = 20
"""Steps with observations that a sign must last for, in most of them."""
LARGE = 4.0
"""Normalised innovation squared per degree of freedom; the median of a consistent filter is 0.45 to 1."""
FEW = 0.02
"""Fraction of the particles that is next to none of them, but two at least."""
EVIDENCE_SIGMA = 6.0
EVERY = 10
"""Steps from one count of distinct states to the next."""


class HealthWarning(UserWarning):
    """A filter that is probably wrong, or surer than it should be."""


class Health:
    """What the last steps show. `findings` holds the sentences; each kind is told once, as a `HealthWarning` unless `silent`.

    Args:
        n: number of particles.
        space: the group of the states.
    """

    def __init__(self, n: int, space: LieGroup) -> None:
        self.n = n
        self.findings = dict[str, str]()
        self.silent = False
        self._few = max(2.0, FEW * n)
        self._ratios, self._ess, self._parents = (deque[float](maxlen=WINDOW) for _ in range(3))
        self._recent = deque[float](maxlen=WINDOW)
        self._steady = 0.0, 0.0, 0.0  # number, mean and summed squares of the evidence before the recent one.
        self._most: np.ndarray | None = None
        groups = space.groups if isinstance(space, Product) else (space,)
        self._continuous = np.repeat([not isinstance(group, Finite) for group in groups], [g.size for g in groups])

    def innovations(self, step: int, nis: float, rows: float, ess: float) -> None:
        """After a step with observations: what `StepReport` says of them."""
        if rows > 0.0 and math.isfinite(nis):
            self._ratios.append(nis / rows)
            ratio = _lasting(self._ratios, step)
            if ratio > LARGE:
                self._tell(
                    "innovations",
                    f"step {step}: what is measured is {ratio:.0f} times as far off (squared) as the noise explains, and has "
                    f"been for {WINDOW} steps. The filter has probably diverged: check the noise of motion and measurements, "
                    "use more particles, or marginalise what is sampled",
                )
        self._ess.append(-ess)
        few = -_lasting(self._ess, step)
        if few < self._few:
            self._tell(
                "weights",
                f"step {step}: {few:.1f} of {self.n} particles have had all the weight for {WINDOW} steps, no cloud of them "
                "is left that could say how uncertain the state is: use more particles or a proposal that looks at the "
                "measurements, or check their noise",
            )

    def evidence(self, step: int, log_evidence: float) -> None:
        """After a step with observations: the log-evidence of one number measured."""
        if not math.isfinite(log_evidence):
            return
        if len(self._recent) == WINDOW:
            # Those that leave the recent ones are the past (B. Welford 1962).
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
                self._tell(
                    "evidence",
                    f"step {step}: what is measured has become improbable, the log-evidence of one number fell from "
                    f"{mean:.1f} ± {sigma:.1f} to {best:.1f} and stayed there. The filter has probably diverged: check its "
                    "models, or use more particles",
                )

    def descendants(self, step: int, ancestors: np.ndarray) -> None:
        """After particles were resampled."""
        self._parents.append(-float(np.count_nonzero(np.bincount(ancestors, minlength=self.n))))
        few = -_lasting(self._parents, step)
        if few < self._few:
            self._tell(
                "ancestors",
                f"step {step}: all {self.n} particles descend from {few:.0f} of those before, again and again: they share "
                "one past, which the covariance does not know; use more particles, or marginalise what is sampled",
            )

    def states(self, step: int, state: np.ndarray) -> None:
        """After a step, whose states (N, E) are looked at now and then."""
        if step % EVERY:
            return
        ordered = np.sort(state, axis=0)
        distinct = 1 + (ordered[1:] != ordered[:-1]).sum(axis=0)
        self._most = distinct if self._most is None else np.maximum(self._most, distinct)
        lost = np.flatnonzero(self._continuous & (self._most >= self.n / 2) & (distinct <= self._few) & (self.n > 4))
        if lost.size:
            self._tell(
                "copies",
                f"step {step}: number {lost[0]} of the state has {distinct[lost[0]]} values left among {self.n} particles. "
                "Nothing makes copies of a particle differ in it, so that it can no longer be corrected: marginalise it "
                "(KalmanSubstate), or give it some noise",
            )

    def _tell(self, kind: str, sentence: str) -> None:
        if kind not in self.findings:
            self.findings[kind] = sentence
            if not self.silent:
                warnings.warn(sentence, HealthWarning, stacklevel=4)


def _lasting(values: deque[float], step: int) -> float:
    """The median of a full window, looked at in every fourth step; −∞ says nothing."""
    return sorted(values)[WINDOW // 2] if len(values) == WINDOW and step % 4 == 0 else -math.inf
