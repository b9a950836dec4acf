"""Lens distortion: radial-tangential (Brown-Conrady), and equidistant for fisheye lenses (Kannala-Brandt).

Radial-tangential (D. Brown 1966, A. Conrady 1919), OpenCV's k1, k2, p1, p2, k3: with s = u² + v² and
ρ(s) = 1 + k1 s + k2 s² + k3 s³, the normalised coordinates (u, v) = (x/z, y/z) are distorted to

    u ρ(s) + 2 p1 u v + p2 (s + 2 u²),    v ρ(s) + 2 p2 u v + p1 (s + 2 v²).

Equidistant (J. Kannala and S. Brandt 2006), the k1, k2, k3, k4 of `cv2.fisheye` and of Kalibr: a direction at the angle
θ = atan |(u, v)| from the axis is imaged at the same azimuth, at the radius
θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸): Mathematics (equidistant).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, final

import numpy as np

from rbpf.arrays import Bool, Float

#: Errors of `undistort`, relative to 1 + radius, at which the iteration ends, and up to which it is accepted.
SETTLED, SOLVED = 1e-14, 1e-12
STALLED = 0.999  #: A step that leaves more than this fraction of the error ends the iteration without a solution.
ARMIJO = 0.25  #: Fraction of the decrease predicted by the derivative that a step has to achieve (L. Armijo 1966).
ITERATIONS, HALVINGS = 60, 20  #: Maximum Newton steps, for both lenses, and halvings of a step.


@final
@dataclass(frozen=True)
class RadialTangential:
    """The distortion, its derivative, its inverse and the inverse's domain."""

    coefficients: tuple[float, float, float, float, float]  #: k1, k2, p1, p2, k3.
    coefficient_names: ClassVar = ("k1", "k2", "p1", "p2", "k3")
    kind: ClassVar = 0.0
    image_radius: ClassVar = float("inf")

    @cached_property
    def is_identity(self) -> bool:
        """Whether all coefficients are zero."""
        return not any(self.coefficients)

    @cached_property
    def monotonic_radius(self) -> float:
        """Distance from the axis, in normalised coordinates, at which radial distortion stops being monotonic.

        The smallest positive root of d(r ρ(r²))/dr = 1 + 3 k1 r² + 5 k2 r⁴ + 7 k3 r⁶; infinite where there is none.
        """
        k1, k2, _, _, k3 = self.coefficients
        return _fold(k1, k2, k3)

    def distort(self, uv: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Distorted coordinates (…, 2) of normalised ones."""
        if self.is_identity:
            return uv
        k1, k2, p1, p2, k3 = self.coefficients
        u, v = uv[..., 0], uv[..., 1]
        s = u * u + v * v
        radial = 1.0 + s * (k1 + s * (k2 + s * k3))
        along = u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)
        down = v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v)
        return np.stack([along, down], axis=-1)

    def jacobian(self, uv: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2 2"]:
        """Its derivative (…, 2, 2), a symmetric matrix."""
        k1, k2, p1, p2, k3 = self.coefficients
        u, v = uv[..., 0], uv[..., 1]
        s = u * u + v * v
        radial = 1.0 + s * (k1 + s * (k2 + s * k3))
        bend = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
        across = bend * u * v + 2.0 * p1 * u + 2.0 * p2 * v
        along = radial + bend * u * u + 2.0 * p1 * v + 6.0 * p2 * u
        down = radial + bend * v * v + 6.0 * p1 * v + 2.0 * p2 * u
        return np.stack([along, across, across, down], axis=-1).reshape(*uv.shape, 2)

    def by_coefficients(self, uv: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Derivative (…, 2) by k1 and k2 of the factor that scales (u, v)."""
        s = np.square(uv).sum(axis=-1)
        return np.stack([s, s * s], axis=-1)

    def is_invertible(self, uv: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether the distortion is one-to-one up to (u, v) (…).

        Radial distortion is so within the monotonic radius; with tangential distortion its derivative must also be positive
        definite, which holds near the image if the tangential part is weak.
        """
        if self.is_identity:
            return np.isfinite(uv[..., 0]) & np.isfinite(uv[..., 1])
        slope = self.jacobian(uv)
        trace = slope[..., 0, 0] + slope[..., 1, 1]
        within = np.hypot(uv[..., 0], uv[..., 1]) < self.monotonic_radius
        return within & (trace > 0.0) & (_determinant(slope) > 0.0)

    def undistort(self, target: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 2"]:
        """Normalised coordinates (K, 2) of distorted ones, NaN if there are none."""
        if self.is_identity:
            return np.where(self.is_invertible(target)[:, None], target, np.nan)
        # Start within half of the monotonic radius: at the radius itself the derivative is singular.
        length = np.maximum(np.linalg.norm(target, axis=1, keepdims=True), np.finfo(float).tiny)
        uv = target * np.minimum(1.0, 0.5 * self.monotonic_radius / length)
        error = self._misfit(uv, target)
        active = np.flatnonzero(error > SETTLED)
        for _ in range(ITERATIONS):
            if not active.size:
                break
            reached = error[active].copy()
            # A Newton step of each, halved until it stays in the invertible range and reduces the error.
            miss = target[active] - self.distort(uv[active])
            step = (inverse(self.jacobian(uv[active])) @ miss[..., None])[..., 0]
            waiting = np.arange(active.size)
            for fraction in 0.5 ** np.arange(HALVINGS):
                if not waiting.size:
                    break
                rows = active[waiting]
                tried = uv[rows] + fraction * step[waiting]
                misfit = self._misfit(tried, target[rows])
                better = (misfit < (1.0 - ARMIJO * fraction) * error[rows]) & self.is_invertible(tried)
                uv[rows[better]], reached[waiting[better]] = tried[better], misfit[better]
                waiting = waiting[~better]
            error[active], active = reached, active[(reached > SETTLED) & (reached < STALLED * error[active])]
        found = (error <= SOLVED) & self.is_invertible(uv)
        return np.where(found[:, None], uv, np.nan)

    def _misfit(self, uv: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Distance (K,) of distorted coordinates from their targets, relative to 1 + the target's length."""
        miss = np.linalg.norm(target - self.distort(uv), axis=-1)
        return miss / (1.0 + np.linalg.norm(target, axis=-1))


def _fold(*k: float) -> float:
    """The smallest positive root x of 1 + 3 k1 x² + 5 k2 x⁴ + …; infinite where there is none."""
    # As a polynomial in 1/x² its first coefficient is 1: no division by a small last one.
    roots = np.roots([1.0, *((2 * i + 3) * each for i, each in enumerate(k))])
    positive = roots.real[(roots.imag == 0.0) & (roots.real > 0.0)]
    return float(1.0 / np.sqrt(positive.max())) if positive.size else float("inf")


def _determinant(matrix: np.ndarray) -> np.ndarray:
    """Determinants of (…, 2, 2) matrices."""
    return matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]


def inverse(matrix: Float[np.ndarray, "*batch 2 2"]) -> Float[np.ndarray, "*batch 2 2"]:
    """Inverses of symmetric (…, 2, 2) matrices."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    adjugate = np.stack([d, -b, -b, a], axis=-1).reshape(matrix.shape)
    return adjugate / _determinant(matrix)[..., None, None]


#: Largest angle from the axis that is used, less than where `rbpf.sensors.camera.points.clamp_depth` sets in: (u, v) and
#: its errors grow without bound towards 90°.
MAX_ANGLE = np.deg2rad(75.0)
#: Least ratio of depth to length of a direction, see `rbpf.sensors.camera.points.clamp_depth`; below cos MAX_ANGLE, so that
#: nothing visible is clamped.
MIN_DEPTH_FRACTION = 0.2
NEAR = 1e-16  #: Squared distance from the axis below which the lens is linear up to rounding.
ANGLE_SETTLED = 1e-15  #: A step of the angle, relative to 1, that ends the iteration of `undistort`.


@final
@dataclass(frozen=True)
class Equidistant:
    """The distortion, its derivative and its inverse; the same methods as `RadialTangential`."""

    coefficients: tuple[float, float, float, float]  #: k1, k2, k3, k4.
    coefficient_names: ClassVar = ("k1", "k2", "k3", "k4")
    kind: ClassVar = 1.0
    is_identity: ClassVar = False

    @cached_property
    def max_angle(self) -> float:
        """Largest usable angle from the axis [rad]: 75°, or less where θ_d stops being monotonic.

        That is the smallest positive root of 1 + 3 k1 θ² + 5 k2 θ⁴ + 7 k3 θ⁶ + 9 k4 θ⁸.
        """
        return min(float(MAX_ANGLE), _fold(*self.coefficients))

    @cached_property
    def monotonic_radius(self) -> float:
        """Distance from the axis, in normalised coordinates, up to which directions are visible."""
        return float(np.tan(self.max_angle))

    @cached_property
    def image_radius(self) -> float:
        """Distance from the axis, in distorted coordinates, of the edge of the image circle."""
        return float(self._rises_to(np.array(self.max_angle)))

    def distort(self, uv: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Distorted coordinates (…, 2) of normalised ones."""
        return self._scale_and_bend(uv)[0][..., None] * uv

    def jacobian(self, uv: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2 2"]:
        """Its derivative (…, 2, 2), a symmetric matrix."""
        scale, bend = self._scale_and_bend(uv)
        u, v = uv[..., 0], uv[..., 1]
        across = bend * u * v
        parts = [scale + bend * u * u, across, across, scale + bend * v * v]
        return np.stack(parts, axis=-1).reshape(*uv.shape, 2)

    def by_coefficients(self, uv: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """As of `RadialTangential`."""
        r = np.linalg.norm(uv, axis=-1)
        angle = np.arctan(r)
        per = angle**3 / np.maximum(r, np.sqrt(NEAR))
        return np.stack([per, per * angle**2], axis=-1)

    def is_invertible(self, uv: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether the direction (u, v) (…) is within `max_angle`, where the lens is one-to-one."""
        return np.hypot(uv[..., 0], uv[..., 1]) < self.monotonic_radius

    def undistort(self, target: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 2"]:
        """Normalised coordinates (K, 2) of distorted ones, NaN if there are none.

        The angle by Newton's method, safeguarded by bisection: θ_d is monotonic up to `max_angle`.
        """
        length = np.linalg.norm(target, axis=1)
        within = length < self.image_radius
        length = np.where(within, length, 0.0)
        low, high = np.zeros_like(length), np.full_like(length, self.max_angle)
        angle = np.clip(length, low, high)
        for _ in range(ITERATIONS):
            missing = length - self._rises_to(angle)
            low, high = np.where(missing > 0.0, angle, low), np.where(missing < 0.0, angle, high)
            ahead = angle + missing / self._rises_by(angle)
            before, angle = angle, np.where((ahead >= low) & (ahead <= high), ahead, 0.5 * (low + high))
            if not (np.abs(angle - before) > ANGLE_SETTLED).any():
                break
        uv = target * np.where(length > 0.0, np.tan(angle) / np.where(length > 0.0, length, 1.0), 1.0)[:, None]
        return np.where((within & self.is_invertible(uv))[:, None], uv, np.nan)

    def _scale_and_bend(self, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """θ_d/r and its derivative by r, over r (…), at the distance r from the axis."""
        s = uv[..., 0] ** 2 + uv[..., 1] ** 2
        near = s < NEAR
        s = np.where(near, 1.0, s)
        angle = np.arctan(np.sqrt(s))
        scale = self._rises_to(angle) / np.sqrt(s)
        bend = (self._rises_by(angle) / (1.0 + s) - scale) / s
        return np.where(near, 1.0, scale), np.where(near, 0.0, bend)

    def _rises_to(self, angle: np.ndarray) -> np.ndarray:
        """The distance θ_d (…)."""
        k1, k2, k3, k4 = self.coefficients
        s = angle * angle
        return angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))

    def _rises_by(self, angle: np.ndarray) -> np.ndarray:
        """∂θ_d/∂θ (…)."""
        k1, k2, k3, k4 = self.coefficients
        s = angle * angle
        return 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))
