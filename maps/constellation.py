"""Points whose places are known in a frame of their own: one landmark, the frame's pose, that they all move with."""

from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.models import Landmark, Records

MOST = 12
"""Points that may each have an error of their own; a record's covariance grows with the square of their number."""


@final
class Constellation(Landmark):
    """A rigid group of M points, given in a frame of their own up to Gaussian errors; that frame is estimated.

    The record's mean is (ξ, e_1, …, e_M): the group's frame is world_from_group = G Exp(ξ), with G the record's
    constant (7,), and point m lies there at p_m + e_m. The correlation that the points have through ξ is kept, which
    separate landmarks would lose. Without errors of the points the mean is ξ alone.

    Args:
        points: (M, 3) p_m in the group's frame, metres.
        cov_points: (M, 3, 3) covariances of the e_m; all zero where the points are exact.

    Raises:
        InputError: too many points have errors of their own.
    """

    constants = 7

    def __init__(self, points: np.ndarray, cov_points: np.ndarray) -> None:
        exact = not cov_points.any()
        if not exact and points.shape[0] > MOST:
            raise InputError(
                f"{points.shape[0]} known points have errors of their own: give at most {MOST}, or exact ones (σ = 0)"
            )
        self.points = points.tolist()
        self.dim = 6 if exact else 6 + 3 * points.shape[0]
        self._cov_points = cov_points.tolist()

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """The origin of the group's frame, (…, dim), (…, 7) → (…, 4)."""
        origin = SE3.translation(self.frame(mean, const))
        return np.concatenate([origin, np.ones((*origin.shape[:-1], 1))], axis=-1)

    def frame(self, mean: np.ndarray, const: np.ndarray | None) -> np.ndarray:
        """world_from_group (…, 7)."""
        assert const is not None
        return SE3.retract(const, mean[..., :6])

    def started(self, n: int, world_from_group: np.ndarray, cov: np.ndarray) -> Records:
        """First records (n, 1, …): the frame at world_from_group (7,), covariance (6, 6) in the right chart there."""
        full = np.zeros((self.dim, self.dim))
        full[:6, :6] = cov
        if self.dim > 6:
            for m, block in enumerate(self._cov_points):
                rows = slice(6 + 3 * m, 9 + 3 * m)
                full[rows, rows] = block
        return Records(
            np.zeros((n, 1, self.dim)),
            np.broadcast_to(full, (n, 1, self.dim, self.dim)),
            np.broadcast_to(world_from_group, (n, 1, 7)),
        )

    def frame_factor(self, records: Records) -> np.ndarray:
        """Factor (N, 6, 6) of the frame's covariance, in the right chart at `frame`, of records of one landmark."""
        chart = SE3.right_jacobian(records.mean[:, 0, :6])
        return chart @ gaussian.psd_factor(records.cov[:, 0, :6, :6])
