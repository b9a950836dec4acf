"""The factor graph of a run's measurements in GTSAM, an independent optimiser.

    start:     x₀ = the known pose, a hard constraint
    odometry:  Log(δ_t⁻¹ x_{t−1}⁻¹ x_t) ~ N(0, Q_t)
    sighting:  h(x_t, l) − z ~ N(0, R), h and its derivatives from the filter's own observation model

A singular Q_t (a robot that cannot slip sideways) is kept exactly: the residual is turned into Q_t's
eigenvectors, and those without variance become hard constraints. A solver that starts far away would have to
follow these constraints along a curve, therefore `graph(soft=True)` first gives them a tenth of the largest
standard deviation of the same step.
"""

from typing import Any, final

import gtsam
import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array, SE2Group
from rbpf.sensors.readers.measurements import InitialEstimate, Measurements
from rbpf.validation.gtsam.chart import PLANAR, SPATIAL
from rbpf.validation.gtsam.solvers import huber, noise

SINGULAR = 1e-12
"""An eigenvalue of a covariance below this fraction of the largest counts as zero."""
SOFT = 0.1
"""Standard deviation of a softened constraint as a fraction of the step's largest."""

_PENALTY = 1000.0  # GTSAM's default; it counts in errors far from the optimum, where constraints are violated


