"""Pixels and points of a rectified stereo pair, as matrices.

A homogeneous point X = (x, y, z, ρ) in the left camera's frame, at (x, y, z) / ρ, and its pixels m = (u_left, v,
u_right) are related by (m, 1) ~ Q X. A point seen at m is seen after a motion T = previous_camera_from_camera at g with

    (g, 1) ~ H (m, 1),    H = Q T⁻¹ Q⁻¹,    Mathematics (vo-homography),

a homography, which does not notice where infinity is: noise may well make the disparity of a far point negative.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rbpf.lie import SE3, Array, skew


class PinholeCamera(Protocol):
    """Focal lengths and principal point."""

    @property
    def fx(self) -> float:
        """Focal length along the rows, px."""

    @property
    def fy(self) -> float:
        """Focal length along the columns, px."""

    @property
    def cx(self) -> float:
        """Column of the principal point, px."""

    @property
    def cy(self) -> float:
        """Row of the principal point, px."""


class StereoCamera(Protocol):
    """Two equal undistorted pinholes side by side, the left one the reference, as a `RectifiedStereo`."""

    @property
    def camera(self) -> PinholeCamera:
        """Each of the two."""

    @property
    def baseline_m(self) -> float:
        """Distance of the right one, along the rows."""


@dataclass(frozen=True)
class Matches:
    """Points seen in two stereo frames.

    Attributes:
        camera: of both.
        z_prev: (K, 3) pixels (u_left, v, u_right) in the earlier frame.
        z_now: (K, 3) in the later one.
        cov_prev: (K, 3, 3) [px²].
        cov_now: (K, 3, 3) [px²].
    """

    camera: StereoCamera
    z_prev: Array
    z_now: Array
    cov_prev: Array
    cov_now: Array

    def __len__(self) -> int:
        return len(self.z_prev)

    def rows(self, kept: np.ndarray) -> "Matches":
        """Some of them, (K,) bool or indices."""
        chosen = (array[kept] for array in (self.z_prev, self.z_now, self.cov_prev, self.cov_now))
        return Matches(self.camera, *chosen)


@dataclass(frozen=True)
class Seen:
    """Pixels after a motion, and their derivatives.

    Attributes:
        pixels: (…, 3) g.
        front: (…) whether the point is in front of the camera, or beyond infinity.
        by_pixels: (…, 3, 3) A = ∂g/∂m.
        by_turn: (…, 3, 3) ∂g/∂ω, of T Exp([ω, v]).
        by_nearness: (…, 3, 3) with ∂g/∂v = ρ · this.
        nearness: (…) ρ of m at z = 1: the inverse depth before the motion, 1/m.
    """

    pixels: Array
    front: np.ndarray
    by_pixels: Array
    by_turn: Array
    by_nearness: Array
    nearness: Array

    @property
    def by_motion(self) -> Array:
        """(…, 3, 6) ∂g/∂ξ, order [ω, v]: Mathematics (vo-jacobian)."""
        return np.concatenate([self.by_turn, self.nearness[..., None, None] * self.by_nearness], axis=-1)


def lens(camera: StereoCamera) -> Array:
    """What compiled functions take a camera for, (5,): fx, fy, cx, cy, fx · baseline."""
    one = camera.camera
    return np.array([one.fx, one.fy, one.cx, one.cy, one.fx * camera.baseline_m])


def pixels_from_points(camera: StereoCamera) -> Array:
    """Q (4, 4)."""
    one, shift = camera.camera, camera.camera.fx * camera.baseline_m
    return np.array(
        [
            [one.fx, 0.0, one.cx, 0.0],
            [0.0, one.fy, one.cy, 0.0],
            [one.fx, 0.0, one.cx, -shift],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )


def points_from_pixels(camera: StereoCamera) -> Array:
    """Q⁻¹ (4, 4)."""
    one, shift = camera.camera, camera.camera.fx * camera.baseline_m
    return np.array(
        [
            [1.0 / one.fx, 0.0, 0.0, -one.cx / one.fx],
            [0.0, 1.0 / one.fy, 0.0, -one.cy / one.fy],
            [0.0, 0.0, 0.0, 1.0],
            [1.0 / shift, 0.0, -1.0 / shift, 0.0],
        ]
    )


def homography(camera: StereoCamera, delta: Array) -> Array:
    """H (…, 4, 4) of motions T (…, 7)."""
    moved = SE3.matrix(SE3.inverse(delta))
    return np.asarray(pixels_from_points(camera) @ moved @ points_from_pixels(camera), dtype=float)


def raise_pixels(matrix: Array, pixels: Array) -> Array:
    """Matrices (…, 4, 4) times (m, 1), (…, k, 3) → (…, k, 4)."""
    return pixels @ matrix[..., :3].mT + matrix[..., None, :, 3]


def see(camera: StereoCamera, delta: Array, pixels: Array) -> Seen:
    """Where points seen at `pixels` (…, k, 3) are seen after motions T (…, 7), broadcast over the leading axes."""
    q = pixels_from_points(camera)
    matrix = homography(camera, delta)
    raised = raise_pixels(matrix, pixels)
    front = raised[..., 3] > 0.0
    raised = np.where(front[..., None], raised, [0.0, 0.0, 0.0, 1.0])
    depth = raised[..., 3, None]
    seen = raised[..., :3] / depth
    # (m, 1) ~ Q X has z as its last entry, here and after the motion.
    point = raised @ points_from_pixels(camera).T
    slope = (q[:3, :3] - seen[..., None] * np.array([0.0, 0.0, 1.0])) / depth[..., None]
    by_pixels = (matrix[..., None, :3, :3] - seen[..., None] * matrix[..., None, None, 3, :3]) / depth[
        ..., None
    ]
    return Seen(seen, front, by_pixels, slope @ skew(point[..., :3]), -slope, point[..., 3])
