"""Selects the camera's motion among several, and the static features, if part of the view moves.

Each group of matches agrees on a motion x. The probability that group h is static, and the others move, is

    P(h) ∝ (1 + n_h) · N(x_h; prior) · p(map | x_h) · B(h),    Mathematics (vo-static).

The n_h matches are equally likely a priori to be static. B is the group's past: static matches tend to stay static, and
moving ones to move, except for a fraction of wrong matches, and for objects that start or stop moving. The groups' own
likelihoods do not depend on which is static, nor do the volumes of their posteriors; moving objects may move as much as a
camera. That none of them is static is one more hypothesis, as likely as one match more.

A feature is labelled 1 if it was static in its pair, −1 if it moved, 0 if unknown; matches propagate labels
from one pair to the next.
"""

from collections.abc import Sequence

import numpy as np

from rbpf import gaussian
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_vo import MotionEstimate

STATIC, UNKNOWN, MOVING = 1, 0, -1  #: Labels of features.
MISTAKEN = 0.1  #: Fraction of wrong matches: 4 and 10 % between the pairs of two recordings (how_to/stereo_features).
CHANGES = 0.01  #: Fraction of pairs in which an object starts or stops moving.


def contradicts(inliers: np.ndarray, labels: np.ndarray, hidden: bool) -> bool:
    """Whether the inliers (K,) of a single motion are not those that were static in the earlier pair.

    `labels` (K,) are those of the earlier pair; if it is `hidden`, nothing in it was static.
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
    """Index of the candidate that is most probably the camera's motion; −1 for none.

    Args:
        candidates: M motions.
        prior: prediction from a measured velocity; None without one (uniform).
        labels: (K,) of the matches in the earlier pair.
        hidden: whether nothing in the earlier pair was static.
        log_support: (M + 1,) log-density of the map's landmarks in the later pair under each candidate, and under the
            prior alone; up to a constant. Zeros without a map.
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
    """Log B of a group with these labels: bounded, as an object starts or stops as a whole."""
    odds = np.log((1.0 - MISTAKEN) / MISTAKEN) * labels.sum()
    kept, changed = np.log1p(-CHANGES), np.log(CHANGES)
    return float(np.logaddexp(kept, changed - odds) - np.logaddexp(kept - odds, changed))