@final
class Problem:
    """Variables and factors of a run.

    Args:
        m: the measurements.
        robust: Huber's threshold on the norm of a whitened sighting; None is Gaussian.

    Raises:
        InputError: a sighting's covariance is singular.
    """

    def __init__(self, m: Measurements, robust: float | None = None) -> None:
        self.m, self.robust, self.model = m, robust, m.model()
        self.chart = PLANAR if isinstance(m.space, SE2Group) else SPATIAL
        self.names, self._index = np.unique(m.landmarks, return_inverse=True)
        self._by_step = np.argsort(m.steps, kind="stable")
        self._bounds = np.searchsorted(m.steps[self._by_step], np.arange(len(m.stamps_ns) + 1))
        self._variances, self._axes = np.linalg.eigh(m.covs)
        self._null = self._variances <= SINGULAR * self._variances.max(-1, keepdims=True, initial=0.0)
        self._require_noise()

    @property
    def singular(self) -> bool:
        """Whether any odometry has a direction without noise."""
        return bool(self._null.any())

    def pose_key(self, step: int) -> int:
        """Key of a step's pose."""
        return int(gtsam.symbol("x", step))

    def landmark_key(self, index: int) -> int:
        """Key of the landmark `names[index]`."""
        return int(gtsam.symbol("l", index))

    def sightings(self, step: int) -> NDArray[np.intp]:
        """Rows of the step's sightings."""
        return self._by_step[self._bounds[step] : self._bounds[step + 1]]

    def landmark_of(self, row: int) -> int:
        """Index of the landmark that a sighting shows."""
        return int(self._index[row])

    def graph(self, soft: bool = False) -> Any:
        """All factors."""
        graph = gtsam.NonlinearFactorGraph()
        for step in range(len(self.m.stamps_ns)):
            self.add_step(graph, step, soft)
        return graph

    def add_step(self, graph: Any, step: int, soft: bool = False) -> None:
        """Factors of one step: its motion (the known start at step 0) and its sightings."""
        graph.push_back(self._odometry(step, soft) if step else self._start())
        for row in self.sightings(step).tolist():
            graph.push_back(self._sighting(row))

    def values(self, initial: InitialEstimate) -> Any:
        """GTSAM's values of an estimate.

        Raises:
            InputError: it lacks a pose or a landmark.
        """
        shape, path = (len(self.m.stamps_ns), self.m.space.size), initial.world_from_robot
        missing = [name for name in self.names.tolist() if name not in initial.landmarks]
        if path.shape != shape or missing:
            problem = f"landmark {missing[0]} is missing" if missing else f"found poses of shape {path.shape}"
            raise InputError(f"Expected initial poses of shape {shape} and every landmark seen, {problem}.")
        values = gtsam.Values()
        for step, pose in enumerate(path):
            values.insert(self.pose_key(step), self.chart.pose(pose))
        for index, name in enumerate(self.names.tolist()):
            values.insert(self.landmark_key(index), np.asarray(initial.landmarks[name], dtype=float))
        return values

    def estimate(self, values: Any) -> InitialEstimate:
        """The inverse of `values`."""
        poses = [self.chart.storage(values, self.pose_key(step)) for step in range(len(self.m.stamps_ns))]
        points = {
            name: np.array(self.chart.point(values, self.landmark_key(index)))
            for index, name in enumerate(self.names.tolist())
        }
        return InitialEstimate(self.m.space.normalise(np.array(poses)), points)

    def _start(self) -> Any:
        hard = gtsam.noiseModel.Constrained.All(self.m.space.dim)
        return self.chart.prior(self.pose_key(0), self.chart.pose(self.m.start), hard)

    def _odometry(self, step: int, soft: bool) -> Any:
        variances, axes, null = (x[step - 1] for x in (self._variances, self._axes, self._null))
        if soft:
            variances = np.where(null, SOFT**2 * variances[-1], variances)
        keys = self.pose_key(step - 1), self.pose_key(step)
        if null.any() and not (soft and variances[-1] > 0):
            return self._turned_odometry(keys, self.m.deltas[step - 1], np.where(null, 0.0, variances), axes)
        order = self.chart.order
        cov = ((axes * variances) @ axes.T)[np.ix_(order, order)]
        return self.chart.between(*keys, self.chart.pose(self.m.deltas[step - 1]), noise(cov))

    def _turned_odometry(self, keys: tuple[int, int], delta: Array, variances: Array, axes: Array) -> Any:
        # e = U^T Log((x delta)^-1 y):  de/dy = U^T J_r^-1,  de/dx = -U^T J_l^-1 Ad(delta^-1).
        space, chart = self.m.space, self.chart
        back = space.adjoint(space.inverse(delta))

        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            before, now = (chart.storage(values, key) for key in keys)
            e = space.local(space.compose(before, delta), now)
            if jacobians is not None:
                jacobians[0] = -(axes.T @ space.left_jacobian_inverse(e) @ back)[:, chart.order]
                jacobians[1] = (axes.T @ space.right_jacobian_inverse(e))[:, chart.order]
            return axes.T @ e

        mixed = gtsam.noiseModel.Constrained.MixedSigmas(_PENALTY, np.sqrt(variances))
        return gtsam.CustomFactor(mixed, list(keys), error)

    def _sighting(self, row: int) -> Any:
        model, chart, z = self.model, self.chart, self.m.z[row]
        pose_key = self.pose_key(int(self.m.steps[row]))
        landmark_key = self.landmark_key(self.landmark_of(row))

        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            state, landmark = chart.storage(values, pose_key), chart.point(values, landmark_key)
            if jacobians is not None:
                by_state, by_landmark, _ = model.jacobians(state, landmark)
                assert by_state is not None and by_landmark is not None
                jacobians[0], jacobians[1] = by_state[:, chart.order], by_landmark
            return -model.residual(z, model.predict(state, landmark))

        loss = huber(noise(self.m.cov_z[row]), self.robust)
        return gtsam.CustomFactor(loss, [pose_key, landmark_key], error)

    def _require_noise(self) -> None:
        if self.robust is not None and not self.robust > 0:
            raise InputError(f"Expected a robust threshold above 0 standard deviations, found {self.robust}.")
        variances = np.linalg.eigvalsh(self.m.cov_z)
        singular = variances[:, 0] <= SINGULAR * variances[:, -1]
        if singular.any():
            row = int(np.argmax(singular))
            place = f"landmark {self.m.landmarks[row]} at step {self.m.steps[row]}"
            raise InputError(
                f"The sighting of {place} has a singular covariance, expected noise in all of it."
            )
