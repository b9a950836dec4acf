"""A point on a ray: inverse depth in the frame of the first observation (E06 §5.1)."""

from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf.core.models import Landmark, Records
from rbpf.lie import SE3
from rbpf.ranges import Positive, Ranged

MIN_RHO = 0.02  #: Inverse depth to which smaller ones are raised for reporting, 1/m: 50 m.


@final
@dataclass(frozen=True, eq=False)
class InverseDepth(Ranged, Landmark):
    """b = (u, v, q): the point (u, v, 1)/q in the frame of the first observation, E06 §5.1.

    The record's constant is that frame, world_from_anchor (7,): the particle's own pose at the first observation, which
    its descendants inherit. u and v are normalised image coordinates, q = 1/z in 1/m; q = 0 is at infinity.
    Raises InputError: `ready_ratio` is not positive.
    """

    #: A ray can be promoted to a point once the standard deviation of q is below this fraction of q.
    ready_ratio: Positive = 0.1

    dim = 3
    constants = 7
    anchored = True
    learnt_alone = 2

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        """(R (u, v, 1) + q t, q): no division, so that q may be 0."""
        assert const is not None
        ray = np.concatenate([mean[..., :2], np.ones((*mean.shape[:-1], 1))], axis=-1)
        turned = SE3.transform(const, ray) - SE3.translation(const)
        rho = mean[..., 2:]
        return np.concatenate([turned + rho * SE3.translation(const), rho], axis=-1)

    def point(self, mean: np.ndarray, const: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """With q raised to a minimum above 0."""
        assert const is not None
        u, v, q = np.moveaxis(mean, -1, 0)
        q = np.maximum(q, MIN_RHO)
        direction = np.stack([u, v, np.ones_like(q)], axis=-1)
        jac = np.zeros((*q.shape, 3, 3))
        jac[..., 0, 0] = jac[..., 1, 1] = 1.0 / q
        jac[..., :, 2] = -direction / np.square(q)[..., None]
        return SE3.transform(const, direction / q[..., None]), SE3.rotation(const) @ jac

    def ready(self, records: Records) -> np.ndarray:
        """Whether q is positive and well known (N, K), so that the depth is nearly Gaussian, too (Fig. 2)."""
        rho, std = records.mean[..., 2], np.sqrt(records.cov[..., 2, 2])
        return (rho > 0.0) & (std <= self.ready_ratio * rho)

    def promote(self, records: Records) -> Records:
        """The unscented transform if the ray is ready, else linearisation about an inverse depth of at least σ.

        Without being ready, sigma points come close to q = 0: far away, or behind the camera.
        """
        ready, std = self.ready(records)[..., None], np.sqrt(records.cov[..., 2, 2])
        mean = records.mean.copy()
        mean[..., 2:] = np.where(ready, mean[..., 2:], np.maximum(mean[..., 2:], std[..., None]))
        shrink = np.where(ready, 1.0, 1e-4)[..., None]
        found = super().promote(Records(mean, shrink**2 * records.cov, records.const))
        return Records(found.mean, found.cov / shrink**2)
