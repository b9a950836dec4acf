"""How certain a motion is that was found from two stereo frames.

(JᵀS⁻¹J)⁻¹ at the solution is the usual answer, and too small where points are far: the translation's derivative is
proportional to the inverse depth ρ̂, and the square of a noisy ρ̂ is larger than that of the true one by var ρ̂, on
average. With the information I = Σ JᵀS⁻¹J as found and D = Σ var ρ̂ (∂J/∂ρ)ᵀS⁻¹(∂J/∂ρ), the derivative of the score
is I − D while the score itself has the covariance I, because ν is independent of m̂. Hence (W. Fuller 1987, §3.2)

    cov = (I − D)⁻¹ I (I − D)⁻¹,    Mathematics (vo-covariance).

Leaving out what lies beyond a gate costs true matches, and the farthest, which speak most: the rest determines the
motion less well than as many that were not chosen would.
"""

import math

import numpy as np

from rbpf.lie import Array
from rbpf.motion.stereo_geometry import Matches
from rbpf.motion.stereo_reprojection import Innovation

LEAST_KEPT = 0.05
"""No direction keeps less of I than this in I − D: where nearly all is noise, what is left cannot be told from it."""


def consistent_covariance(matches: Matches, found: Innovation, factor: Array) -> Array:
    """Covariance (6, 6) of the motion, in the right chart there.

    Args:
        matches: that it was found from.
        found: their innovation at the solution, points adjusted.
        factor: (6, 6) F with F Fᵀ = I⁻¹.
    """
    noise = factor.T @ _noise(matches, found) @ factor
    lost, axes = np.linalg.eigh(0.5 * (noise + noise.T))
    half = factor @ axes / np.maximum(1.0 - lost, LEAST_KEPT)
    return half @ half.T


def _noise(matches: Matches, found: Innovation) -> Array:
    """D (6, 6)."""
    seen = found.seen
    # ρ = (u_left − u_right) / (f b), of the pixels m̂: cov m̂ = R⁻ − R⁻Aᵀ S⁻¹ A R⁻.
    shift = matches.camera.camera.fx * matches.camera.baseline_m
    across = matches.cov_prev @ (np.array([1.0, 0.0, -1.0]) / shift)
    gain = seen.by_pixels @ across[..., None]
    solved = np.linalg.solve(found.cov, np.concatenate([gain, seen.by_nearness], axis=-1))
    variance = (across[:, 0] - across[:, 2]) / shift - (gain * solved[..., :1]).sum(axis=(1, 2))
    noise = np.zeros((6, 6))
    scaled = variance[:, None, None] * seen.by_nearness
    noise[3:, 3:] = scaled.reshape(-1, 3).T @ solved[..., 1:].reshape(-1, 3)
    return noise


def trimming(gate: float) -> float:
    """Variance of a motion from the matches within a gate, beside that from as many that were not chosen.

    F₃ / F₅, the distributions of χ² with three and five degrees of freedom at the gate: rejection by ν has the
    influence function ν within the gate, the covariance E[νᵀν] / 3 = F₅ and the slope F₅ (P. Huber 1981, §4.5), for
    each match; the fraction F₃ of them is within. It is also 3 / E[ν² | within].

    Args:
        gate: squared Mahalanobis distance; infinite for none.
    """
    if math.isinf(gate):
        return 1.0
    three = math.erf(math.sqrt(0.5 * gate)) - math.sqrt(2.0 * gate / math.pi) * math.exp(-0.5 * gate)
    five = three - math.sqrt(2.0 * gate**3 / math.pi) * math.exp(-0.5 * gate) / 3.0
    return three / five
