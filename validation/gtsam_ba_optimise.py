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

_ROUGH = 1e-4
_EXACT = 1e-11
_ITERATIONS = 200
_DAMPING = 1e-5
_MAX_DAMPING = 1e10
_SYMBOL = re.compile(r"\(Symbol: ([xl])(\d+)\)")


def optimise(problem: Problem, graph: Any, values: Any) -> tuple[Any, int]:
    """Levenberg-Marquardt until the error stands; singular odometry is softened first, then Gauss-Newton's.

    The loops are here because GTSAM's own optimisers copy all values at every call of a factor written in
    Python, a hundred times the cost; linearisation, elimination and retraction are GTSAM's.

    Args:
        problem: what is solved.
        graph: its factors, with hard constraints.
        values: where to start.

    Returns:
        The optimum and the number of iterations.

    Raises:
        InputError: it did not converge.
    """
    softened = 0
    if problem.singular:
        near, softened, _ = _levenberg_marquardt(problem.graph(soft=True), values, _ROUGH)
        optimum, count, converged = _gauss_newton(graph, near)
    else:
        optimum, count, converged = _levenberg_marquardt(graph, values, _EXACT)
    if not converged:
        raise InputError(
            f"The batch optimisation of {problem.m.recording} did not converge in {count} iterations; "
            "start it incrementally or from the filter's estimate, or ask for the robust loss."
        )
    return optimum, softened + count


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
        f"GTSAM could not solve {problem.m.recording}: "
        f"the measurements do not determine everything near {place}; check the covariances there."
    )


def _levenberg_marquardt(graph: Any, values: Any, tolerance: float) -> tuple[Any, int, bool]:
    error, damping = graph.error(values), _DAMPING
    for count in range(1, _ITERATIONS + 1):
        linear, slack = graph.linearize(values), tolerance * max(1.0, error)
        while damping <= _MAX_DAMPING:
            moved = _damped_step(linear, values, damping)
            before, after = error, graph.error(moved)
            if after <= before + slack:
                break
            damping *= 10
        else:
            return values, count, False
        values, error = moved, after
        if before - after <= slack:
            return values, count, True
        damping /= 10
    return values, _ITERATIONS, False


def _gauss_newton(graph: Any, values: Any) -> tuple[Any, int, bool]:
    # Steps are not refused: on the way to the constraints the error may rise.
    error = graph.error(values)
    for count in range(1, _ITERATIONS + 1):
        before, values = error, _step(graph.linearize(values), values)
        error = graph.error(values)
        if abs(before - error) <= _EXACT * max(1.0, before):
            return values, count, True
    return values, _ITERATIONS, False


def _damped_step(linear: Any, values: Any, damping: float) -> Any:
    damped, zero = gtsam.GaussianFactorGraph(), values.zeroVectors()
    damped.push_back(linear)
    for key in values.keys():  # noqa: SIM118, no mapping
        dim = len(zero.at(key))
        unit = gtsam.noiseModel.Unit.Create(dim)
        damped.push_back(gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(dim), np.zeros(dim), unit))
    return _step(damped, values)


def _step(linear: Any, values: Any) -> Any:
    # By QR: GTSAM's Cholesky refuses neighbours whose standard deviations differ by a factor above 4096.
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
    return values.retract(linear.optimize(ordering, gtsam.EliminateQR))
