"""Pixels of a rectified stereo pair, matches of two pairs, and their reprojection error as a function of the motion.

A homogeneous point X = (x, y, z, ρ) in the left camera's frame, at (x, y, z) / ρ, and its pixels m = (u_left, v,
u_right) are related by (m, 1) ~ Q X. A point seen at m is seen after a motion T = previous_camera_from_camera at g with

    (g, 1) ~ H (m, 1),    H = Q T⁻¹ Q⁻¹,    Mathematics (vo-homography),

a homography, which stays valid where noise makes the disparity of a far point negative.

The measurements are z⁻ = m + v⁻ and z = g(T, m) + v. Linearised about m̂, eliminating m leaves S05 (14) as

    ν = z − g(T, m̂) − A (z⁻ − m̂),   A = ∂g/∂m,   cov ν = S = R + A R⁻ Aᵀ,    Mathematics (vo-innovation).

`Points` says which m̂: by default the minimiser of Mathematics (vo-profile).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbpf import gaussian
from rbpf.arrays import RowByRow
from rbpf.errors import InputError
from rbpf.lie import SE3, Array, skew

Points = Literal["adjusted", "propagated", "exact"]
"""How the earlier frame's points are treated.

- adjusted: also unknown, m̂ minimises ‖z⁻ − m‖² + ‖z − g(T, m)‖², each under its covariance. The minimum over T then
  is that of the bundle adjustment of both frames, and JᵀS⁻¹J the Schur complement of its information.
