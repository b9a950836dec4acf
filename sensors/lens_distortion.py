"""Radial-tangential distortion of a lens (D. Brown 1966, A. Conrady 1919), in OpenCV's order of the coefficients.

With s = u² + v² and ρ(s) = 1 + k1 s + k2 s² + k3 s³, the normalised coordinates (u, v) = (x/z, y/z) are distorted to

    u ρ(s) + 2 p1 u v + p2 (s + 2 u²),    v ρ(s) + 2 p2 u v + p1 (s + 2 v²).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, final

import numpy as np

from rbpf.arrays import Bool, Float

SETTLED, SOLVED = 1e-14, 1e-12
"""Errors of `undistort`, relative to 1 + the distance from the axis: the iteration ends, the result is accepted."""

STALLED = 0.999
"""A step that leaves more of the error than this has no solution ahead."""

ARMIJO = 0.25
"""Share of the decrease promised by the derivative that a step has to keep (L. Armijo 1966)."""

ITERATIONS, HALVINGS = 60, 20
"""Of Newton's method, and of one of its steps."""


@final
@dataclass(frozen=True)
class RadialTangential:
    """The distortion, its derivative, and where it can be undone.

    Attributes:
        coefficients: k1, k2, p1, p2, k3.
    """

    coefficients: tuple[float, float, float, float, float]
    coefficient_names: ClassVar = ("k1", "k2", "p1", "p2", "k3")
    kind: ClassVar = 0.0
    image_radius: ClassVar = float("inf")

    @cached_property
    def is_identity(self) -> bool:
        """Whether nothing is distorted."""
        return not any(self.coefficients)

    @cached_property
    def monotonic_radius(self) -> float:
        """Distance from the axis, in normalised coordinates, at which radial distortion folds the image back.

        The smallest positive root of d(r ρ(r²))/dr = 1 + 3 k1 r² + 5 k2 r⁴ + 7 k3 r⁶; infinite where there is none.
        """
        k1, k2, _, _, k3 = self.coefficients
        # As a polynomial in 1/r² its first coefficient is 1: no division by a small k3.
        roots = np.roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3])
        positive = roots.real[(roots.imag == 0.0) & (roots.real > 0.0)]
        return float(1.0 / np.sqrt(positive.max())) if positive.size else float("inf")

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

    def is_invertible(self, uv: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether the distortion is one-to-one up to (u, v) (…).

        Within the monotonic radius radial distortion is; with tangential distortion its derivative must be positive
        definite besides, which a weak one is anywhere near the image.
        """
        if self.is_identity:
            return np.isfinite(uv[..., 0]) & np.isfinite(uv[..., 1])
        slope = self.jacobian(uv)
        trace = slope[..., 0, 0] + slope[..., 1, 1]
        within = np.hypot(uv[..., 0], uv[..., 1]) < self.monotonic_radius
        return within & (trace > 0.0) & (_determinant(slope) > 0.0)

    def undistort(self, target: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 2"]:
        """Normalised coordinates (K, 2) of distorted ones, NaN where there are none."""
        if self.is_identity:
            return np.where(self.is_invertible(target)[:, None], target, np.nan)
        # Half of the radius is clear of the fold, where the derivative has no inverse.
        length = np.maximum(np.linalg.norm(target, axis=1, keepdims=True), np.finfo(float).tiny)
        uv = target * np.minimum(1.0, 0.5 * self.monotonic_radius / length)
        error = self._misfit(uv, target)
        active = np.flatnonzero(error > SETTLED)
        for _ in range(ITERATIONS):
            if not active.size:
                break
            uv[active], reached = self._newton(uv[active], target[active], error[active])
            error[active], active = reached, active[(reached > SETTLED) & (reached < STALLED * error[active])]
        found = (error <= SOLVED) & self.is_invertible(uv)
        return np.where(found[:, None], uv, np.nan)

    def _newton(self, uv: np.ndarray, target: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A step of each (K, 2), halved until it stays on this side of the fold and brings the error (K,) down."""
        miss = target - self.distort(uv)
        step = (inverse(self.jacobian(uv)) @ miss[..., None])[..., 0]
        waiting = np.arange(len(uv))
        for fraction in 0.5 ** np.arange(HALVINGS):
            if not waiting.size:
                break
            tried = uv[waiting] + fraction * step[waiting]
            reached = self._misfit(tried, target[waiting])
            better = (reached < (1.0 - ARMIJO * fraction) * error[waiting]) & self.is_invertible(tried)
            uv[waiting[better]], error[waiting[better]] = tried[better], reached[better]
            waiting = waiting[~better]
        return uv, error

    def _misfit(self, uv: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Distance (K,) of distorted coordinates from where they should be, relative to 1 + the latter's length."""
        miss = np.linalg.norm(target - self.distort(uv), axis=-1)
        return miss / (1.0 + np.linalg.norm(target, axis=-1))


def _determinant(matrix: np.ndarray) -> np.ndarray:
    """Of (…, 2, 2) matrices."""
    return matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]


def inverse(matrix: Float[np.ndarray, "*batch 2 2"]) -> Float[np.ndarray, "*batch 2 2"]:
    """Of symmetric (…, 2, 2) matrices."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    adjugate = np.stack([d, -b, -b, a], axis=-1).reshape(matrix.shape)
    return adjugate / _determinant(matrix)[..., None, None]
