"""The motion that most matches of two stereo frames agree with: OpenCV's random sample consensus (RANSAC).

M. Fischler and R. Bolles (1981); the truncated score is that of P. Torr and A. Zisserman (2000). A triple of the earlier
frame's points, as the later left image sees them, gives motions of any size (P3P).
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rbpf.lie import SE3, Array
from rbpf.motion.stereo_geometry import Matches, intrinsics, points_from_pixels, squared_distances, times_pixels
from rbpf.ranges import Formerly, Probability, Range, Ranged

LEAST = 4  #: Matches that OpenCV takes: three have up to four motions, the fourth chooses.
FARTHEST = 1e4  #: Baselines away at most is a point put.


@dataclass(frozen=True)
class RansacConfig(Ranged):
    """How many triples of matches are tried."""

    max_triples: Annotated[int, Range(ge=1, le=1000000), Formerly("most")] = 512  #: at most.
    #: with this probability one triple without a false match is among them, given the fraction of matches that agree
    #: with the best motion so far.
    confidence: Annotated[Probability, Formerly("certainty")] = 0.9999


def consensus(
    matches: Matches, start: Array, gate: float, rng: np.random.Generator, config: RansacConfig | None = None
) -> Array:
    """The motion (7,) of the lowest truncated score Σ min(d², gate), from triples that are drawn by a seed from `rng`.

    `start` is a guess of the motion; it takes part, and so does standing still. The distances d are Mahalanobis',
    under both frames' covariances.
    """
    motions = [start, SE3.identity(), *_sampled(matches, gate, int(rng.integers(2**31)), config or RansacConfig())]
    scores = [np.minimum(squared_distances(matches, motion, "propagated"), gate).sum() for motion in motions]
    return motions[int(np.argmin(scores))]


def _sampled(matches: Matches, gate: float, seed: int, config: RansacConfig) -> list[Array]:
    """OpenCV's motion; none where it finds none."""
    import cv2

    if len(matches) < LEAST:
        return []
    fx, fy, cx, cy, _ = intrinsics(matches.camera)
    params = cv2.UsacParams()
    params.randomGeneratorState, params.maxIterations, params.confidence = seed, config.max_triples, config.confidence
    # One radius for all matches, that of the usual one's noise; who calls refines on all that agree.
    variances = np.diagonal(matches.cov_prev + matches.cov_now, axis1=1, axis2=2)
    params.threshold = float(np.sqrt(gate * np.median(variances[:, :2])))
    params.score, params.loMethod = cv2.SCORE_METHOD_MSAC, cv2.LOCAL_OPTIM_NULL
    params.final_polisher = cv2.NONE_POLISHER
    matrix, left = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), matches.z_now[:, :2].copy()
    found, _, turn, shift, _ = cv2.solvePnPRansac(_points(matches), left, matrix, None, params=params)
    if not (found and np.isfinite(turn).all() and np.isfinite(shift).all()):
        return []
    turned = SE3.exp(np.append(turn, np.zeros(3)))
    return [SE3.inverse(np.append(turned[:4], shift))]


def _points(matches: Matches) -> Array:
    """The earlier frame's points (K, 3), those at infinity and beyond put far away."""
    raised = times_pixels(points_from_pixels(matches.camera), matches.z_prev)
    least = 1.0 / (FARTHEST * matches.camera.baseline_m)
    return raised[:, :3] / np.maximum(raised[:, 3:], least)