- propagated: fixed at their measurement, m̂ = z⁻, with its covariance in S.
- exact: fixed at their measurement, taken as exact, S = R: the paper's choice.
"""

#: Iterations that adjust m̂: their maximum number, and the change that ends them. g is nearly linear: 2 or 3 suffice.
SWEEPS, SWEPT_PX = 10, 1e-4


class StereoCamera(Protocol):
    """Two equal undistorted pinholes side by side, the left one the reference, as a `RectifiedStereo`."""

    @property
    def intrinsics(self) -> Array:
        """(5,) fx, fy, cx, cy and fx · baseline."""

    @property
    def baseline_m(self) -> float: ...
    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class Matches(RowByRow):
    """Points seen in an earlier and a later stereo frame: pixels (K, 3) (u_left, v, u_right), covariances (K, 3, 3) px²."""

    camera: StereoCamera
    z_prev: Array
    z_now: Array
    cov_prev: Array
    cov_now: Array

    @classmethod
    def checked(
        cls, camera: StereoCamera, z_prev: Array, z_now: Array, cov_prev: ArrayLike, cov_now: ArrayLike
    ) -> "Matches":
        """Matches from pixels (K, 3) and covariances (K, 3, 3), or (3, 3) for all.

        Raises InputError: a shape does not fit, a number is not finite, or a covariance is not positive definite.
        """
        before, now = (np.ascontiguousarray(z, dtype=float) for z in (z_prev, z_now))
        if before.shape != now.shape or before.shape[1:] != (3,):
            raise InputError(
                f"matches must be two (K, 3) arrays (u_left, v, u_right), got {before.shape} and {now.shape}"
            )
        if not (np.isfinite(before).all() and np.isfinite(now).all()):
            raise InputError("the pixels of the matches hold NaN or infinity: leave these matches out")
        covs = []
        for name, given in (("cov_prev", cov_prev), ("cov_now", cov_now)):
            cov = np.asarray(given, dtype=float)
            if cov.shape not in ((3, 3), (*before.shape, 3)):
                raise InputError(f"{name} must be (3, 3) or {(*before.shape, 3)}, got {cov.shape}")
            try:
                gaussian.cholesky(cov)
            except InputError as error:
                raise InputError(f"{name} is not a covariance of pixels: {error}") from error
            covs.append(np.ascontiguousarray(np.broadcast_to(cov, (*before.shape, 3))))
        return cls(camera, before, now, *covs)

    def plausible(self, gate: float) -> np.ndarray:
        """Mask (K,): no disparity is significantly negative, by more than a squared Mahalanobis distance `gate`."""
        across = np.array([1.0, 0.0, -1.0])
        kept = np.ones(len(self), dtype=bool)
        for z, cov in ((self.z_prev, self.cov_prev), (self.z_now, self.cov_now)):
            disparity, variance = z @ across, np.einsum("i,kij,j->k", across, cov, across)
            kept &= (disparity >= 0.0) | (disparity**2 <= gate * variance)
        return kept


@dataclass(frozen=True)
class Reprojection:
    """Pixels after a motion, and their derivatives."""

    pixels: Array  #: (…, 3) g.
    front: np.ndarray  #: (…) whether the point is in front of the camera, or beyond infinity.
    by_pixels: Array  #: (…, 3, 3) A = ∂g/∂m.
    by_rotation: Array  #: (…, 3, 3) ∂g/∂ω, of T Exp([ω, v]).
    by_scaled_translation: Array  #: (…, 3, 3) with ∂g/∂v = ρ · this.
    inverse_depth: Array  #: (…) ρ of m at z = 1: the inverse depth before the motion, 1/m.

    @property
    def by_motion(self) -> Array:
        """(…, 3, 6) ∂g/∂ξ, order [ω, v]: Mathematics (vo-jacobian)."""
        by_translation = self.inverse_depth[..., None, None] * self.by_scaled_translation
        return np.concatenate([self.by_rotation, by_translation], axis=-1)


@lru_cache(maxsize=16)
def projective(camera: StereoCamera) -> tuple[Array, Array]:
    """Q (4, 4), from points to pixels, and Q⁻¹ (4, 4), both read-only."""
    fx, fy, cx, cy, shift = camera.intrinsics.tolist()
    q = np.array([[fx, 0.0, cx, 0.0], [0.0, fy, cy, 0.0], [fx, 0.0, cx, -shift], [0.0, 0.0, 1.0, 0.0]])
    back = np.asarray(np.linalg.inv(q), dtype=float)
    q.flags.writeable = back.flags.writeable = False
    return q, back


def homography(camera: StereoCamera, delta: Array) -> Array:
    """H (…, 4, 4) of motions T (…, 7)."""
    q, back = projective(camera)
    return np.asarray(q @ SE3.matrix(SE3.inverse(delta)) @ back, dtype=float)


def times_pixels(matrix: Array, pixels: Array) -> Array:
    """Matrices (…, 4, 4) times (m, 1), (…, k, 3) → (…, k, 4)."""
    return pixels @ matrix[..., :3].mT + matrix[..., None, :, 3]


def reproject(camera: StereoCamera, delta: Array, pixels: Array) -> Reprojection:
    """Reprojects points seen at `pixels` (…, k, 3) after motions T (…, 7), broadcast over the leading axes."""
    (q, back), matrix = projective(camera), homography(camera, delta)
    raised = times_pixels(matrix, pixels)
    front = raised[..., 3] > 0.0
    raised = np.where(front[..., None], raised, [0.0, 0.0, 0.0, 1.0])
    depth = raised[..., 3, None]
    seen = raised[..., :3] / depth
    # (m, 1) ~ Q X has z as its last entry, here and after the motion.
    point = raised @ back.T
    slope = (q[:3, :3] - seen[..., None] * np.array([0.0, 0.0, 1.0])) / depth[..., None]
    by_pixels = matrix[..., None, :3, :3] - seen[..., None] * matrix[..., None, None, 3, :3]
    by_pixels = by_pixels / depth[..., None]
    return Reprojection(seen, front, by_pixels, slope @ skew(point[..., :3]), -slope, point[..., 3])


def residuals(matches: Matches, delta: Array, points: Points) -> tuple[Array, Array]:
    """Whitened residuals (3K,) and their derivative (3K, 6) by the motion, for least squares (compiled).

    Infinite where a point would be behind the camera.
    """
    rows, front, _ = white_rows(matches, delta, points)
    if not front.all():
        return np.full(3 * len(matches), np.inf), np.zeros((3 * len(matches), 6))
    flat = rows.reshape(-1, 7)
    return flat[:, 0].copy(), flat[:, 1:].copy()


def squared_distances(matches: Matches, delta: Array, points: Points) -> Array:
    """Squared Mahalanobis distances (K,) from a motion, infinite for points behind the camera (compiled)."""
    from rbpf.motion import stereo_kernels

    squared = np.empty(len(matches))
    stereo_kernels.distances(*_arguments(matches, delta, points), squared)
    return squared


def white_rows(matches: Matches, delta: Array, points: Points) -> tuple[Array, np.ndarray, Array]:
    """The innovations at a motion, with m̂ as `points` says, whitened (compiled).

    Returns:
        L⁻¹ [ν, −∂g/∂ξ] (K, 3, 7) with S = L Lᵀ, zeros for a point behind the camera; `Reprojection.front` (K,); m̂ (K, 3).
    """
    from rbpf.motion import stereo_kernels

    count = len(matches)
    found = np.empty((count, 3, 7)), np.empty(count, dtype=bool), np.empty((count, 3))
    matrix, *others = _arguments(matches, delta, points)
    stereo_kernels.white_rows(matrix, matches.camera.intrinsics, *others, *found)
    return found


def _arguments(matches: Matches, delta: Array, points: Points) -> tuple[Any, ...]:
    """Arguments of the compiled functions, without the camera's."""
    given = matches.z_prev, matches.z_now, matches.cov_prev, matches.cov_now
    sweeps = SWEEPS if points == "adjusted" else 0
    return homography(matches.camera, delta), *given, points != "exact", sweeps, SWEPT_PX


def linearised(matches: Matches, delta: Array, pixels: Array, points: Points) -> tuple[Array, Reprojection]:
    """S (K, 3, 3) at a motion (7,), linearised about m̂ = `pixels` (K, 3), and g there with its derivatives."""
    seen = reproject(matches.camera, delta, pixels)
    if points == "exact":
        return matches.cov_now, seen
    return matches.cov_now + seen.by_pixels @ matches.cov_prev @ seen.by_pixels.mT, seen
