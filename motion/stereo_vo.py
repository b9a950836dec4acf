"""Visual odometry: how a stereo camera has moved between two frames, from points seen in both (S05 §III-C).

A consensus of triples separates true from false matches; Levenberg-Marquardt on the reprojection error of those that
agree finds the motion, and what they leave open about it is its covariance. In three respects this is not the paper's
method, which `points="exact"` gives: the earlier points are estimated together with the motion, both images of the
later pair count, and the covariance includes the earlier points' noise.
"""

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.core.least_squares import Minimum, Rule, minimise
from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.motion.stereo_consensus import Draws, consensus
from rbpf.motion.stereo_covariance import consistent_covariance, trimming
from rbpf.motion.stereo_geometry import Matches, StereoCamera
from rbpf.motion.stereo_matches import checked_matches, possible
from rbpf.motion.stereo_reprojection import (
    Points,
    innovation,
    linearised,
    residuals,
    squared_distances,
    white_rows,
)

ROUNDS = 5
"""Of optimising and choosing anew which matches agree; it ends when they stay the same."""

REWEIGHTED = 3
"""Times that S is formed anew for propagated points."""

WIDE = 4.0
"""Times the gate is what agrees with the consensus of three: it is not yet the motion of all."""


@final
@dataclass(frozen=True)
class VoConfig:
    """How a motion is estimated.

    Attributes:
        points: what the earlier points are taken for, see `rbpf.motion.stereo_reprojection.Points`.
        gate: squared Mahalanobis distance beyond which a match is false; 99 % of the true ones are within, χ² with
            three degrees of freedom.
        least_matches: fewer that agree are no motion.
        draws: of triples.
        rule: when the optimiser stops; the default is a hundredth of the motion's standard deviations.
    """

    points: Points = "adjusted"
    gate: float = 11.345
    least_matches: int = 8
    draws: Draws = field(default_factory=Draws)
    rule: Rule = field(default_factory=lambda: Rule(offset=0.01, iterations=100))

    def __post_init__(self) -> None:
        """Checks that the numbers make sense."""
        if self.points not in ("adjusted", "propagated", "exact"):
            raise InputError(f"points must be adjusted, propagated or exact, got {self.points!r}")
        if not self.gate > 0.0:
            raise InputError(f"the gate of visual odometry must be positive, got {self.gate}")
        if self.least_matches < 3:
            raise InputError(f"a motion needs at least 3 matches that agree, got {self.least_matches}")


@final
@dataclass(frozen=True, eq=False)
class MotionEstimate:
    """The motion between two stereo frames.

    Attributes:
        previous_camera_from_camera: (7,) increment; the start where none was found.
        cov: (6, 6) in the right chart there, order [ω, v]; NaN where none was found.
        inliers: (K,) bool, matches that agree with it.
        rms: root mean square of the inliers' whitened residuals, 1 expected: with their degrees of freedom, and with
            what the gate cuts off made up for.
        iterations: of the optimiser.
        failure: why no motion was found, in words; empty where one was.
        others: motions that matches far from this one agree on, as those on a thing that moves, each with its own
            inliers; false matches agree on none.
    """

    previous_camera_from_camera: Array
    cov: Array
    inliers: np.ndarray
    rms: float
    iterations: int
    failure: str = ""
    others: tuple["MotionEstimate", ...] = ()

    @property
    def found(self) -> bool:
        """Whether there is a motion."""
        return not self.failure

    @property
    def elsewhere(self) -> int:
        """Number of matches that agree on other motions."""
        return int(sum(other.inliers.sum() for other in self.others))


def estimate_motion(
    camera: StereoCamera,
    z_prev: Array,
    z_now: Array,
    cov_prev: ArrayLike,
    cov_now: ArrayLike,
    rng: np.random.Generator,
    start: Array | None = None,
    config: VoConfig | None = None,
) -> MotionEstimate:
    """The motion of a rectified stereo camera between two frames.

    Args:
        camera: of both frames.
        z_prev: (K, 3) pixels (u_left, v, u_right) of the matches in the earlier frame.
        z_now: (K, 3) pixels of the same points in the later one.
        cov_prev: covariance of the earlier pixels [px²], (K, 3, 3), or (3, 3) for all.
        cov_now: of the later ones.
        rng: draws the triples; the same state gives the same bytes.
        start: (7,) a guess of the increment; by default none, the camera stands still.
        config: how.

    Returns:
        The estimate. Where matches are too few or do not agree, its `failure` says so.

    Raises:
        InputError: a shape does not fit, a number is not finite, or a covariance is not positive definite.
    """
    config, start = config or VoConfig(), SE3.identity() if start is None else np.asarray(start, dtype=float)
    matches = checked_matches(camera, z_prev, z_now, cov_prev, cov_now)
    real, complaint = possible(matches, config.gate)
    if real.sum() < config.least_matches:
        return _failed(start, matches, f"{complaint}, {config.least_matches} are needed")
    motion = consensus(matches.rows(real), start, config.gate, rng, config.draws)
    found = _refined(matches, real, motion, start, config)
    return replace(found, others=_others(matches, real, found, config, rng)) if found.found else found


