"""Tests a run's given calibration against its measurements: the batch optimum with free calibration.

To the whitened Jacobian A and the residuals b of the optimum, as Huber's loss weighs them, come columns C of the calibration's
own parameters. By the part that A does not explain, C̃ and b̃, they would move by θ = G⁻¹ C̃ᵀ b̃, G = C̃ᵀC̃: a Gauss-Newton
step with poses and landmarks free. Errors in images have heavy tails and recur in all observations of a landmark, so that
θ has not the covariance G⁻¹ but, from what is left, e = b̃ − C̃ θ, by groups g that are independent of each other,

    G⁻¹ (Σ_g s_g s_gᵀ) G⁻¹,    s_g = Σ_{rows of g} C̃ᵀ e

(K.-Y. Liang, S. L. Zeger, "Longitudinal data analysis using generalized linear models", 1986). A group is a camera's
observations of one landmark, or a robot's in one step. The larger of both standard deviations is used.

Parameters that are unobservable without noise, such as the lateral sensor offset of a robot that always turns alike, seem to
be with it. A robot's numbers have at least the standard deviation of G⁻¹ where its odometry has no noise (after G. P. Huang,
A. I. Mourikis, S. I. Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators", 2010).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import gtsam
import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from rbpf.errors import InputError
from rbpf.lie import Array, SE2Group
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.measurements import Measurements, initial_estimate
from rbpf.validation.gtsam import solvers
from rbpf.validation.gtsam.batch_problem import Optimum
from rbpf.validation.gtsam.camera import SOFT_SCALE
from rbpf.validation.gtsam.observations import Residuals
from rbpf.validation.gtsam.robot import RobotProblem, Sensor
from rbpf.validation.gtsam.self_calibration import camera_problem, with_camera

DOUBTFUL = 3.0  #: Standard deviations from what is stated that are looked at; twice as many are beyond doubt.
_KEY, _STEP = int(gtsam.symbol("c", 0)), 1e-6


class Measured(NamedTuple):
    """A calibration parameter and its estimate."""

    name: str  #: its name.
    unit: str  #: of the following.
    stated: float  #: the given value.
    found: float  #: the estimate from the measurements.
    std: float  #: its standard deviation; infinite if undetermined.

    @property
    def apart(self) -> float:
        """Standard deviations between the two."""
        return abs(self.found - self.stated) / self.std

    @property
    def said(self) -> str:
        """Half a sentence, with two digits of the standard deviation."""
        digits = max(0, 1 - int(np.floor(np.log10(self.std))))
        found = f"{self.found:.{digits}f} ± {self.std:.{digits}f}{self.unit}"
        return f"{self.name}: {self.stated:.4g}{self.unit} is stated, the measurements say {found}"


def measured_calibration(batch: Optimum) -> list[Measured]:
    """For one camera focal length and k1, for a robot the sensor's mounting pose and the scale of its ranges.

    Empty for stereo, and if the measurements do not allow it.
    """
    problem = batch.problem
    try:
        if not isinstance(problem, FeatureLog):
            return _of_robot(problem, batch)
        return _of_camera(problem, problem.camera, batch) if isinstance(problem.camera, Pinhole) else []
    except (RuntimeError, InputError, np.linalg.LinAlgError):
        return []


def _moved(graph: Any, values: Any, held: list[int], group: Callable[[list[int]], int]) -> tuple[Array, Array, Array]:
    """θ (m,), its standard deviations by G⁻¹ (m,) and by groups (m,); `group` is of a factor's keys besides `_KEY`."""
    factors, count = [graph.at(row) for row in range(graph.size())], values.atVector(_KEY).size
    groups = np.array([group([key for key in factor.keys() if key != _KEY]) for factor in factors])  # noqa: SIM118
    _, of_row = np.unique(np.repeat(groups, [factor.dim() for factor in factors]), return_inverse=True)
    rows, columns, entries = graph.linearize(values).sparseJacobian_()
    zero, keys = values.zeroVectors(), sorted(values.keys())  # c before l and x
    kept = np.repeat([key not in held for key in keys], [len(zero.at(key)) for key in keys])
    jacobian = csc_array((entries, (rows.astype(int) - 1, columns.astype(int) - 1)), shape=(of_row.size, kept.size + 1))
    others = jacobian[:, np.flatnonzero(kept)[count:]]
    others = csc_array(others / np.sqrt(others.multiply(others).sum(axis=0)))
    own = jacobian[:, [*range(count), kept.size]].toarray()
    factor = splu(csc_array(others.T @ others), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    own -= others @ factor.solve(others.T @ own)
    own, error = own[:, :count], own[:, count]
    inverse = np.linalg.inv(own.T @ own)
    change = inverse @ own.T @ error
    sums = np.zeros((of_row.max() + 1, count))
    np.add.at(sums, of_row, own * (error - own @ change)[:, None])
    variances = np.diagonal(inverse), np.diagonal(inverse @ sums.T @ sums @ inverse)
    by_noise, by_groups = (np.sqrt(np.where(variance > 0.0, variance, np.inf)) for variance in variances)
    return change, by_noise, by_groups


def _of_camera(log: FeatureLog, camera: Pinhole, batch: Optimum) -> list[Measured]:
    problem, start = camera_problem(log, batch)
    loose = problem.free & ~np.isin(problem.table.names, batch.estimate.landmarks.ids)
    graph = problem.graph(start, loose, start.path, SOFT_SCALE, with_camera(problem, camera, _KEY))
    values = problem.values(start)
    values.insert(_KEY, np.zeros(2))
    change, *stds = _moved(graph, values, problem.held_keys, min)
    std, (focal, k1) = np.maximum(*stds), (camera.fx, camera.distortion[0])
    return [
        Measured("focal length fx", " px", focal, focal * (1.0 + change[0]), focal * std[0]),
        Measured("distortion k1", "", k1, k1 + change[1], std[1]),
    ]


def _of_robot(m: Measurements, batch: Optimum) -> list[Measured]:
    problem, graph = RobotProblem(m), gtsam.NonlinearFactorGraph()
    across = m.z.shape[1]  # numbers of a place
    turns = m.space.dim - across
    is_length = np.array([True] + [m.measurement == "position"] * (across - 1))

    def evaluate(values: Any) -> Residuals:
        """Of all observations, with slopes by the sensor's turn and place and the length of ranges, too."""
        path, points = problem.estimate(values)
        poses, places = path[m.steps], np.array([points[name] for name in m.landmarks.tolist()])

        def at(change: Array) -> Array:
            turn, shift = np.concatenate([change[:turns], np.zeros(across)]), change[turns : m.space.dim]
            pose = m.space.compose(m.robot_from_sensor, m.space.exp(turn))
            pose[-across:] += shift
            found = Sensor(replace(m, robot_from_sensor=pose)).residual(poses, places, m.z)
            return found + change[-1] * is_length * (found + m.z)

        residuals, slopes = problem._observed(values)
        moved = [at(change) - at(-change) for change in _STEP * np.eye(m.space.dim + 1)]
        return residuals, [*slopes, np.stack(moved, axis=-1) / (2.0 * _STEP)]

    factor = solvers.together(evaluate)
    for step in range(len(m.stamps_ns)):
        problem.add_step(graph, step, True, lambda row, keys, noise: factor(row, [*keys, _KEY], noise))
    values, calm = problem.values(batch.start), problem.values(initial_estimate(m))
    for one in (values, calm):
        one.insert(_KEY, np.zeros(m.space.dim + 1))
    change, *stds = _moved(graph, values, problem.pose_keys[:1], max)
    std = np.maximum(*stds)
    if (np.abs(change) > DOUBTFUL * std).any():
        std = np.maximum(std, _moved(graph, calm, problem.pose_keys[:1], max)[1])
    # A turn in space is from the stated one.
    planar = isinstance(m.space, SE2Group)
    yaw = m.robot_from_sensor[:1] if planar else np.zeros(3)
    stated = np.concatenate([yaw, m.space.translation(m.robot_from_sensor), [1.0]])
    turn = ["the sensor's yaw"] if planar else [f"the sensor's turn about its {axis} axis" for axis in "xyz"]
    names = [(name, "°") for name in turn]
    names += [(f"the sensor's {axis} on the robot", " m") for axis in "xyz"[:across]]
    unit = np.array([180.0 / np.pi] * turns + [1.0] * (across + 1))
    figures = unit * np.stack([stated, stated + change, std])
    names += [("ranges, as a multiple of the right ones", "")]
    return [Measured(*name, *row) for name, row in zip(names, figures.T.tolist(), strict=True)]
