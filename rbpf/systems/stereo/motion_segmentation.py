"""Which of several motions is the camera's, and which features stand still, where part of the view moves.

Each group of matches agrees on a motion x. The probability that group h stands still, and the others move, is

    P(h) ∝ (1 + n_h) · N(x_h; prior) · p(map | x_h) · B(h),    Mathematics (vo-static).

Of n_h matches nothing is known, each is as likely as any other to be of what stands still. B is the group's past: what
stood still goes on to do so, and what moved to move, but for a fraction of the matches that are mistaken, and for things
that begin or stop. The groups' own likelihoods are the same whichever of them stands still, and so are the volumes that
they leave open; what moves may move by as much as a camera may. That none of them stands still is one case more, as
likely as one match more.

A feature is labelled 1 if it stood still in its pair, −1 if it moved, 0 where that is not known; matches carry labels
from one pair to the next.
"""

from collections.abc import Sequence

import numpy as np

from rbpf import gaussian
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_vo import MotionEstimate

STATIC, UNKNOWN, MOVING = 1, 0, -1  #: Labels of features.
MISTAKEN = 0.1  #: Fraction of matches: 4 and 10 % between the pairs of two recordings (how_to/stereo_features).
CHANGES = 0.01  #: Fraction of pairs in which a thing begins to move or stops.


def contradicts(inliers: np.ndarray, labels: np.ndarray, hidden: bool) -> bool:
    """Whether the matches (K,) that agree on a single motion are not those that stood still in the earlier pair.

    `labels` (K,) are those of the earlier pair; where it is `hidden`, nothing in it stood still.
    """
    if not labels.size:
        return False
    static = labels == STATIC
    few = (static & inliers).sum() < (static & ~inliers).sum()
    return bool(hidden or few or labels[inliers].sum() < 0)


def camera_motion(
    candidates: Sequence[MotionEstimate],
    prior: Odometry | None,
    labels: np.ndarray,
    hidden: bool,
    log_support: np.ndarray,
) -> int:
    """Number of the candidate that most probably is the camera's motion; −1 where none of them is.

    Args:
        candidates: M motions.
        prior: what was expected by a velocity that was measured; None before, where any motion is as likely.
        labels: (K,) of the matches in the earlier pair.
        hidden: whether nothing in the earlier pair stood still.
        log_support: (M + 1,) log-density of the map's landmarks in the later pair under each candidate, and under the
            prior alone; up to a constant. Zeros where there is no map.
    """
    groups = np.array([motion.inliers for motion in candidates])
    scores = np.array([_log_past(labels[group]) for group in (*groups, ~groups.any(axis=0))]) + log_support
    none = scores[-1] + np.log((1.0 - CHANGES) / CHANGES) * hidden
    scores = scores[:-1] + np.log1p((groups & (labels == UNKNOWN)).sum(axis=1))
    plausible = scores
    if prior is not None:
        chol = gaussian.cholesky(prior.cov)
        off = [SE3.local(prior.delta, motion.odometry.delta) for motion in candidates]
        plausible = scores - 0.5 * np.square([gaussian.solve_lower(chol, one) for one in off]).sum(axis=1)
    best = int(np.argmax(plausible))
    return best if scores[best] >= none else -1


def _log_past(labels: np.ndarray) -> float:
    """Log B of a group with these labels: bounded, for a thing begins or stops as a whole."""
    odds = np.log((1.0 - MISTAKEN) / MISTAKEN) * labels.sum()
    kept, changed = np.log1p(-CHANGES), np.log(CHANGES)
    return float(np.logaddexp(kept, changed - odds) - np.logaddexp(kept - odds, changed))
