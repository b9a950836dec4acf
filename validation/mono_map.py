"""The map of a run over images: points as Gaussians in the reported world, rays as what is known of them."""

from dataclasses import dataclass

import numpy as np

from rbpf import gaussian
from rbpf.core.anchoring import Anchored
from rbpf.core.filter import Filter
from rbpf.core.models import Records
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation, UncertainConstellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.systems.map_estimate import MapEstimate, mixture_moments, relative_points
from rbpf.systems.mono.system import world_of

LEAST_RHO = 0.02
"""Inverse depth below which a ray is drawn and written as if it ended there, 1/m: at 50 m."""

RAY_SIGMAS = 2.0
"""The part of a ray that is drawn: this far to either side of its mean inverse depth, in standard deviations."""


@dataclass(frozen=True)
class MonoMap:
    """M landmarks, in the world of the known points, else of the first camera.

    Attributes:
        landmarks: names, means (M, 3) and covariances (M, 3, 3) within + between particles; of a ray, linearised at
            its mean inverse depth.
        is_ray: (M,) whether the depth is not known yet.
        ends: (M, 2, 3) nearest and farthest point of a ray, in the heaviest particle; NaN for points.
    """

    landmarks: MapEstimate
    is_ray: np.ndarray
    ends: np.ndarray


@dataclass
class _Rows:
    names: list[int]
    means: list[np.ndarray]
    covs: list[np.ndarray]
    ends: list[np.ndarray]

    def add(self, name: int, moments: tuple[np.ndarray, np.ndarray], ends: np.ndarray) -> None:
        self.names.append(name)
        self.means.append(moments[0])
        self.covs.append(moments[1])
        self.ends.append(ends)


def summarise_mono_map(filter_: Filter) -> MonoMap:
    """Every landmark of a filter's map."""
    belief, world = filter_.belief(), world_of(filter_)
    landmark_map, weights, mode = belief.map, belief.weights, belief.mode
    if world is None:
        n = weights.size
        world = Anchored(np.tile(SE3.identity(), (n, 1)), np.zeros((n, 6, 6)))
    rows = _Rows([], [], [], [])
    nowhere = np.full((2, 3), np.nan)
    for landmark_id in landmark_map.ids.tolist():
        landmark = landmark_map.landmark_of(landmark_id)
        records = landmark_map.read(np.array([landmark_id]))
        if isinstance(landmark, Constellation | UncertainConstellation):
            points, within = landmark.in_group(records)
            for member in range(points.shape[1]):
                moments = mixture_moments(weights, points[:, member], within[:, member])
                rows.add(member, moments, nowhere)
            continue
        ends = nowhere
        if isinstance(landmark, InverseDepth):
            ends = _ends(landmark, records, world, mode)
            records = _linearised(landmark, records)
        moments = mixture_moments(weights, *relative_points(SE3, world, records))
        rows.add(landmark_map.catalogue.get(landmark_id, landmark_id), moments, ends)
    return _gathered(rows)


def _gathered(rows: _Rows) -> MonoMap:
    order = np.argsort(np.array(rows.names, dtype=np.int64), kind="stable")
    summary = MapEstimate(
        np.array(rows.names, dtype=np.int64)[order],
        np.array(rows.means).reshape(-1, 3)[order],
        np.array(rows.covs).reshape(-1, 3, 3)[order],
    )
    ends = np.array(rows.ends).reshape(-1, 2, 3)[order]
    return MonoMap(summary, np.isfinite(ends).all(axis=(1, 2)), ends)


def _linearised(landmark: InverseDepth, records: Records) -> Records:
    """Rays (N, 1, 3) as points: first-order in (u, v, q), with q kept away from 0."""
    assert records.const is not None
    mean = records.mean.copy()
    mean[..., 2] = np.maximum(mean[..., 2], LEAST_RHO)
    u, v, q = np.moveaxis(mean, -1, 0)
    jac = np.zeros((*q.shape, 3, 3))
    jac[..., 0, 0] = jac[..., 1, 1] = 1.0 / q
    jac[..., :, 2] = -np.stack([u, v, np.ones_like(q)], axis=-1) / np.square(q)[..., None]
    local = np.stack([u, v, np.ones_like(q)], axis=-1) / q[..., None]
    turned = SE3.matrix(records.const)[..., :3, :3] @ jac
    cov = gaussian.symmetrise(turned @ records.cov @ np.swapaxes(turned, -1, -2))
    return Records(SE3.transform(records.const, local), cov)


def _ends(landmark: InverseDepth, records: Records, world: Anchored, mode: int) -> np.ndarray:
    assert records.const is not None
    mean = np.repeat(records.mean[mode], 2, axis=0)
    spread = RAY_SIGMAS * np.sqrt(records.cov[mode, 0, 2, 2])
    mean[:, 2] = np.maximum(mean[:, 2] + [spread, -spread], LEAST_RHO)
    homogeneous = landmark.homogeneous(mean, records.const[mode])
    return SE3.inverse_transform(world.mean[mode], homogeneous[:, :3] / homogeneous[:, 3:])
