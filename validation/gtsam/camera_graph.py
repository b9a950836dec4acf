"""The factor graph of a camera's sightings in GTSAM.

    sightings:     project(T⁻¹ l) − z ~ N(0, R), Huber's loss on request
    known points:  l ~ N(m, P), exact ones a hard constraint
    undetermined:  l ~ N(start, (d/4)² I) with d its distance, far wider than the pixels are across it
    velocity:      E06 (4)–(5); frames of one time then share one pose and one velocity
    gauge:         without known points the first pose is held where it started; for one camera, a distance too

The distance is that from the first camera to the one farthest from it at the start. The gauge only says which of many
equal solutions is meant: it costs nothing at the optimum.
"""

from dataclasses import dataclass
from typing import Any, final

import gtsam
import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import RectifiedStereo
from rbpf.validation.gtsam.camera_data import Sightings
from rbpf.validation.gtsam.camera_factors import (
    LANDMARK,
    VELOCITY,
    path_of,
    points_of,
    sighting_factors,
    velocities_of,
    velocity_factors,
)
from rbpf.validation.gtsam.camera_points import first_centres
from rbpf.validation.gtsam.chart import SPATIAL
from rbpf.validation.gtsam.solvers import noise

SCALE, SOFT_SCALE = 1e-6, 1e-3
"""Standard deviation of the distance that holds the scale, as a fraction of it, at the end and on the way there.

Nothing else speaks of the scale, but a hard one could only be followed along a curve.
"""

WEAK = 0.25
"""Standard deviation of an undetermined landmark's prior, as a fraction of its distance."""


@final
@dataclass(frozen=True, eq=False)
class CameraState:
    """A point in the space of all variables.

    Attributes:
        path: (T, 7) world_from_camera.
        points: (L, 3) landmarks of the table.
        velocities: (T, 6) in the right chart, or no rows.
    """

    path: Array
    points: Array
    velocities: Array


@final
class CameraProblem:
    """Variables and factors of a recording.

    Args:
        name: of the recording.
        stamps_ns: (T,) of the frames.
        table: the sightings that take part.
        known: position and covariance of known points by name.
        robust: Huber's threshold; None is Gaussian.
        velocity: (6,) std of the white-noise acceleration; None leaves the motion free.
    """

    def __init__(
        self,
        name: str,
        stamps_ns: NDArray[np.int64],
        table: Sightings,
        known: dict[int, tuple[Array, Array]],
        robust: float | None = None,
        velocity: Array | None = None,
    ) -> None:
        self.name, self.table, self.known, self.robust, self.velocity = name, table, known, robust, velocity
        self.stamps_ns, self.frames = stamps_ns, len(stamps_ns)
        self.times, self.slots = np.unique(stamps_ns, return_inverse=True)
        if velocity is None:
            self.slots = np.arange(self.frames)
        self._first = np.unique(self.slots, return_index=True)[1]
        self.shared = self._first[self.slots]
        self.free = np.array([name not in known for name in table.names.tolist()], dtype=bool)
        self.pose_keys = [int(gtsam.symbol("x", slot)) for slot in self.slots.tolist()]
        self.point_keys = [int(gtsam.symbol(LANDMARK, index)) for index in range(len(table.names))]
        self.velocity_keys = [int(gtsam.symbol(VELOCITY, slot)) for slot in self.slots.tolist()]

    def part(self, kept: NDArray[np.bool_]) -> "CameraProblem":
        """The same without some of the landmarks (L,)."""
        if kept.all():
            return self
        table = self.table.rows(kept[self.table.index])
        return CameraProblem(self.name, self.stamps_ns, table, self.known, self.robust, self.velocity)

    @property
    def scaled(self) -> bool:
        """Whether the scale has to be held."""
        return not self.known and not isinstance(self.table.camera, RectifiedStereo)

    @property
    def held_keys(self) -> list[int]:
        """What hard constraints hold: known points without errors; without any known points, the first pose."""
        if not self.known:
            return [self.pose_keys[0]]
        exact = {name for name, (_, cov) in self.known.items() if not cov.any()}
        pairs = zip(self.table.names.tolist(), self.point_keys, strict=True)
        return [key for name, key in pairs if name in exact]

    def graph(
        self, start: CameraState, loose: NDArray[np.bool_], held: Array, scale: float = SOFT_SCALE
    ) -> Any:
        """All factors.

        Args:
            start: where weak priors hold.
            loose: (L,) landmarks that get one.
            held: (T, 7) path where the gauge holds.
            scale: its standard deviation, see `SCALE`.
        """
        graph = sighting_factors(self.table, self.pose_keys, self.point_keys, self.robust)
        self._add_known(graph)
        self._add_weak(graph, start, loose)
        if not self.known:
            self._add_gauge(graph, held, scale)
        if self.velocity is not None and len(self.times) > 1:
            keys = [self.pose_keys[i] for i in self._first], [self.velocity_keys[i] for i in self._first]
            graph.push_back(velocity_factors(1e-9 * np.diff(self.times), self.velocity, *keys))
        return graph

    def values(self, state: CameraState) -> Any:
        """GTSAM's values of a state; of frames that share a pose the first one's counts."""
        values = gtsam.Values()
        for row in self._first.tolist():
            values.insert(self.pose_keys[row], SPATIAL.pose(state.path[row]))
            if self.velocity is not None:
                values.insert(self.velocity_keys[row], np.asarray(state.velocities[row]))
        for key, point in zip(self.point_keys, state.points, strict=True):
            values.insert(key, np.asarray(point))
        return values

    def state(self, values: Any) -> CameraState:
        """The inverse of `values`."""
        path = SE3.normalise(path_of(values)[self.slots])
        velocities = np.empty((0, 6))
        if self.velocity is not None:
            velocities = velocities_of(values)[self.slots]
        return CameraState(path, points_of(values), velocities)

    def _add_known(self, graph: Any) -> None:
        for name, key in zip(self.table.names.tolist(), self.point_keys, strict=True):
            if name in self.known:
                position, cov = self.known[name]
                model = noise(cov) if cov.any() else gtsam.noiseModel.Constrained.All(3)
                graph.push_back(gtsam.PriorFactorPoint3(key, position, model))

    def _add_weak(self, graph: Any, start: CameraState, loose: NDArray[np.bool_]) -> None:
        distance = np.linalg.norm(start.points - first_centres(self.table, start.path), axis=1)
        for index in np.flatnonzero(loose).tolist():
            model = gtsam.noiseModel.Isotropic.Sigma(3, WEAK * distance[index])
            graph.push_back(gtsam.PriorFactorPoint3(self.point_keys[index], start.points[index], model))

    def _add_gauge(self, graph: Any, path: Array, scale: float) -> None:
        hard = gtsam.noiseModel.Constrained.All(6)
        graph.push_back(gtsam.PriorFactorPose3(self.pose_keys[0], SPATIAL.pose(path[0]), hard))
        if not self.scaled:
            return
        distances = np.linalg.norm(SE3.translation(path) - SE3.translation(path[0]), axis=1)
        far = int(np.argmax(distances))
        if distances[far] == 0:
            raise InputError(
                f"All initial poses of {self.name} are at one place, expected a path to take the scale from, because "
                "there are no known points."
            )
        model = gtsam.noiseModel.Isotropic.Sigma(1, scale * distances[far])
        graph.push_back(gtsam.RangeFactorPose3(self.pose_keys[0], self.pose_keys[far], distances[far], model))
