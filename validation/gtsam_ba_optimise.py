"""Optimisation of a `Problem` in GTSAM, from afar and then to the last digit; covariances at the optimum."""

import re
from typing import Any

import gtsam
import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.validation.gtsam_ba_graph import Problem

CHUNK = 50
"""Steps that `incremental` adds at once."""

_ROUGH = 1e-6
_EXACT = 1e-11
_ITERATIONS = 100
_DAMPING = 1e-5
_MAX_DAMPING = 1e8
_SYMBOL = re.compile(r"\(Symbol: ([xl])(\d+)\)")


def optimise(problem: Problem, graph: Any, values: Any) -> tuple[Any, int]:
    """Levenberg-Marquardt with soft constraints, then Gauss-Newton with hard ones until the error stands.

    The loops are here because GTSAM's own optimisers copy all values at every call of a factor written in
    Python, a hundred times the cost; linearisation, elimination and retraction are GTSAM's.

    Args:
        problem: what is solved.
        graph: its factors, with hard constraints.
        values: where to start.

    Returns:
        The optimum and the number of iterations of both.

    Raises:
        InputError: it did not converge.
    """
    soft = problem.graph(soft=True) if problem.singular else graph
    near, rough = _levenberg_marquardt(soft, values)
    optimum, exact = _gauss_newton(graph, near)
    return optimum, rough + exact


def incremental(problem: Problem) -> Any:
    """Values from ISAM2, `CHUNK` steps at a time, so that every loop is closed from near by.

    A new pose starts by odometry from the estimate of the one before, a new landmark by its first sighting.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    isam, m = gtsam.ISAM2(params), problem.m
    held = isam.getLinearizationPoint()  # while Python knows this object, no call of a factor copies it
    pose, seen = m.start, set[int]()
    for first in range(0, len(m.stamps_ns), CHUNK):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for step in range(first, min(first + CHUNK, len(m.stamps_ns))):
            pose = m.space.compose(pose, m.deltas[step - 1]) if step else pose
            problem.add_step(graph, step, soft=True)
            values.insert(problem.pose_key(step), problem.chart.pose(pose))
            for row in problem.sightings(step).tolist():
                landmark = problem.landmark_of(row)
                if landmark not in seen:
                    seen.add(landmark)
                    values.insert(problem.landmark_key(landmark), problem.model.invert(pose, m.z[row]))
        isam.update(graph, values)
        pose = problem.chart.storage(isam.calculateEstimate(), problem.pose_key(step))
    del held
    return isam.calculateEstimate()


def covariances(problem: Problem, graph: Any, values: Any) -> tuple[Array, dict[int, Array]]:
    """Marginal covariances of all poses (T, d, d), in our chart, and of all landmarks, each (D, D).

    The conditionals' own square roots are used, because a constrained pose has no information matrix.
    """
    linear = graph.linearize(values)
    tree = linear.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(linear), gtsam.EliminateQR)

    def marginal(key: int) -> Array:
        conditional = tree.marginalFactor(key, gtsam.EliminateQR)
        factor = np.linalg.inv(conditional.R()) * conditional.get_model().sigmas()
        return np.asarray(factor @ factor.T)

    steps = range(len(problem.m.stamps_ns))
    poses = np.array([problem.chart.covariance(marginal(problem.pose_key(step))) for step in steps])
    names = enumerate(problem.names.tolist())
    return poses, {name: marginal(problem.landmark_key(index)) for index, name in names}


def explain(problem: Problem, error: RuntimeError) -> InputError:
    """GTSAM's complaint in words, with the variable that it names."""
    symbol = _SYMBOL.search(str(error))
    if symbol is None:
        return InputError(f"GTSAM could not solve {problem.m.recording}: {' '.join(str(error).split())}")
    index = int(symbol[2])
    place = f"the pose of step {index}" if symbol[1] == "x" else f"landmark {problem.names[index]}"
    return InputError(
        f"GTSAM could not solve {problem.m.recording}: the measurements do not determine {place}; "
        "check the covariances around it."
    )


def _levenberg_marquardt(graph: Any, values: Any) -> tuple[Any, int]:
    error, damping = graph.error(values), _DAMPING
    for count in range(1, _ITERATIONS + 1):
        linear = graph.linearize(values)
        while not (moved_error := graph.error(moved := _damped_step(linear, values, damping))) <= error:
            damping *= 10
            if damping > _MAX_DAMPING:
                return values, count
        decrease, values, error = error - moved_error, moved, moved_error
        if decrease <= _ROUGH * error:
            break
        damping /= 10
    return values, count


def _damped_step(linear: Any, values: Any, damping: float) -> Any:
    damped, zero = gtsam.GaussianFactorGraph(), values.zeroVectors()
    damped.push_back(linear)
    for key in values.keys():  # noqa: SIM118, no mapping
        dim = len(zero.at(key))
        unit = gtsam.noiseModel.Unit.Create(dim)
        damped.push_back(gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(dim), np.zeros(dim), unit))
    return _step(damped, values)


def _gauss_newton(graph: Any, values: Any) -> tuple[Any, int]:
    error = graph.error(values)
    for count in range(1, _ITERATIONS + 1):
        before, values = error, _step(graph.linearize(values), values)
        error = graph.error(values)
        if abs(before - error) <= _EXACT * max(1.0, before):
            return values, count
    raise InputError(
        f"The batch optimisation did not converge in {_ITERATIONS} iterations (error {error:.6g}); "
        "start it incrementally, or from the filter's estimate."
    )


def _step(linear: Any, values: Any) -> Any:
    # By QR: GTSAM's Cholesky refuses neighbours whose standard deviations differ by a factor above 4096.
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
    return values.retract(linear.optimize(ordering, gtsam.EliminateQR))