def fit(matches: Matches, start: Array, config: VoConfig) -> Minimum[Array]:
    """The motion (7,) of least reprojection error near a start, all matches taken as true.

    Args:
        matches: three or more.
        start: (7,).
        config: how.
    """
    if config.points != "propagated":
        return _minimum(matches, start, config.points, config.rule)
    for _ in range(REWEIGHTED):
        # S as it is at the last motion takes the place of R, and stays while the motion is sought.
        weighted = replace(matches, cov_now=innovation(matches, start, "propagated").cov)
        found = _minimum(weighted, start, "exact", config.rule)
        start = found.x
    return found


def _minimum(matches: Matches, start: Array, points: Points, rule: Rule) -> Minimum[Array]:
    return minimise(lambda motion: residuals(matches, motion, points), start, SE3.retract, rule)


def _refined(
    matches: Matches, real: np.ndarray, motion: Array, start: Array, config: VoConfig
) -> MotionEstimate:
    """The motion of all matches that agree, from one that many agree with."""
    agreeing, iterations = real & (_squared(matches, motion, config) <= WIDE * config.gate), 0
    for _ in range(ROUNDS):
        if agreeing.sum() < config.least_matches:
            agree = f"{agreeing.sum()} of {len(matches)} matches agree on a motion"
            return _failed(start, matches, f"{agree}, {config.least_matches} are needed")
        inliers, part = agreeing, matches.rows(agreeing)
        found = fit(part, motion, config)
        motion, iterations = found.x, iterations + found.iterations
        agreeing = real & (_squared(matches, motion, config) <= config.gate)
        if (agreeing == inliers).all():
            break
    if not found.converged:
        return _failed(start, matches, f"the optimiser did not converge in {iterations} iterations")
    rms = np.sqrt(trimming(config.gate) * found.squared / max(len(found.residual) - 6, 1))
    return MotionEstimate(motion, _covariance(part, found, config), inliers, float(rms), iterations)


def _others(
    matches: Matches, left: np.ndarray, found: MotionEstimate, config: VoConfig, rng: np.random.Generator
) -> tuple[MotionEstimate, ...]:
    """Other motions that matches agree on; those just outside a gate belong to the motion that was found first."""
    others = list[MotionEstimate]()
    while found.found:
        squared = _squared(matches, found.previous_camera_from_camera, config)
        left = left & (squared > WIDE * config.gate)
        if left.sum() < config.least_matches:
            break
        far, inliers = matches.rows(left), np.zeros(len(matches), dtype=bool)
        motion = consensus(far, SE3.identity(), config.gate, rng, config.draws)
        found = _refined(far, np.ones(len(far), dtype=bool), motion, motion, config)
        inliers[np.flatnonzero(left)[found.inliers]] = True
        if found.found:
            found = replace(found, inliers=inliers)
            others.append(found)
    return tuple(others)


def _squared(matches: Matches, motion: Array, config: VoConfig) -> Array:
    """Squared distances (K,) of the matches from a motion; the paper's points have no noise, but their matches do."""
    points: Points = "propagated" if config.points == "exact" else config.points
    return squared_distances(matches, motion, points)


def _covariance(matches: Matches, found: Minimum[Array], config: VoConfig) -> Array:
    if config.points == "exact":
        return found.cov
    if config.points == "propagated":
        return trimming(config.gate) * found.cov
    pixels = white_rows(matches, found.x, "adjusted").pixels
    adjusted = linearised(matches, found.x, pixels, "adjusted")
    return trimming(config.gate) * consistent_covariance(matches, adjusted, found.factor)


def no_motion(found: MotionEstimate, why: str) -> MotionEstimate:
    """An estimate taken back."""
    nobody = np.zeros_like(found.inliers)
    return MotionEstimate(
        found.previous_camera_from_camera, np.full((6, 6), np.nan), nobody, float("nan"), 0, why
    )


def _failed(start: Array, matches: Matches, why: str) -> MotionEstimate:
    nobody = np.zeros(len(matches), dtype=bool)
    return MotionEstimate(start, np.full((6, 6), np.nan), nobody, float("nan"), 0, why)
