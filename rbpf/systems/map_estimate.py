"""The map of a filter as one Gaussian per landmark, within + between particles; poses and points relative to a frame in it.

Each particle estimates this frame, such as that of known points, in its own world.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rbpf.core.filter import Filter
from rbpf.core.models import Records
from rbpf.core.particles import Estimate, Prior, mixture_estimate
from rbpf.lie import LieGroup, SE2Group
from rbpf.maps.joint_map import JointMap
from rbpf.sensors.range_bearing import RelativePosition


@dataclass(frozen=True)
class MapEstimate:
    """Landmarks of a run, M of them."""

    ids: np.ndarray  #: (M,) names: the log's for known association, else the map's.
    mean: np.ndarray  #: (M, D) positions in the world, metres.
    cov: np.ndarray  #: (M, D, D).
    #: further columns of the system, (M,) by name. `ray` is 1 for a landmark of unknown depth.
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    #: (M, 2, 3) nearest and farthest point of a ray, NaN for points; None without rays.
    ray_ends: np.ndarray | None = None

    def named(self) -> dict[int, np.ndarray]:
        return dict(zip(self.ids.tolist(), self.mean, strict=True))

    def is_ray(self) -> np.ndarray:
        """(M,) bool, whether the depth is still unknown."""
        return np.asarray(self.columns.get("ray", np.zeros(self.ids.size))) != 0

    def in_space(self, rows: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Positions (M, 3) and covariances (M, 3, 3) of some rows; a map of the plane lies at z = 0."""
        more = 0, 3 - self.mean.shape[1]
        return np.pad(self.mean[rows], ((0, 0), more)), np.pad(self.cov[rows], ((0, 0), more, more))

    def points(self) -> "MapEstimate":
        if "ray" not in self.columns:
            return self
        full = ~self.is_ray()
        columns = {name: column[full] for name, column in self.columns.items() if name != "ray"}
        return MapEstimate(self.ids[full], self.mean[full], self.cov[full], columns)


def estimate_map(filter_: Filter) -> MapEstimate:
    """Moments of every landmark."""
    belief, dim = filter_.belief(), 2 if isinstance(filter_.space, SE2Group) else 3
    landmark_map = belief.map
    if isinstance(landmark_map, JointMap):
        return MapEstimate(*landmark_map.landmarks(filter_.particles))
    ids = landmark_map.ids
    mean, cov = belief.moments(ids)
    return MapEstimate(ids, mean.reshape(-1, dim), cov.reshape(-1, dim, dim))


@dataclass(frozen=True)
class Anchored:
    """The frame in each particle's world: world_from_frame (N, E), and a factor (N, d, d) of its covariance."""

    mean: np.ndarray
    factor: np.ndarray


def relative_estimate(space: LieGroup, anchored: Anchored, state: np.ndarray, log_weights: np.ndarray) -> Estimate:
    """Mean and covariance of states (N, E) relative to the frame, x_0⁻¹ · x."""
    relative = space.between(anchored.mean, state)
    factor = space.adjoint(space.inverse(relative)) @ anchored.factor
    return mixture_estimate(Prior(space, relative, np.zeros((1, space.dim)), factor), None, log_weights)


def relative_points(space: Any, anchored: Anchored, records: Records) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, K, D) of landmarks relative to the frame, and their covariances with the frame's."""
    model, frame = RelativePosition(space), anchored.mean[:, None]
    jac = model.jacobians(frame, records.mean)
    assert jac.state is not None and jac.landmark is not None
    moved = jac.state @ anchored.factor[:, None]
    turned = jac.landmark @ records.cov @ np.swapaxes(jac.landmark, -1, -2)
    return model.predict(frame, records.mean), turned + moved @ np.swapaxes(moved, -1, -2)
