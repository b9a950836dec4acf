"""The reprojection error of matched points as a function of the motion between two stereo frames (S05 (14)).

Both measurements are noisy, z⁻ = m + v⁻ and z = g(T, m) + v ({py:mod}`rbpf.motion.stereo_geometry`). About any m̂,
eliminating m leaves

    ν = z − g(T, m̂) − A (z⁻ − m̂),   A = ∂g/∂m,   cov ν = S = R + A R⁻ Aᵀ

by Mathematics (vo-innovation). A R⁻ Aᵀ is J_P C J_Pᵀ with the covariance C of the earlier point in space. `Points`
says which m̂: by default that of least Mathematics (vo-profile).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from rbpf import gaussian
from rbpf.lie import Array
from rbpf.motion.stereo_geometry import Matches, Seen, homography, lens, see

Points = Literal["adjusted", "propagated", "exact"]
"""What the earlier frame's points are taken for.

- adjusted: unknown as well, m̂ minimises ‖z⁻ − m‖² + ‖z − g(T, m)‖², each under its covariance. The minimum over T then
  is that of the bundle adjustment of both frames, and JᵀS⁻¹J the Schur complement of its information.
- propagated: where they were measured, m̂ = z⁻, with their covariance in S.
- exact: where they were measured, without error, S = R: the paper's.
"""

SWEEPS, SWEPT_PX = 10, 1e-4
"""Of the adjustment of m̂: most of them, and the last one's change. g is nearly linear: two or three do."""


@dataclass(frozen=True)
class Innovation:
    """ν and what goes with it.

    Attributes:
        nu: (K, 3), infinite where a point would be behind the camera.
        cov: (K, 3, 3) S.
        pixels: (K, 3) m̂.
        seen: g at m̂, and its derivatives.
    """

    nu: Array
    cov: Array
    pixels: Array
    seen: Seen

    def white_rows(self) -> Array:
        """L⁻¹ [ν, −∂g/∂ξ] (K, 3, 7) with S = L Lᵀ; zeros for a point behind the camera."""
        both = np.concatenate([self.nu[..., None], -self.seen.by_motion], axis=-1)
        both = np.where(self.seen.front[:, None, None], both, 0.0)
        return np.asarray(gaussian.solve_lower_matrix(gaussian.cholesky(self.cov), both))


class WhiteRows(NamedTuple):
    """What the compiled twin of `innovation` returns.

    Attributes:
        rows: (K, 3, 7) `Innovation.white_rows`.
        front: (K,) `Seen.front`.
        pixels: (K, 3) m̂.
    """

    rows: Array
    front: np.ndarray
    pixels: Array


def residuals(matches: Matches, delta: Array, points: Points) -> tuple[Array, Array]:
    """Whitened residuals (3K,) and their derivative (3K, 6) by the motion, for least squares (compiled).

    Infinite where a point would be behind the camera.
    """
    found = white_rows(matches, delta, points)
    if not found.front.all():
        return np.full(3 * len(matches), np.inf), np.zeros((3 * len(matches), 6))
    flat = found.rows.reshape(-1, 7)
    return flat[:, 0].copy(), flat[:, 1:].copy()


def squared_distances(matches: Matches, delta: Array, points: Points) -> Array:
    """Squared Mahalanobis distances (K,) from a motion, infinite for points behind the camera (compiled)."""
    found = white_rows(matches, delta, points)
    return np.where(found.front, np.square(found.rows[..., 0]).sum(axis=-1), np.inf)


def white_rows(matches: Matches, delta: Array, points: Points) -> WhiteRows:
    """The innovation at a motion, whitened (compiled)."""
    from rbpf.motion import stereo_kernels

    count = len(matches)
    found = WhiteRows(np.empty((count, 3, 7)), np.empty(count, dtype=bool), np.empty((count, 3)))
    stereo_kernels.white_rows(
        homography(matches.camera, delta),
        lens(matches.camera),
        *(matches.z_prev, matches.z_now, matches.cov_prev, matches.cov_now),
        points != "exact",
        SWEEPS if points == "adjusted" else 0,
        SWEPT_PX,
        *found,
    )
    return found


def innovation(matches: Matches, delta: Array, points: Points) -> Innovation:
    """ν at a motion T = `delta` (7,), with m̂ as `points` says."""
    found = linearised(matches, delta, matches.z_prev, points)
    for _ in range(SWEEPS if points == "adjusted" else 0):
        # m̂ = z⁻ + R⁻ Aᵀ S⁻¹ ν: the linearised problem's minimum.
        nu = np.where(found.seen.front[:, None], found.nu, 0.0)
        gained = found.seen.by_pixels.mT @ np.linalg.solve(found.cov, nu[..., None])
        pixels = matches.z_prev + (matches.cov_prev @ gained)[..., 0]
        change = np.abs(pixels - found.pixels)[found.seen.front].max(initial=0.0)
        found = linearised(matches, delta, pixels, points)
        if change <= SWEPT_PX:
            break
    return found


def linearised(matches: Matches, delta: Array, pixels: Array, points: Points) -> Innovation:
    """ν at a motion (7,), linearised about m̂ = `pixels` (K, 3)."""
    seen = see(matches.camera, delta, pixels)
    off = (seen.by_pixels @ (matches.z_prev - pixels)[..., None])[..., 0]
    nu = np.where(seen.front[:, None], matches.z_now - seen.pixels - off, np.inf)
    cov = matches.cov_now
    if points != "exact":
        cov = cov + seen.by_pixels @ matches.cov_prev @ seen.by_pixels.mT
    return Innovation(nu, cov, pixels, seen)
