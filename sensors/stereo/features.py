"""Features of a stereo pair: the local landmarks o = {P^L, C^L, α, s, f} of S05 §III-B.

The left camera is the reference; S05's is the right one.
"""

from dataclasses import dataclass, fields
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.descriptors.matching import (
    DescriptorMatches,
    MatchLimits,
    gate_pairs,
    match_all,
    match_pairs,
)


@final
@dataclass(frozen=True)
class StereoFeatures:
    """What a pair of images shows, of highest contrast first.

    Attributes:
        z: (K, 3) pixels (u_left, v, u_right).
        cov: (K, 3, 3) of their noise, px².
        points: (K, 3) P^L in the left camera's frame, m.
        cov_points: (K, 3, 3) C^L, m²: `cov` through the Jacobian of the triangulation.
        scale: (K,) of the keypoint, px.
        orientation: (K,) of the keypoint, radians.
        descriptors: (K, 36) or (K, 128) float32 of length 1.
    """

    z: np.ndarray
    cov: np.ndarray
    points: np.ndarray
    cov_points: np.ndarray
    scale: np.ndarray
    orientation: np.ndarray
    descriptors: np.ndarray

    @classmethod
    def measured(
        cls,
        rig: RectifiedStereo,
        z: np.ndarray,
        cov: np.ndarray,
        scale: np.ndarray,
        orientation: np.ndarray,
        descriptors: np.ndarray,
    ) -> "StereoFeatures":
        """Features whose points and their covariances follow from the pixels."""
        points = rig.triangulate(z)
        jac = triangulate_jacobian(rig, z)
        cov_points = gaussian.symmetrise(jac @ cov @ np.swapaxes(jac, -1, -2))
        return cls(z, cov, points, cov_points, scale, orientation, descriptors)

    def __len__(self) -> int:
        return self.z.shape[0]

    def take(self, rows: np.ndarray) -> "StereoFeatures":
        """Some of them, by number or by mask."""
        return StereoFeatures(*(getattr(self, item.name)[rows] for item in fields(self)))


def triangulate_jacobian(rig: RectifiedStereo, z: np.ndarray) -> np.ndarray:
    """∂P/∂(u_left, v, u_right) (…, 3, 3) of `RectifiedStereo.triangulate` at pixels z (…, 3), Mathematics (stereo-slope).

    With disparity d = u_left − u_right, P = (fx b / d) (u, v, 1) in normalised coordinates: every pixel of d moves P
    along its own ray by −P/d, and u_left and v turn the ray besides.
    """
    points = rig.triangulate(z)
    disparity = (z[..., 0] - z[..., 2])[..., None]
    slope = np.zeros((*points.shape, 3))
    slope[..., 0] = -points / disparity
    slope[..., 2] = points / disparity
    slope[..., 0, 0] += rig.baseline_m / disparity[..., 0]
    slope[..., 1, 1] = rig.camera.fx / rig.camera.fy * rig.baseline_m / disparity[..., 0]
    return slope


def match_frames(
    before: StereoFeatures,
    after: StereoFeatures,
    limits: MatchLimits,
    predicted: tuple[np.ndarray, np.ndarray] | None = None,
    gate: float = 11.3,
) -> DescriptorMatches:
    """Which features of an earlier pair are seen again in a later one.

    Args:
        before: K features of the earlier pair.
        after: features of the later one.
        limits: when a candidate is taken.
        predicted: where the earlier ones should be in the later pair: (u_left, v, u_right) (K, 3), NaN for none, and
            covariance (K, 3, 3) without the noise of the measurement; None lets all compete.
        gate: largest squared Mahalanobis distance from there; 11.3 holds 99 % of a Gaussian.

    Returns:
        Pairs of rows, `first` before and `second` after.
    """
    if predicted is None:
        return match_all(before.descriptors, after.descriptors, limits)
    mean, cov = predicted
    k, m = gate_pairs(after.z, after.cov, mean, cov, gate)
    return match_pairs(before.descriptors, after.descriptors, (m, k), limits)
