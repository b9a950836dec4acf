"""Equidistant lens of a fisheye camera (J. Kannala and S. Brandt 2006), as in OpenCV's `cv2.fisheye` and in Kalibr.

A direction (u, v) = (x/z, y/z) at the angle θ = atan |(u, v)| from the axis lands on the same side of it, at a distance
of θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸): Mathematics (equidistant).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, final

import numpy as np

from rbpf.arrays import Bool, Float

MAX_ANGLE = np.deg2rad(75.0)
"""Largest angle from the axis that is seen, less than where `rbpf.sensors.camera_points.forward` begins to bend: (u, v)
and its errors grow without bound towards 90°."""

NEAR = 1e-16
"""Squared distance from the axis below which the lens is its own tangent, to rounding."""

SETTLED = 1e-15
"""A step of the angle, relative to 1, that ends the iteration of `undistort`."""

ITERATIONS = 60
"""Of Newton's method; halving alone gets as far."""


@final
@dataclass(frozen=True)
class Equidistant:
    """The lens, its derivative, and where it can be undone; the same methods as `RadialTangential`.

    Attributes:
        coefficients: k1, k2, k3, k4.
    """

    coefficients: tuple[float, float, float, float]
    coefficient_names: ClassVar = ("k1", "k2", "k3", "k4")
    kind: ClassVar = 1.0
    is_identity: ClassVar = False

    @cached_property
    def max_angle(self) -> float:
        """Angle from the axis [rad] up to which a direction is seen: 75°, or where the image folds back before.

        There is the smallest positive root of 1 + 3 k1 θ² + 5 k2 θ⁴ + 7 k3 θ⁶ + 9 k4 θ⁸.
        """
        k1, k2, k3, k4 = self.coefficients
        # As a polynomial in 1/θ² its first coefficient is 1: no division by a small k4.
        roots = np.roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4])
        positive = roots.real[(roots.imag == 0.0) & (roots.real > 0.0)]
        return float(min(MAX_ANGLE, 1.0 / np.sqrt(positive.max()))) if positive.size else float(MAX_ANGLE)

    @cached_property
    def monotonic_radius(self) -> float:
        """Distance from the axis, in normalised coordinates, up to which a direction is seen."""
        return float(np.tan(self.max_angle))

    @cached_property
    def image_radius(self) -> float:
        """Distance from the axis, in distorted coordinates, of the circle in which it sees."""
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

    def is_invertible(self, uv: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether a direction (u, v) (…) is seen: nearer to the axis than `max_angle`, where the lens is one-to-one."""
        return np.hypot(uv[..., 0], uv[..., 1]) < self.monotonic_radius

    def undistort(self, target: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 2"]:
        """Normalised coordinates (K, 2) of distorted ones, NaN where there are none.

        The angle by Newton's method, which halves what is left where it would leave it: θ_d rises up to `max_angle`.
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
            if not (np.abs(angle - before) > SETTLED).any():
                break
        uv = (
            target * np.where(length > 0.0, np.tan(angle) / np.where(length > 0.0, length, 1.0), 1.0)[:, None]
        )
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
