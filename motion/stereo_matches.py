"""What two frames' matches must be to be tried: shapes, covariances, disparities."""

import numpy as np
from numpy.typing import ArrayLike

from rbpf import gaussian
from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.motion.stereo_geometry import Matches, StereoCamera


def checked_matches(
    camera: StereoCamera, z_prev: Array, z_now: Array, cov_prev: ArrayLike, cov_now: ArrayLike
) -> Matches:
    """The matches as one, see `rbpf.motion.stereo_vo.estimate_motion`.

    Raises:
        InputError: a shape does not fit, a number is not finite, or a covariance is not positive definite.
    """
    before, now = (np.ascontiguousarray(z, dtype=float) for z in (z_prev, z_now))
    if before.shape != now.shape or before.shape[1:] != (3,):
        raise InputError(
            f"matches must be two (K, 3) arrays of (u_left, v, u_right), got {before.shape} and {now.shape}"
        )
    if not (np.isfinite(before).all() and np.isfinite(now).all()):
        raise InputError("the pixels of the matches hold NaN or infinity: leave these matches out")
    covs = []
    for name, cov in (("cov_prev", cov_prev), ("cov_now", cov_now)):
        cov = np.asarray(cov, dtype=float)
        if cov.shape not in ((3, 3), (*before.shape, 3)):
            raise InputError(f"{name} must be (3, 3) or {(*before.shape, 3)}, got {cov.shape}")
        try:
            gaussian.cholesky(cov)
        except InputError as error:
            raise InputError(f"{name} is no covariance of pixels: {error}") from error
        covs.append(np.ascontiguousarray(np.broadcast_to(cov, (*before.shape, 3))))
    return Matches(camera, before, now, *covs)


def possible(matches: Matches, gate: float) -> tuple[np.ndarray, str]:
    """Which matches can be points in front of the camera, and what is to be said if these are too few.

    Args:
        matches: K of them.
        gate: squared distance, in standard deviations, that a disparity may be below zero.

    Returns:
        (K,) bool, and words.
    """
    across = np.array([1.0, 0.0, -1.0])
    kept = np.ones(len(matches), dtype=bool)
    for z, cov in ((matches.z_prev, matches.cov_prev), (matches.z_now, matches.cov_now)):
        disparity, variance = z @ across, np.einsum("i,kij,j->k", across, cov, across)
        kept &= (disparity >= 0.0) | (disparity**2 <= gate * variance)
    if len(matches) and kept.mean() < 0.5:
        return kept, (
            f"{len(matches) - kept.sum()} of {len(matches)} matches have a negative disparity: "
            f"are left and right swapped? {kept.sum()} are left"
        )
    return kept, f"{kept.sum()} matches are there"
