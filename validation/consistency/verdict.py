"""Two lights on a run, each with a sentence: how good its path is, and whether its uncertainty can be believed.

They are independent: a path as good as the best may claim ten times too little, and a poor one may know how poor it is.

The first compares the error with the path's own size: the root mean square distance of the true positions from their
centre, which is the error of an estimate that stays there. It is *good* up to 3 %, *fair* up to 10 %, *poor* above, and
never better than the frames that were lost allow.

The second follows from the statistics of `rbpf.validation.consistency.statistic` alone:

- do not trust: one of them contradicts the filter. It is *over-confident* if one of these says that errors are larger
  than claimed, or biased. It is *cautious*, its uncertainty larger than needed, if all say so and one of them compares
  poses or landmarks with the truth or the batch posterior. Innovations that are too small show that the noise is not
  the stated one, and not more: they do not see a past that the particles have forgotten, nor errors that repeat;
- trust: none contradicts, and one that compares poses or landmarks with something else supports it;
- cannot tell: otherwise. The run is too short or too much alike from step to step, or there is nothing to compare it
  with: good innovations alone do not show that the particles follow the right path.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rbpf.validation.consistency.statistic import Statistic

Trust = Literal["trust", "do not trust", "cannot tell"]

Leaning = Literal["over-confident", "cautious", ""]

Grade = Literal["good", "fair", "poor", "not known"]

GRADES: tuple[tuple[Grade, float, float], ...] = (("good", 0.03, 0.05), ("fair", 0.1, 0.25))
"""Grades of a path, with the largest error as a fraction of its spread, and the largest fraction of lost frames."""

_LEANINGS: dict[Leaning, str] = {
    "over-confident": "it claims to know more than it does (over-confident); ",
    "cautious": "it is larger than needed (cautious, not over-confident); ",
    "": "",
}

_OPENINGS: dict[Trust, str] = {
    "trust": "Trust its uncertainty",
    "do not trust": "Do not trust its uncertainty",
    "cannot tell": "Whether its uncertainty can be trusted cannot be told",
}


@dataclass(frozen=True)
class PathGrade:
    """How good a path is."""

    grade: Grade = "not known"  #: the light.
    #: how far it is from what, and how many frames were lost.
    sentence: str = "How far the path is from the right one is not known: the run was compared with nothing."


def grade_path(
    accuracy: str, error_m: float | None, spread_m: float | None, lost: int | None = None, frames: int = 0
) -> PathGrade:
    """The grade of a path.

    Args:
        accuracy: how far it is from what, one sentence.
        error_m: root mean square of it; None where it is not known.
        spread_m: root mean square distance of what it is compared with from its centre.
        lost: frames of the run in which the system was lost; None where it cannot be.
        frames: how many the run has.
    """
    gone = 0.0 if lost is None else lost / max(frames, 1)
    by_loss = next((name for name, _, most in GRADES if gone <= most), "poor")
    grade: Grade = "poor" if by_loss == "poor" else "not known"
    said = [accuracy]
    if error_m is not None and spread_m:
        fraction = error_m / spread_m
        grade = next((name for name, least, most in GRADES if fraction <= least and gone <= most), "poor")
        said.append(f"That is {100 * fraction:.2g} % of its spread about its centre: {grade}.")
    if lost is not None:
        said.append(f"{lost or 'None'} of {frames} frames {'was' if lost == 1 else 'were'} lost.")
    return PathGrade(grade, " ".join(said))


@dataclass(frozen=True)
class Verdict:
    """What a reader has to know."""

    path: PathGrade  #: how good the path is.
    trust: Trust  #: whether its uncertainty can be trusted.
    reason: str  #: why, half a sentence.
    leaning: Leaning = ""  #: to which side the uncertainty is wrong, where it is not to be trusted and that is known.
    advice: str = ""  #: what to try next, a sentence; empty where there is nothing to say.

    @property
    def said(self) -> list[str]:
        """What is said of path and uncertainty, and the advice if there is any."""
        return [text for text in (*self.sentences, self.advice) if text]

    @property
    def sentences(self) -> tuple[str, str]:
        """Of the path and of its uncertainty, each with its full stop."""
        return self.path.sentence, f"{_OPENINGS[self.trust]}: {_LEANINGS[self.leaning]}{self.reason}."


def judge(statistics: Sequence[Statistic], independent: Sequence[str] = (), path: PathGrade | None = None) -> Verdict:
    """The verdict from all statistics.

    `independent` names those that compare poses or landmarks with something the filter did not compute itself.
    """
    path = path or PathGrade()
    against = [s for s in statistics if s.outcome == "contradicts"]
    if against:
        more = f" ({len(against) - 1} more of {len(statistics)} statistics contradict it)" if len(against) > 1 else ""
        # Those that say that it errs more than it claims; else those that may say that it errs less.
        daring = [s for s in against if (s.high < s.zone[0]) == (s.kind == "share")]
        witnesses = [s for s in against if s.name in independent]
        worst = max(daring or witnesses or against, key=_distance)
        if daring or witnesses:
            leaning: Leaning = "over-confident" if daring else "cautious"
            return Verdict(path, "do not trust", described(worst) + more, leaning)
        reason = f"{described(worst)}{more}; the noise is not the stated one, and to which side the poses err "
        return Verdict(path, "do not trust", f"{reason}innovations do not tell")
    judging = [s for s in statistics if s.name in independent]
    support = [s for s in judging if s.outcome == "supports"]
    if support:
        return Verdict(path, "trust", described(support[0]))
    if judging:
        first = judging[0]
        zone = first.zone if first.kind != "ratio" else tuple(map(_root, first.zone))
        reason = (
            f"{described(first)}; the run is worth only {first.samples:.0f} independent samples of it, too few to say "
            f"that this lies within {_number(max(zone[0], 0.0))} to {_number(zone[1])}, or that it does not"
        )
    elif statistics:
        reason = (
            "nothing contradicts it, but a filter that agrees with itself can still be on a wrong path; compare it "
            "with the truth or a batch optimum"
        )
    else:
        reason = "nothing in the run says how large its errors are beside what it claims"
    return Verdict(path, "cannot tell", reason)


def described(statistic: Statistic) -> str:
    """A statistic in words: what was found, with its interval, and what would be right."""
    value, low, high = statistic.value, statistic.low, statistic.high
    if statistic.kind == "bias":
        return (
            f"the {statistic.name} is {value:.2g} of its standard deviations in every step "
            f"({low:.2g} to {high:.2g}; up to {statistic.zone[1]:g} is harmless)"
        )
    if statistic.kind == "share":
        return f"{statistic.name}: {100 * value:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    times, least, most = (_number(_root(ratio)) for ratio in (value, low, high))
    found = f"errors are {times} times as large as it claims ({least} to {most}, where 1 is right)"
    if value <= 0.0:
        side = "far too large"
    elif abs(np.log(_root(value))) <= np.log(1.1):
        side = "right within a tenth"
    elif statistic.outcome == "supports":
        side = f"right within a factor of {_number(_root(statistic.zone[1]))}"
    else:
        side = f"too {'small' if value > 1.0 else 'large'}"
    return f"{statistic.name}: {found}, its standard deviations are {side}"


def _root(ratio: float) -> float:
    """Of variances to one of standard deviations, which is what a reader thinks in."""
    return float(np.sqrt(max(ratio, 0.0)))


def _distance(statistic: Statistic) -> float:
    """How far an interval is outside its zone, as a factor."""
    low, high = statistic.zone
    if statistic.low > high:
        return statistic.low / max(high, 1e-9)
    return max(low, 1e-9) / max(statistic.high, 1e-9)


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "any number"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"
