"""Which of several motions is the camera's, where part of what is seen moves: by what is known besides the matches.

Each group of matches agrees on a motion x. The probability that group h stands still, and the others move, is

    P(h) ∝ n_h · N(x_h; expected) · p(map | x_h),    Mathematics (vo-static).

Each match is as likely as any other to be of what stands still: n_h. The groups' own likelihoods are the same whichever
of them stands still, and so are the volumes that they leave open; what moves may move by as much as a camera may. That
none of them stands still is one case more, as likely as a single match: then the motion is only expected.
"""

from collections.abc import Callable, Sequence

import numpy as np

from rbpf import gaussian
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry

Known = Callable[[Odometry], float]
"""Log-density of what else is known of the place, as a map, after an increment; up to a constant."""


def nothing_known(increment: Odometry) -> float:
    """Of a camera without a map."""
    return 0.0


def camera_motion(counts: Sequence[int], laws: Sequence[Odometry], expected: Odometry, known: Known) -> int:
    """Number of the most probable motion; −1 where it is none of them.

    Args:
        counts: (M,) matches that agree on each.
        laws: (M,) of each, with its covariance.
        expected: before anything was seen.
        known: of the place.
    """
    none = -0.5 * SE3.dim + known(expected)
    scores = [none, *map(_score, counts, laws, [expected] * len(laws), [known] * len(laws))]
    return int(np.argmax(scores)) - 1


def _score(count: int, law: Odometry, expected: Odometry, known: Known) -> float:
    off = SE3.local(expected.delta, law.delta)
    white = gaussian.solve_lower(gaussian.cholesky(expected.cov), off)
    return float(np.log(count) - 0.5 * white @ white) + known(law)
