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
        # Those that say that it errs more than it claims.
        daring = [s for s in against if (s.high < s.zone[0]) == (s.kind == "share")]
        worst = max(daring or against, key=_distance)
        leaning: Leaning = "over-confident" if daring else "cautious"
        return Verdict(accuracy, "do not trust", described(worst) + more, leaning)
    judging = [s for s in statistics if s.name in independent]
    support = [s for s in judging if s.outcome == "supports"]
    if support:
        return Verdict(accuracy, "trust", described(support[0]))
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
    if value <= 0.0:
        side = "far too large"
    elif abs(np.log(_root(value))) <= np.log(1.1):
        side = "right within a tenth"
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
