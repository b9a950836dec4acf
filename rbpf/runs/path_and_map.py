"""A path and a map with their covariances: a filter's at its end, a batch optimum's, a run folder's."""

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from rbpf.lie import SE2, SE3, Array, SE2Group, SE3Group
from rbpf.runs.run import Run
from rbpf.runs.trajectory import Trajectory, in_space
from rbpf.systems.map_estimate import MapEstimate


@final
@dataclass(frozen=True, eq=False)
class PathAndMap:
    """T poses in SE2 or SE3 and M landmarks.

    Attributes:
        stamps_ns: (T,).
        world_from_body: (T, E).
        cov_poses: (T, d, d) in the right chart at each pose, order [ω, v]; no rows where they are not known.
        landmarks: those that are points.
    """

    stamps_ns: NDArray[np.int64]
    world_from_body: Array
    cov_poses: Array
    landmarks: MapEstimate

    @classmethod
    def of_run(cls, run: Run) -> "PathAndMap":
        """The online filtered poses of a run, and its last map."""
        return cls(run.log.stamps_ns, run.log.poses, run.log.covs, run.system.map().points())

    @property
    def space(self) -> SE2Group | SE3Group:
        """The group of the poses."""
        return SE2 if self.world_from_body.shape[1] == SE2.size else SE3

    @property
    def trajectory(self) -> Trajectory:
        """The path in space."""
        return in_space(self.stamps_ns, self.world_from_body)

    def at(self, rows: NDArray[np.intp]) -> "PathAndMap":
        """Some of the poses, with all landmarks."""
        covs = self.cov_poses[rows] if len(self.cov_poses) else self.cov_poses
        return PathAndMap(self.stamps_ns[rows], self.world_from_body[rows], covs, self.landmarks)
