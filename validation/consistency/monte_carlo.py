"""Consistency over many simulated runs: does the filter know how wrong it is, on the average and from when on not?

Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with applications to tracking and navigation" (2001), §5.4; T. Bailey,
J. Nieto, E. Nebot, "Consistency of the FastSLAM algorithm", ICRA 2006. The runs are independent, so that bands and
intervals come from their number and need no assumption about correlation in time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbpf.core.diagnostics import Band, chi_square_band
from rbpf.errors import InputError
from rbpf.validation.consistency.statistic import PROBABILITIES
from rbpf.validation.consistency.trials import Trial
from rbpf.validation.sweep.parallel import in_parallel

LAST = 10
"""Steps that must be left after the step from which on a filter is over-confident, to be able to say so."""


@dataclass(frozen=True)
class Mean:
    """A mean over independent runs, with the standard error of it."""

    value: float
    error: float

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray) -> "Mean":
        """Of one value per run."""
        numbers = np.asarray(values, dtype=float)
        spread = float(numbers.std(ddof=1)) if numbers.size > 1 else float("inf")
        return cls(float(numbers.mean()), float(spread / np.sqrt(numbers.size)))


@dataclass(frozen=True)
class Consistency:
    """What R runs of T steps say together.

    Attributes:
        trials: the runs.
    """

    trials: list[Trial]

    def __post_init__(self) -> None:
        """Checks that they belong together.

        Raises:
            InputError: there is none, or they differ in length or dimension.
        """
        shapes = {(trial.dim, trial.nees.size) for trial in self.trials}
        if len(shapes) != 1:
            raise InputError(
                f"a test of consistency takes one or more runs of one kind and length, got {len(shapes)}"
            )

    @property
    def dim(self) -> int:
        """Degrees of freedom of a pose, d."""
        return self.trials[0].dim

    @property
    def mean_nees(self) -> np.ndarray:
        """(T,) mean over the runs; NaN where the filter holds the pose to be known exactly."""
        return np.mean([trial.nees for trial in self.trials], axis=0)

    def band(self, probability: float = 0.95) -> Band:
        """In which an honest filter's mean NEES of one step lies with a probability."""
        return chi_square_band(self.dim, len(self.trials), probability)

    @property
    def overconfident_from(self) -> int | None:
        """The step from which on the filter is over-confident, by `left_for_good`; None for one that never is."""
        return left_for_good(self.mean_nees, self.band().high)

    @property
    def pose_nees(self) -> Mean:
        """Per degree of freedom, over all steps; 1 is right."""
        return Mean.of([float(np.nanmean(trial.nees)) / self.dim for trial in self.trials])

    @property
    def landmark_nees(self) -> Mean:
        """Per degree of freedom, over all landmarks of a run; 1 is right."""
        seen = [trial for trial in self.trials if trial.landmark_nees.size]
        return Mean.of([float(trial.landmark_nees.mean()) / trial.landmark_dim for trial in seen])

    @property
    def nis(self) -> Mean:
        """Per degree of freedom; 1 is right."""
        return Mean.of([_nis_ratio(trial) for trial in self.trials])

    @property
    def position_rmse(self) -> Mean:
        """Of one run, m, without alignment."""
        return Mean.of([float(np.sqrt(np.square(trial.distances).mean())) for trial in self.trials])

    def coverage(self, probability: float) -> Mean:
        """How often the true pose lies in the credible region of a probability."""
        from scipy.stats import chi2

        bound = chi2.ppf(probability, self.dim)
        known = [trial.nees[np.isfinite(trial.nees)] for trial in self.trials]
        return Mean.of([float((nees <= bound).mean()) for nees in known])

    @property
    def coalescence(self) -> float:
        """Median of the steps back to the latest common ancestor; infinite where most runs have none."""
        return float(np.median([np.inf if t.coalescence is None else t.coalescence for t in self.trials]))

    def ancestors(self, age: int) -> float:
        """Mean number of particles `age` steps before the end that still have descendants at the end."""
        return float(
            np.mean([trial.ancestors[max(trial.ancestors.size - 1 - age, 0)] for trial in self.trials])
        )

    def entries(self) -> dict[str, Any]:
        """All figures by name, for a table."""
        means = {
            "pose_nees": self.pose_nees,
            "landmark_nees": self.landmark_nees,
            "nis": self.nis,
            "position_rmse_m": self.position_rmse,
            **{f"coverage_{100 * p:.0f}": self.coverage(p) for p in PROBABILITIES},
        }
        start = self.overconfident_from
        return {
            "runs": len(self.trials),
            "overconfident_from": "never" if start is None else start,
            **{name: mean.value for name, mean in means.items()},
            **{f"{name}_error": mean.error for name, mean in means.items()},
            "coalescence": self.coalescence,
        }


def run_trials(trial: Callable[[int], Trial], seeds: Sequence[int], workers: int = 1) -> Consistency:
    """Runs a trial once per seed.

    Args:
        trial: a `RobotTrial`, a `DeskTrial` or anything picklable that makes a `Trial` from a seed.
        seeds: one run each.
        workers: processes.
    """
    return Consistency(in_parallel(trial, seeds, workers))


def left_for_good(mean_nees: np.ndarray, high: float) -> int | None:
    """When a mean NEES (T,) leaves its band upwards and does not come back.

    That is the first step above the band such that, for every later step s, at least half of the steps from it to s
    are above the band: single steps inside do not end over-confidence, and single ones outside, of which an honest
    filter has one in forty, do not begin it. It must lie `LAST` steps or more before the end.

    Returns:
        The step; None for a filter that stays inside or comes back.
    """
    votes = np.where(np.nan_to_num(mean_nees, nan=0.0) > high, 1, -1)
    total = np.concatenate([[0], np.cumsum(votes)])
    # the sum of the votes from t to s is total[s + 1] − total[t]; its least over s must not be negative
    least = np.minimum.accumulate(total[:0:-1])[::-1]
    starts = np.flatnonzero((votes > 0) & (least >= total[:-1]))
    return int(starts[0]) if starts.size and starts[0] <= mean_nees.size - LAST else None


def _nis_ratio(trial: Trial) -> float:
    used = np.isfinite(trial.nis) & (trial.nis_dof > 0)
    return float(trial.nis[used].sum() / trial.nis_dof[used].sum()) if used.any() else float("nan")
