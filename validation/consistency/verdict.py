"""Two sentences about a run in plain words: how good it is, and whether its uncertainty can be trusted.

The second follows from the statistics of `rbpf.validation.consistency.statistic` alone:

- do not trust: one of them contradicts the filter. It is *over-confident* if one of these says that errors are larger
  than claimed, or biased; otherwise it is *cautious*: its uncertainty is larger than needed, which misleads whoever
  weighs it against something else, but leaves nobody nearer to a wall than he was told;
- trust: none contradicts, and one that compares its poses with something else (truth, batch optimum) supports it;
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
class Verdict:
    """What a reader has to know.

    Attributes:
        accuracy: how good the run is, one sentence.
        trust: whether its uncertainty can be trusted.
        reason: why, half a sentence.
        leaning: to which side the uncertainty is wrong, where it is not to be trusted.
        advice: what to try next, a sentence; empty where there is nothing to say.
    """

    accuracy: str
    trust: Trust
    reason: str
    leaning: Leaning = ""
    advice: str = ""

    @property
    def said(self) -> list[str]:
        """Both sentences, and the advice if there is any."""
        return [text for text in (*self.sentences, self.advice) if text]

    @property
    def sentences(self) -> tuple[str, str]:
        """Both, each with its full stop."""
        return self.accuracy, f"{_OPENINGS[self.trust]}: {_LEANINGS[self.leaning]}{self.reason}."


def judge(accuracy: str, statistics: Sequence[Statistic], independent: Sequence[str] = ()) -> Verdict:
    """The verdict.

    Args:
        accuracy: how good the run is, one sentence.
        statistics: all that there are.
        independent: names of those that compare the poses with something the filter did not compute itself.
    """
    against = [s for s in statistics if s.outcome == "contradicts"]
    if against:
        more = (
            f" ({len(against) - 1} more of {len(statistics)} statistics contradict it)"
            if len(against) > 1
            else ""
        )
        daring = [s for s in against if _claims_too_much(s)]
        worst = max(daring or against, key=_distance)
        leaning: Leaning = "over-confident" if daring else "cautious"
        return Verdict(accuracy, "do not trust", described(worst) + more, leaning)
    judging = [s for s in statistics if s.name in independent]
    support = [s for s in judging if s.outcome == "supports"]
    if support:
        return Verdict(accuracy, "trust", described(support[0]))
    if judging:
        reason = f"{described(judging[0])}; {_why_open(judging[0])}"
    elif statistics:
        reason = (
            "nothing contradicts it, but a filter that agrees with itself can still be on a wrong path; compare it "
            "with the truth or a batch optimum"
        )
    else:
        reason = "nothing in the run says how large its errors are beside what it claims"
    return Verdict(accuracy, "cannot tell", reason)


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
    return f"{statistic.name}: {found}, {_side(value)}"


def _root(ratio: float) -> float:
    """Of variances to one of standard deviations, which is what a reader thinks in."""
    return float(np.sqrt(max(ratio, 0.0)))


def _side(ratio: float) -> str:
    if ratio <= 0.0:
        return "its standard deviations are far too large"
    if abs(np.log(_root(ratio))) <= np.log(1.1):
        return "its standard deviations are right within a tenth"
    return f"its standard deviations are too {'small' if ratio > 1.0 else 'large'}"


def _why_open(statistic: Statistic) -> str:
    zone = statistic.zone if statistic.kind != "ratio" else tuple(map(_root, statistic.zone))
    return (
        f"the run is worth only {statistic.samples:.0f} independent samples of it, too few to say that this lies "
        f"within {_number(max(zone[0], 0.0))} to {_number(zone[1])}, or that it does not"
    )


def _claims_too_much(statistic: Statistic) -> bool:
    """Whether one that contradicts the filter says that it errs more than it claims."""
    below = statistic.high < statistic.zone[0]
    return below if statistic.kind == "share" else not below


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
