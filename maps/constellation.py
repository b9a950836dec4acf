"""Points of known positions in a group frame, as one landmark, because their uncertainty is correlated."""

from typing import final

import numpy as np
from scipy.linalg import block_diag

from rbpf import gaussian
from rbpf.core.models import Landmark, Records
from rbpf.errors import InputError
from rbpf.lie import SE3

MOST = 30  #: Maximum number of points; a record's covariance grows with its square.
#: Maximum Gauss-Newton steps to the frame; they start from the closed-form solution for equal errors, of the points' means
#: over the particles.
ROUNDS = 20
#: Norm of the last step, radians and metres: the remaining error is a hundredth of it, even for a bad fit.
SETTLED = 1e-6
LEAST = 1e-12  #: Variance, m², of exact points, which keeps the fit defined.


@final
class Constellation(Landmark):
    """M points given in a group frame, exactly or with Gaussian errors, whose world positions are estimated.

    The record's mean is (p_1, …, p_M), the points' world positions, with their joint covariance, which holds the correlation
    by the given shape. A camera's measurement is nearly linear in the points, however uncertain the frame. It is not if the
    record has the frame and an error of each point: the second-order error then exceeds a pixel. The frame follows from the
    points: p_m = T (k_m + e_m), so T is the fit of the shape to them.

    Args:
        points: (M, 3) given positions k_m in the group's frame, metres.
        cov_points: (M, 3, 3) covariances of their errors e_m.

    Raises InputError: there are too many points.
    """

    def __init__(self, points: np.ndarray, cov_points: np.ndarray) -> None:
        if points.shape[0] > MOST:
            raise InputError(
                f"{points.shape[0]} known points are too many for one group: give {MOST}, or set known=points"
            )
        self.points = points.tolist()
        self.dim = 3 * points.shape[0]
        self._info_points = block_diag(*np.linalg.inv(cov_points + LEAST * np.eye(3))).tolist()

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        centre = self._points_of(mean).mean(axis=-2)
        return np.concatenate([centre, np.ones((*centre.shape[:-1], 1))], axis=-1)

    def started(self, n: int, points: np.ndarray, cov: np.ndarray) -> Records:
        """Initial records (n, 1, …): the points (M, 3) in the world, covariance (3M, 3M)."""
        shape = (n, 1, self.dim)
        return Records(np.broadcast_to(points.ravel(), shape), np.broadcast_to(cov, (*shape, self.dim)))

    def frame(self, records: Records) -> tuple[np.ndarray, np.ndarray]:
        frame, _, _, cov = self._fit(records)
        return frame, gaussian.psd_factor(cov)

    def in_world(self, records: Records) -> np.ndarray:
        return self._points_of(records.mean[:, 0])

    def in_group(self, records: Records) -> tuple[np.ndarray, np.ndarray]:
        frame, slope, cov_fit, _ = self._fit(records)
        local = SE3.inverse_transform(frame[:, None], self.in_world(records))
        of_frame = -SE3.transform_jacobian(local)
        by_points = of_frame @ slope[:, None]
        back = np.swapaxes(SE3.rotation(frame), -1, -2)
        for m in range(len(self.points)):
            by_points[:, m, :, 3 * m : 3 * m + 3] += back
        covs = by_points @ records.cov[:, :1, :, :] @ np.swapaxes(by_points, -1, -2)
        of_fit = of_frame @ cov_fit[:, None] @ np.swapaxes(of_frame, -1, -2)
        return local, gaussian.symmetrise(covs + of_fit)

    def _points_of(self, mean: np.ndarray) -> np.ndarray:
        return mean.reshape(*mean.shape[:-1], -1, 3)

    def _fit(self, records: Records) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The frame (N, 7) that fits the shape to the points: Gauss-Newton on r_m = T⁻¹ p_m − k_m, weighted by cov e_m.

        Also its derivative by all points (N, 6, 3M), and its covariances (N, 6, 6): given the points, and in total.
        """
        world, given, weight = self.in_world(records), np.asarray(self.points), np.asarray(self._info_points)
        n = len(world)
        frame = np.repeat(SE3.closest(given, world.mean(axis=0)[None]), n, axis=0)
        for _ in range(ROUNDS):
            local = SE3.inverse_transform(frame[:, None], world)
            # All points stacked: one product is faster than many small ones.
            moved = -SE3.transform_jacobian(local).reshape(n, -1, 6)
            weighed = weight @ moved
            info, pull = np.swapaxes(weighed, 1, 2) @ moved, (local - given).reshape(n, 1, -1) @ weighed
            step = -np.linalg.solve(info, np.swapaxes(pull, 1, 2))[..., 0]
            frame = SE3.retract(frame, step)
            if np.abs(step).max() <= SETTLED:
                break
        # −Λ⁻¹ JᵀW Rᵀ.
        turned = SE3.rotation(frame)[:, None] @ weighed.reshape(n, -1, 3, 6)
        cov_fit = gaussian.symmetrise(np.linalg.inv(info))
        slope = -cov_fit @ np.swapaxes(turned.reshape(n, -1, 6), 1, 2)
        cov = gaussian.symmetrise(slope @ records.cov[:, 0] @ np.swapaxes(slope, -1, -2) + cov_fit)
        return frame, slope, cov_fit, cov
