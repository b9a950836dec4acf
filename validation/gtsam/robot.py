"""Batch solution of a run's measurements by GTSAM: the most probable trajectory and map.

It uses the same measurements, models and noise as the filter, without sampling and all at once: the posterior that the filter
approximates. F. Dellaert and M. Kaess, "Factor graphs for robot perception" (2017).

    start:        x₀ = the known pose, a hard constraint
    odometry:     Log(δ_t⁻¹ x_{t−1}⁻¹ x_t) ~ N(0, Q_t)
    observation:  h(x_t, l) − z ~ N(0, R), h and its derivatives as written in `Sensor`

A singular Q_t (a robot that cannot slip sideways) is exact: the residual is rotated into Q_t's eigenvectors, and
directions without variance become hard constraints. A solver that starts far away would have to follow these constraints
along a curve, so `RobotProblem.graph(soft=True)` first gives them a tenth of the largest standard deviation of the same
step.
"""

from collections.abc import Iterator
from typing import Any, final

import gtsam
import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array, SE2Group
from rbpf.sensors.readers.measurements import InitialEstimate, Measurements, initial_estimate
from rbpf.validation.gtsam import solvers
from rbpf.validation.gtsam.observations import SINGULAR, Residuals

SOFT = 0.1  #: Standard deviation of a softened constraint as a fraction of the step's largest.
CHUNK = 50  #: Number of steps added at once in an incremental initialisation.
MOVED = 1e-3  #: Largest distance of a variable from its linearisation point in `solve_online` [rad, m].
ADVICE = "check the covariances there"
_PENALTY = 1000.0  # GTSAM's default; it counts in errors far from the optimum, where constraints are violated


def solve(
    m: Measurements,
    robust: float | None = None,
    marginals: bool = True,
    initial: InitialEstimate | None = None,
    incremental: bool = False,
) -> solvers.BatchSolution:
    """Solve for all poses and landmarks at once; nothing of the measurements is left out.

    `robust` is the threshold of Huber's loss on the norm of each whitened observation, in standard deviations (1.345 is
    usual); None takes all as Gaussian. The covariances, which `marginals` asks for, then are those of the reweighted
    problem. It starts from `initial`, by default dead reckoning and first observations; `incremental` starts from ISAM2
    instead, for recordings whose dead reckoning is far off.

    Raises InputError: an observation has no noise, the measurements do not determine a variable, or the optimiser does
    not converge.
    """
    problem = RobotProblem(m, robust)
    with solvers.explaining(m.recording, "the pose of step", problem.names, ADVICE):
        graph = problem.graph()
        if incremental:  # ISAM2 closes every loop from a nearby estimate.
            *_, (_, isam) = _grown(problem, CHUNK)
            values = isam.calculateEstimate()
        else:
            values = problem.values(initial or initial_estimate(m))
        # Until the error stands; hard constraints of the odometry are softened first, and then Gauss-Newton's.
        if problem.null.any():
            near, _, _ = solvers.levenberg_marquardt(problem.graph(soft=True), values, solvers.ROUGH)
            values, count, converged = solvers.gauss_newton(graph, near)
        else:
            values, count, converged = solvers.levenberg_marquardt(graph, values, solvers.EXACT)
        if not converged:
            raise InputError(
                f"{m.recording} did not converge in {count} iterations; start incrementally, or ask for the robust loss."
            )
        path, landmarks = problem.estimate(values)
        cov_poses, cov_landmarks = np.empty((0, m.space.dim, m.space.dim)), dict[int, Array]()
        if marginals:
            found = solvers.marginals(graph, values, problem.pose_keys + problem.landmark_keys)
            ours = np.argsort(problem.chart.order)
            cov_poses = np.array(found[: len(path)])[:, ours[:, None], ours]
            cov_landmarks = dict(zip(problem.names.tolist(), found[len(path) :], strict=True))
        return solvers.BatchSolution(path, dict(landmarks), cov_poses, cov_landmarks, graph.error(values))


def solve_online(m: Measurements) -> Array:
    """The last pose of the optimum given all measurements up to each step: the best possible filter result.

    By ISAM2 (M. Kaess et al., 2012), which relinearises variables that moved; directions without noise are given a tenth
    of the step's largest standard deviation. Poses (T, E); errors as of `solve`.
    """
    problem = RobotProblem(m)
    with solvers.explaining(m.recording, "the pose of step", problem.names, ADVICE):
        return np.array([pose for pose, _ in _grown(problem, 1, MOVED)])


