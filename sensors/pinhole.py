"""Pinhole camera with radial-tangential distortion (D. Brown 1966, A. Conrady 1919), and the rectified stereo pair.

Model, order of the coefficients and pixel convention are OpenCV's: the centre of the top-left pixel is (0, 0).
With s = u² + v² and ρ(s) = 1 + k1 s + k2 s² + k3 s³, the normalised coordinates (u, v) = (x/z, y/z) are distorted to

    u ρ(s) + 2 p1 u v + p2 (s + 2 u²),    v ρ(s) + 2 p2 u v + p1 (s + 2 v²).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from rbpf.arrays import Bool, Float
from rbpf.errors import InputError
from rbpf.sensors.camera_checks import check_finite, check_size

SETTLED, SOLVED = 1e-14, 1e-12
"""Errors of `unproject`, relative to 1 + the distance from the axis: the iteration ends, the result is accepted."""

STALLED = 0.999
"""A step that leaves more of the error than this has no solution ahead."""

ARMIJO = 0.25
"""Share of the decrease promised by the derivative that a step has to keep (L. Armijo 1966)."""

ITERATIONS, HALVINGS = 60, 20
"""Of Newton's method, and of one of its steps."""


@final
@dataclass(frozen=True)
class Pinhole:
    """Pinhole camera with radial-tangential distortion (OpenCV's model and pixel convention).

    Attributes:
        width: of the image, px.
        height: of the image, px.
        fx: focal length along the rows, px.
        fy: focal length along the columns, px.
        cx: column of the principal point, px.
        cy: row of the principal point, px.
        distortion: k1, k2, p1, p2, k3.

    Raises:
        InputError: a size is no positive whole number, a focal length is not positive, a number is not finite,
            or there are not five numbers of distortion.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    dim = 2

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            check_size(name, getattr(self, name))
        for name in ("fx", "fy", "cx", "cy"):
            check_finite(f"the camera's {name}", getattr(self, name))
        if not (self.fx > 0.0 and self.fy > 0.0):
            raise InputError(f"the camera's fx and fy must be positive, got {self.fx!r} and {self.fy!r} px")
        if np.shape(self.distortion) != (5,):
            expected = "the 5 numbers k1, k2, p1, p2, k3 (k3 = 0 if there are four)"
            raise InputError(f"the camera's distortion must be {expected}, got {self.distortion!r}")
        for name, number in zip(("k1", "k2", "p1", "p2", "k3"), self.distortion, strict=True):
            check_finite(f"the camera's {name}", number)
        # A list from a file would make the camera unhashable.
        object.__setattr__(self, "distortion", tuple(self.distortion))

    @cached_property
    def params(self) -> Float[np.ndarray, "9"]:
        """(9,) fx, fy, cx, cy, k1, k2, p1, p2, k3: what the compiled twin reads."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion], dtype=np.float64)

    @cached_property
    def _is_plain(self) -> bool:
        """Whether nothing is distorted."""
        return not any(self.distortion)

    @cached_property
    def _size(self) -> np.ndarray:
        return np.array([self.width, self.height])

    @cached_property
    def monotonic_radius(self) -> float:
        """Distance from the axis, in normalised coordinates, at which radial distortion folds the image back.

        The smallest positive root of d(r ρ(r²))/dr = 1 + 3 k1 r² + 5 k2 r⁴ + 7 k3 r⁶; infinite where there is none.
        """
        k1, k2, _, _, k3 = self.distortion
        # As a polynomial in 1/r² its first coefficient is 1: no division by a small k3.
        roots = np.roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3])
        positive = roots.real[(roots.imag == 0.0) & (roots.real > 0.0)]
        return float(1.0 / np.sqrt(positive.max())) if positive.size else float("inf")

    def project(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels (…, 2) of points (…, 3) in the camera's frame.

        Only the direction counts: (u, v, 1) and a point at infinity work. Nothing is checked, see `visible`; a
        point in the plane of the camera, z = 0, gets pixels that are not finite.
        """
        with np.errstate(all="ignore"):
            return self.params[:2] * self._distort(_normalise(point)) + self.params[2:4]

    def slope(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2 3"]:
        """∂px/∂point (…, 2, 3) at points (…, 3) in the camera's frame."""
        point = np.asarray(point, float)
        with np.errstate(all="ignore"):
            uv = _normalise(point)
            by_uv = self.params[:2, None] * self._distort_slope(uv) / point[..., 2, None, None]
            return np.concatenate([by_uv, -by_uv @ uv[..., None]], axis=-1)

    def unproject(self, px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Normalised coordinates (u, v) (…, 2) of pixels (…, 2): the point lies in the direction (u, v, 1).

        Newton's method on the distortion. NaN where no direction in which the distortion is one-to-one projects to
        the pixel.
        """
        with np.errstate(all="ignore"):
            target = (np.asarray(px, float) - self.params[2:4]) / self.params[:2]
            uv = self._undistort(target.reshape(-1, 2))
        return uv.reshape(target.shape)

    def unproject_slope(self, px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2 2"]:
        """∂(u, v)/∂px (…, 2, 2) at pixels (…, 2); NaN where `unproject` is."""
        return _inverse(self._distort_slope(self.unproject(px))) / self.params[:2]

    def inside(self, px: Float[np.ndarray, "*batch 2"], margin_px: float = 0.0) -> Bool[np.ndarray, "*batch"]:
        """Whether pixels (…, 2) are in the image (…), and at least `margin_px` from its border.

        The image reaches half a pixel beyond the centres of its outermost pixels.
        """
        px = np.asarray(px, float)
        past = self._size - 0.5 - margin_px
        within = (px >= margin_px - 0.5) & (px <= past)
        return within[..., 0] & within[..., 1]

    def visible(
        self, point: Float[np.ndarray, "*batch 3"], margin_px: float = 0.0
    ) -> Bool[np.ndarray, "*batch"]:
        """Whether points (…, 3) are seen (…): in front of the camera, not folded back, and inside the image."""
        with np.errstate(all="ignore"):
            seen = self._unique(_normalise(point)) & self.inside(self.project(point), margin_px)
        return np.logical_and(seen, np.asarray(point)[..., 2] > 0.0)

    def _distort(self, uv: np.ndarray) -> np.ndarray:
        """Distorted coordinates (…, 2) of normalised ones."""
        if self._is_plain:
            return uv
        k1, k2, p1, p2, k3 = self.distortion
        u, v = uv[..., 0], uv[..., 1]
        s = u * u + v * v
        radial = 1.0 + s * (k1 + s * (k2 + s * k3))
        along = u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)
        down = v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v)
        return np.stack([along, down], axis=-1)

    def _distort_slope(self, uv: np.ndarray) -> np.ndarray:
        """Its derivative (…, 2, 2), a symmetric matrix."""
        k1, k2, p1, p2, k3 = self.distortion
        u, v = uv[..., 0], uv[..., 1]
        s = u * u + v * v
        radial = 1.0 + s * (k1 + s * (k2 + s * k3))
        bend = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
        across = bend * u * v + 2.0 * p1 * u + 2.0 * p2 * v
        along = radial + bend * u * u + 2.0 * p1 * v + 6.0 * p2 * u
        down = radial + bend * v * v + 6.0 * p1 * v + 2.0 * p2 * u
        return np.stack([along, across, across, down], axis=-1).reshape(*uv.shape, 2)

    def _unique(self, uv: np.ndarray) -> np.ndarray:
        """Whether the distortion is one-to-one up to (u, v) (…).

        Within the monotonic radius radial distortion is; with tangential distortion its derivative must be positive
        definite besides, which a weak one is anywhere near the image.
        """
        if self._is_plain:
            return np.isfinite(uv[..., 0]) & np.isfinite(uv[..., 1])
        slope = self._distort_slope(uv)
        trace = slope[..., 0, 0] + slope[..., 1, 1]
        within = np.hypot(uv[..., 0], uv[..., 1]) < self.monotonic_radius
        return within & (trace > 0.0) & (_determinant(slope) > 0.0)

    def _undistort(self, target: np.ndarray) -> np.ndarray:
        """Normalised coordinates (K, 2) of distorted ones, NaN where there are none."""
        if self._is_plain:
            return np.where(self._unique(target)[:, None], target, np.nan)
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
        found = (error <= SOLVED) & self._unique(uv)
        return np.where(found[:, None], uv, np.nan)

    def _newton(self, uv: np.ndarray, target: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A step of each (K, 2), halved until it stays on this side of the fold and brings the error (K,) down."""
        miss = target - self._distort(uv)
        step = (_inverse(self._distort_slope(uv)) @ miss[..., None])[..., 0]
        waiting = np.arange(len(uv))
        for share in 0.5 ** np.arange(HALVINGS):
            if not waiting.size:
                break
            tried = uv[waiting] + share * step[waiting]
            reached = self._misfit(tried, target[waiting])
            better = (reached < (1.0 - ARMIJO * share) * error[waiting]) & self._unique(tried)
            uv[waiting[better]], error[waiting[better]] = tried[better], reached[better]
            waiting = waiting[~better]
        return uv, error

    def _misfit(self, uv: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Distance (K,) of distorted coordinates from where they should be, relative to 1 + the latter's length."""
        miss = np.linalg.norm(target - self._distort(uv), axis=-1)
        return miss / (1.0 + np.linalg.norm(target, axis=-1))


@final
@dataclass(frozen=True)
class RectifiedStereo:
    """Two equal undistorted pinholes side by side; the left one is the reference.

    Attributes:
        camera: each of the two.
        baseline_m: distance of the right one from the left one, along the rows.

    Raises:
        InputError: the camera is distorted, or the baseline is not positive.
    """

    camera: Pinhole
    baseline_m: float
    dim = 3

    def __post_init__(self) -> None:
        check_finite("the stereo baseline", self.baseline_m)
        if self.baseline_m <= 0.0:
            raise InputError(f"the stereo baseline must be positive, got {self.baseline_m!r} m")
        if any(self.camera.distortion):
            found = f"the camera of a rectified stereo pair has distortion {self.camera.distortion}"
            raise InputError(f"{found}: rectify the images and give the camera of the rectified ones")

    def project(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Pixels (u_left, v, u_right) (…, 3) of points (…, 3) in the left camera's frame; nothing is checked."""
        right = self.camera.project(self._from_right(point))[..., :1]
        return np.concatenate([self.camera.project(point), right], axis=-1)

    def slope(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
        """∂px/∂point (…, 3, 3) at points (…, 3) in the left camera's frame."""
        right = self.camera.slope(self._from_right(point))[..., :1, :]
        return np.concatenate([self.camera.slope(point), right], axis=-2)

    def locate(self, z: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points (…, 3) in the left camera's frame seen at (u_left, v, u_right) (…, 3); NaN without disparity."""
        z = np.asarray(z, float)
        disparity = np.where(z[..., 0] > z[..., 2], z[..., 0] - z[..., 2], np.nan)[..., None]
        uv = self.camera.unproject(z[..., :2])
        ray = np.concatenate([uv, np.ones_like(disparity)], axis=-1)
        return self.camera.fx * self.baseline_m / disparity * ray

    def inside(self, px: Float[np.ndarray, "*batch 3"], margin_px: float = 0.0) -> Bool[np.ndarray, "*batch"]:
        """Whether (u_left, v, u_right) (…, 3) are in both images (…), and at least `margin_px` from their borders."""
        px = np.asarray(px, float)
        return self.camera.inside(px[..., :2], margin_px) & self.camera.inside(px[..., [2, 1]], margin_px)

    def visible(
        self, point: Float[np.ndarray, "*batch 3"], margin_px: float = 0.0
    ) -> Bool[np.ndarray, "*batch"]:
        """Whether points (…, 3) are seen in both images (…)."""
        right = self._from_right(point)
        return self.camera.visible(point, margin_px) & self.camera.visible(right, margin_px)

    def _from_right(self, point: np.ndarray) -> np.ndarray:
        """Points in the right camera's frame."""
        return np.asarray(point, float) - np.array([self.baseline_m, 0.0, 0.0])


def _normalise(point: np.ndarray) -> np.ndarray:
    """(x/z, y/z) (…, 2) of points (…, 3)."""
    point = np.asarray(point, float)
    return point[..., :2] / point[..., 2:]


def _determinant(matrix: np.ndarray) -> np.ndarray:
    """Of (…, 2, 2) matrices."""
    return matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Of symmetric (…, 2, 2) matrices."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    adjugate = np.stack([d, -b, -b, a], axis=-1).reshape(matrix.shape)
    return adjugate / _determinant(matrix)[..., None, None]
