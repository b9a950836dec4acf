"""Which of several motions is the camera's, where part of what is seen moves: by what is known besides the matches.

Each group of matches agrees on a motion x. The probability that group h stands still, and the others move, is

    P(h) ∝ (1 + n_h) · N(x_h; expected) · p(map | x_h) · B(h),    Mathematics (vo-static).

Of n_h matches nothing is known, each is as likely as any other to be of what stands still. B is the group's past: what
stood still goes on to do so, and what moved to move, but for a fraction of the matches that are mistaken, and for things
that begin or stop. The groups' own likelihoods are the same whichever of them stands still, and so are the volumes that
they leave open; what moves may move by as much as a camera may. That none of them stands still is one case more, as
likely as one match more.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry

MISTAKEN = 0.1
"""Share of matches: 4 and 10 % between the pairs of two recordings (how_to/stereo_features)."""

CHANGES = 0.01
"""Share of pairs in which a thing begins to move or stops."""


def _nothing(increment: Odometry) -> float:
    return 0.0


@final
@dataclass(frozen=True)
class Known:
    """What is known besides the matches of two frames; by default nothing.

    Attributes:
        log_density: of a map's landmarks in the later frame, after an increment; up to a constant.
        stood: (K,) of each match 1 if it stood still in the earlier frame, −1 if it moved, 0 where that is not known.
        hidden: whether nothing in the earlier frame stood still.
    """

    log_density: Callable[[Odometry], float] = _nothing
    stood: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int8))
    hidden: bool = False

    def contradicts(self, agree: np.ndarray) -> bool:
        """Whether the matches (K,) of a motion are not those that stood still before."""
        if not self.stood.size:
            return False
        still = self.stood > 0
        few = (still & agree).sum() < (still & ~agree).sum()
        return bool(self.hidden or few or self.stood[agree].sum() < 0)

    def fresh(self, groups: np.ndarray) -> np.ndarray:
        """How many matches of groups (M, K) have no past, (M,)."""
        chosen = groups & (self.stood == 0) if self.stood.size else groups
        return np.asarray(chosen.sum(axis=1))

    def log_past(self, group: np.ndarray) -> float:
        """Log B of a group (K,): bounded, for a thing begins or stops as a whole."""
        odds = np.log((1.0 - MISTAKEN) / MISTAKEN) * self.stood[group].sum() if self.stood.size else 0.0
        kept, changed = np.log1p(-CHANGES), np.log(CHANGES)
        return float(np.logaddexp(kept, changed - odds) - np.logaddexp(kept - odds, changed))


def camera_motion(
    groups: np.ndarray, laws: Sequence[Odometry], known: Known, expected: Odometry, trusted: bool
) -> int:
    """Number of the most probable motion; −1 where it is none of them.

    Args:
        groups: (M, K) which matches agree on each; none on several.
        laws: (M,) of each, with its covariance.
        known: of the map, and of the matches.
        expected: before anything was seen.
        trusted: whether that follows from a velocity that was measured; before, any motion is as likely.
    """
    everyone = [*groups, ~groups.any(axis=0)]
    scores = np.array([known.log_past(group) for group in everyone])
    scores += [known.log_density(law) for law in (*laws, expected)]
    none = scores[-1] + np.log((1.0 - CHANGES) / CHANGES) * known.hidden
    scores = scores[:-1] + np.log1p(known.fresh(groups))
    if not trusted:
        return int(np.argmax(scores)) if scores.max() >= none else -1
    chol = gaussian.cholesky(expected.cov)
    off = [gaussian.solve_lower(chol, SE3.local(expected.delta, law.delta)) for law in laws]
    best = int(np.argmax(scores - 0.5 * np.square(off).sum(axis=1)))
    return best if scores[best] >= none else -1