def _grown(problem: "RobotProblem", chunk: int, moved: float | None = None) -> Iterator[tuple[Array, Any]]:
    """The newest pose (E,), and ISAM2, after every `chunk` steps.

    With `moved`, variables that moved by this [rad, m] are relinearised every time, else by GTSAM's default. A new pose
    is initialised by odometry from the estimate of the one before, a new landmark by its first observation.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    if moved is not None:
        params.relinearizeSkip = 1
        params.setRelinearizeThreshold(moved)
    isam, m = gtsam.ISAM2(params), problem.m
    held = isam.getLinearizationPoint()  # while Python knows this object, no call of a factor copies it
    pose, seen, start = m.start, set[int](), m.model()
    for first in range(0, len(m.stamps_ns), chunk):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for step in range(first, min(first + chunk, len(m.stamps_ns))):
            pose = m.space.compose(pose, m.deltas[step - 1]) if step else pose
            problem.add_step(graph, step, soft=True)
            values.insert(problem.pose_keys[step], problem.chart.pose(pose))
            for row in problem.observations(step).tolist():
                landmark = int(problem.index[row])
                if landmark not in seen:
                    seen.add(landmark)
                    values.insert(problem.landmark_keys[landmark], start.invert(pose, m.z[row]))
        isam.update(graph, values)
        if moved is not None:
            isam.update()
        pose = problem.chart.storage(isam.calculateEstimate(), problem.pose_keys[step])
        yield pose, isam
    del held


@final
class Sensor:
    """A robot's observation model, implemented independently of the filter's, which the batch validates."""

    def __init__(self, m: Measurements) -> None:
        self._space, self._sign, self._mount = m.space, m.pitch_sign, m.robot_from_sensor
        self._polar, self._turn = m.measurement == "range_bearing", m.space.rotation(m.robot_from_sensor).T

    def residual(self, pose: Array, point: Array, z: Array) -> Array:
        """Predictions of points (…, D) from poses (…, E) minus measurements (…, p); angles in (−π, π]."""
        at = self._space.inverse_transform(self._mount, self._space.inverse_transform(pose, point))
        if not self._polar:
            return at - z
        angles = [np.arctan2(at[..., 1], at[..., 0])]
        if at.shape[-1] == 3:
            angles.append(self._sign * np.arctan2(at[..., 2], np.hypot(at[..., 0], at[..., 1])))
        turned = np.stack(angles, axis=-1) - z[..., 1:]
        turned -= 2.0 * np.pi * np.round(turned / (2.0 * np.pi))
        return np.concatenate([np.linalg.norm(at, axis=-1, keepdims=True) - z[..., :1], turned], axis=-1)

    def slopes(self, pose: Array, point: Array) -> tuple[Array, Array]:
        """∂/∂pose (…, p, d) in its right chart and ∂/∂point (…, p, D), of poses (…, E) and points (…, D)."""
        near = self._space.inverse_transform(pose, point)
        at = self._space.inverse_transform(self._mount, near)
        planar, slope = at.shape[-1] == 2, self._turn
        if self._polar:
            x, y, flat, far = at[..., 0], at[..., 1], np.hypot(at[..., 0], at[..., 1]), np.linalg.norm(at, axis=-1)
            turn = np.stack([-y, x] if planar else [-y, x, 0 * x], axis=-1)
            rows = [at / far[..., None], turn / flat[..., None] ** 2]
            if not planar:
                high = at[..., 2] / flat
                rows.append(self._sign * np.stack([-x * high, -y * high, flat], axis=-1) / far[..., None] ** 2)
            slope = np.stack(rows, axis=-2) @ slope
        return -slope @ self._space.transform_jacobian(near), slope @ self._space.rotation(pose).mT


@final
class RobotProblem:
    """Variables and factors of a run; see `solve`. Raises InputError: an observation's covariance is singular."""

    def __init__(self, m: Measurements, robust: float | None = None) -> None:
        variances = np.linalg.eigvalsh(m.cov_z)
        singular = variances[:, 0] <= SINGULAR * variances[:, -1]
        if singular.any():
            row = int(np.argmax(singular))
            place = f"landmark {m.landmarks[row]} at step {m.steps[row]}"
            raise InputError(f"The observation of {place} has a singular covariance, expected noise in all of it.")
        self.m, self.robust, self.sensor = m, robust, Sensor(m)
        self.chart = solvers.PLANAR if isinstance(m.space, SE2Group) else solvers.SPATIAL
        self.names, self.index = np.unique(m.landmarks, return_inverse=True)
        self.pose_keys = [int(gtsam.symbol("x", step)) for step in range(len(m.stamps_ns))]
        self.landmark_keys = [int(gtsam.symbol("l", index)) for index in range(len(self.names))]
        self._by_step = np.argsort(m.steps, kind="stable")
        self._bounds = np.searchsorted(m.steps[self._by_step], np.arange(len(m.stamps_ns) + 1))
        #: (T - 1, d) of the motions along their (T - 1, d, d) axes, and which of them are zero.
        self.variances, self.axes = np.linalg.eigh(m.covs)
        self.null = self.variances <= SINGULAR * self.variances.max(-1, keepdims=True, initial=0.0)

    def observations(self, step: int) -> NDArray[np.intp]:
        """Rows of the step's observations."""
        return self._by_step[self._bounds[step] : self._bounds[step + 1]]

    def graph(self, soft: bool = False) -> Any:
        """All factors; not for ISAM2, see `solvers.together`."""
        graph, factor = gtsam.NonlinearFactorGraph(), solvers.together(self._observed)
        for step in range(len(self.m.stamps_ns)):
            self.add_step(graph, step, soft, factor)
        return graph

    def add_step(self, graph: Any, step: int, soft: bool = False, together: Any = None) -> None:
        """Factors of one step: its motion (the known start at step 0) and its observations, evaluated `together` or singly."""
        if step:
            graph.push_back(self._odometry(step, soft))
        else:
            hard = gtsam.noiseModel.Constrained.All(self.m.space.dim)
            graph.push_back(self.chart.prior(self.pose_keys[0], self.chart.pose(self.m.start), hard))
        for row in self.observations(step).tolist():
            graph.push_back(self._observation(row, together))

    def values(self, initial: InitialEstimate) -> Any:
        """GTSAM's values of an estimate. Raises InputError: a pose or landmark is missing."""
        shape, path = (len(self.m.stamps_ns), self.m.space.size), initial.world_from_body
        missing = [name for name in self.names.tolist() if name not in initial.landmarks]
        if path.shape != shape or missing:
            problem = f"landmark {missing[0]} is missing" if missing else f"found poses of shape {path.shape}"
            raise InputError(f"Expected initial poses of shape {shape} and every landmark seen, {problem}.")
        values = gtsam.Values()
        for key, pose in zip(self.pose_keys, path, strict=True):
            values.insert(key, self.chart.pose(pose))
        for key, name in zip(self.landmark_keys, self.names.tolist(), strict=True):
            values.insert(key, np.asarray(initial.landmarks[name], dtype=float))
        return values

    def estimate(self, values: Any) -> InitialEstimate:
        """The inverse of `values`."""
        poses = [self.chart.storage(values, key) for key in self.pose_keys]
        points = [np.array(self.chart.point(values, key)) for key in self.landmark_keys]
        path = self.m.space.normalise(np.array(poses))
        return InitialEstimate(path, dict(zip(self.names.tolist(), points, strict=True)))

    def _odometry(self, step: int, soft: bool) -> Any:
        variances, axes, null = (x[step - 1] for x in (self.variances, self.axes, self.null))
        space, chart, delta = self.m.space, self.chart, self.m.deltas[step - 1]
        if soft:
            variances = np.where(null, SOFT**2 * variances[-1], variances)
        keys = self.pose_keys[step - 1 : step + 1]
        if not null.any() or (soft and variances[-1] > 0):
            cov = ((axes * variances) @ axes.T)[np.ix_(chart.order, chart.order)]
            return chart.between(*keys, chart.pose(delta), solvers.noise(cov))
        # e = U^T Log((x delta)^-1 y):  de/dy = U^T J_r^-1,  de/dx = -U^T J_l^-1 Ad(delta^-1).
        back = space.adjoint(space.inverse(delta))

        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            before, now = (chart.storage(values, key) for key in keys)
            e = space.local(space.compose(before, delta), now)
            if jacobians is not None:
                jacobians[0] = -(axes.T @ space.left_jacobian_inverse(e) @ back)[:, chart.order]
                jacobians[1] = (axes.T @ space.right_jacobian_inverse(e))[:, chart.order]
            return axes.T @ e

        mixed = gtsam.noiseModel.Constrained.MixedSigmas(_PENALTY, np.sqrt(np.where(null, 0.0, variances)))
        return gtsam.CustomFactor(mixed, keys, error)

    def _observed(self, values: Any) -> Residuals:
        """Of all observations."""
        chart, steps = self.chart, self.m.steps
        poses = np.array([chart.storage(values, key) for key in self.pose_keys])[steps]
        points = np.array([chart.point(values, key) for key in self.landmark_keys])[self.index]
        by_pose, by_point = self.sensor.slopes(poses, points)
        # GTSAM needs Jacobians contiguous in memory.
        by_gtsams_pose = np.ascontiguousarray(by_pose[..., chart.order])
        return self.sensor.residual(poses, points, self.m.z), [by_gtsams_pose, by_point]

    def _observation(self, row: int, together: Any) -> Any:
        sensor, chart, z = self.sensor, self.chart, self.m.z[row]
        keys = [self.pose_keys[self.m.steps[row]], self.landmark_keys[self.index[row]]]
        loss = solvers.huber(solvers.noise(self.m.cov_z[row]), self.robust)
        if together is not None:
            return together(row, keys, loss)

        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            state, landmark = chart.storage(values, keys[0]), chart.point(values, keys[1])
            if jacobians is not None:
                by_state, by_landmark = sensor.slopes(state, landmark)
                jacobians[0], jacobians[1] = by_state[:, chart.order], by_landmark
            return sensor.residual(state, landmark, z)

        return gtsam.CustomFactor(loss, keys, error)
