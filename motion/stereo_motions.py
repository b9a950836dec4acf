"""Which of several motions is the camera's, where part of what is seen moves: by what is known besides the matches.

Each group of matches agrees on a motion x. The probability that group h stands still, and the others move, is

    P(h) ∝ n_h · N(x_h; expected) · p(map | x_h) · (1 / f − 1)^{l_h},    Mathematics (vo-static).

Each match is as likely as any other to be of what stands still: n_h. Of l_h matches it is known that they are of
landmarks, which stand still but for the share f of matches that are mistaken. The groups' own likelihoods are the same
whichever of them stands still, and so are the volumes that they leave open; what moves may move by as much as a camera
may. That none of them stands still is one case more, as likely as a single match; of the map alone it is believed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry


FALSE = 0.1
"""Share of matches that are mistaken: between pairs of two recordings 4 and 10 % are (how_to/stereo_features)."""

FOLLOWED = float(np.log((1.0 - FALSE) / FALSE))
"""What a landmark that is followed from the earlier frame speaks for the group in which it is found."""


def _nothing(increment: Odometry) -> float:
    return 0.0


@final
@dataclass(frozen=True)
class Known:
    """What is known besides the matches of two frames; by default nothing.

    Attributes:
        log_density: of a map's landmarks in the later frame, after an increment; up to a constant.
        mapped: (K,) matches that are of the map's landmarks.
    """

    log_density: Callable[[Odometry], float] = _nothing
    mapped: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def contradicts(self, agree: np.ndarray) -> bool:
        """Whether most of the landmarks among the matches do not agree (K,) with a motion."""
        return bool(self.mapped.any() and 2 * agree[self.mapped].sum() < self.mapped.sum())


def camera_motion(
    groups: np.ndarray, laws: Sequence[Odometry], known: Known, expected: Odometry, trusted: bool
) -> int:
    """Number of the most probable motion; −1 where it is none of them.

    Args:
        groups: (M, K) which matches agree on each; none on several.
        laws: (M,) of each, with its covariance.
        known: of the map.
        expected: before anything was seen.
        trusted: whether that follows from a velocity that was measured; before, any motion is as likely.
    """
    mapped = known.mapped if known.mapped.size else np.zeros(groups.shape[1], dtype=bool)
    nobody = ~groups.any(axis=0)
    everyone = np.vstack([groups, nobody])
    of_map = [known.log_density(law) for law in (*laws, expected)] + FOLLOWED * everyone[:, mapped].sum(axis=1)
    scores = np.log(groups.sum(axis=1)) + of_map[:-1]
    if trusted:
        chol = gaussian.cholesky(expected.cov)
        off = [gaussian.solve_lower(chol, SE3.local(expected.delta, law.delta)) for law in laws]
        scores = scores - 0.5 * np.square(off).sum(axis=1)
    best = int(np.argmax(scores))
    return -1 if of_map[-1] > of_map[best] + np.log(groups[best].sum()) else best
