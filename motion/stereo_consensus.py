"""The motion that most matches of two stereo frames agree with, from triples of them (RANSAC).

M. Fischler and R. Bolles (1981); the truncated score is that of P. Torr and A. Zisserman (2000). Aligning the points of a
triple gives a motion of any size, which is refined on their pixels: the 3D positions of far points are too uncertain for
the alignment alone.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rbpf import gaussian
from rbpf.lie import SE3, Array
from rbpf.motion.stereo_geometry import Matches, homography, projective, times_pixels
from rbpf.ranges import Formerly, Probability, Range, Ranged

REFINEMENTS = 2  #: Gauss-Newton steps on the nine pixels of a triple.
FARTHEST = 1e4  #: Largest depth given to a point for the alignment, in baselines.


@dataclass(frozen=True)
class RansacConfig(Ranged):
    """How many triples of matches are tried."""

    batch: Annotated[int, Range(ge=1, le=10000)] = 32  #: triples per batch.
    max_triples: Annotated[int, Range(ge=1, le=1000000), Formerly("most")] = 512  #: triples over all batches.
    #: probability with which at least one triple is free of false matches, given the fraction of matches that agree with
    #: the best motion so far.
    confidence: Annotated[Probability, Formerly("certainty")] = 0.9999

    def needed(self, fraction: float) -> float:
        """Number of triples needed if this fraction of the matches is right."""
        spoilt = 1.0 - min(fraction, 1.0 - 1e-9) ** 3
        return float(np.log1p(-self.confidence) / np.log(spoilt)) if spoilt < 1.0 else np.inf


def consensus(
    matches: Matches, start: Array, gate: float, rng: np.random.Generator, config: RansacConfig | None = None
) -> Array:
    """The motion (7,) of the lowest truncated score Σ min(d², gate), from triples that `rng` draws.

    `start` is a guess of the motion; it competes with the triples' motions, and so does zero motion. The distances d are
    Mahalanobis distances under the sum of both frames' covariances, which is enough to rank motions.
    """
    config, search = config or RansacConfig(), _Search(matches, start)
    best, lowest, fraction = start, np.inf, 0.0
    motions, batch, tried = np.stack([start, SE3.identity()]), config.batch, 0
    while tried < config.max_triples and tried <= config.needed(fraction):
        # The number drawn doubles each time, so that few are drawn in vain; the stopping rule is checked batch by batch.
        before = rng.bit_generator.state
        count = batch * min(max(tried // batch, 1), -(-(config.max_triples - tried) // batch))
        found = search.candidates(triples(len(matches), count, rng))
        motions = np.concatenate([motions, found]) if tried == 0 else found
        scores, fractions = search.scores(motions, gate)
        last = tried + count
        for end in range(len(motions) - count + batch, len(motions) + 1, batch):
            first = int(scores[:end].argmin())
            if scores[first] < lowest:
                best, lowest, fraction = motions[first], scores[first], float(fractions[first])
            tried += batch
            if tried > config.needed(fraction):
                break
        if tried < last:
            rng.bit_generator.state = before
            triples(len(matches), count - (last - tried), rng)
    return best


def triples(count: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Triples (n, 3) of different numbers below `count`, all equally likely."""
    first, second, third = rng.integers([count, count - 1, count - 2], size=(n, 3)).T
    second = second + (second >= first)
    low, high = np.minimum(first, second), np.maximum(first, second)
    third = third + (third >= low)
    return np.stack([first, second, third + (third >= high)], axis=1)


class _Search:
    """What all candidate motions share."""

    def __init__(self, matches: Matches, start: Array) -> None:
        self.matches, self.start = matches, np.ascontiguousarray(start, dtype=float)
        # Triangulated points of both frames; those with no positive disparity are put at a large finite depth.
        raised = times_pixels(projective(matches.camera)[1], np.stack([matches.z_prev, matches.z_now]))
        nearest = 1.0 / (FARTHEST * matches.camera.baseline_m)
        self.before, self.now = raised[..., :3] / np.maximum(raised[..., 3:], nearest)
        # W = L⁻¹ with L Lᵀ = R⁻ + R.
        chol = gaussian.cholesky(matches.cov_prev + matches.cov_now)
        self.white = np.ascontiguousarray(gaussian.solve_lower_matrix(chol, np.eye(3)))

    def candidates(self, rows: np.ndarray) -> Array:
        """Motions (C, 7) of triples (C, 3): aligned, or the start where that is better, and refined (compiled)."""
        from rbpf.motion.stereo_kernels import propose

        matches, motions = self.matches, np.empty((len(rows), 7))
        pixels = (matches.z_prev, matches.z_now, self.white, matches.camera.intrinsics)
        propose(rows, self.before, self.now, *pixels, self.start, REFINEMENTS, motions)
        return motions

    def scores(self, motions: Array, gate: float) -> tuple[Array, Array]:
        """Σ min(d², gate) (C,) of motions (C, 7) over all matches, and the fractions (C,) that agree (compiled)."""
        from rbpf.motion.stereo_kernels import scores

        matches = self.matches
        score, agreeing = np.empty(len(motions)), np.empty(len(motions))
        scores(homography(matches.camera, motions), matches.z_prev, matches.z_now, self.white, gate, score, agreeing)
        return score, agreeing / len(matches)
