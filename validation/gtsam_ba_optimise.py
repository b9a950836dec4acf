"""Optimisation of a `Problem` in GTSAM, from afar and to the last digit, and the covariances at the optimum."""

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
_SOLVER = "MULTIFRONTAL_QR"  # Cholesky refuses variables whose accuracies differ by more than 4096
_SYMBOL = re.compile(r"\(Symbol: ([xl])(\d+)\)")


def optimise(problem: Problem, graph: Any, values: Any) -> tuple[Any, int]:
    """Levenberg-Marquardt with soft constraints, then Gauss-Newton with the hard ones until the error stands still.

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
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType(_SOLVER)
    params.setRelativeErrorTol(_ROUGH)
    params.setAbsoluteErrorTol(0.0)
    params.setMaxIterations(_ITERATIONS)
    near = gtsam.LevenbergMarquardtOptimizer(soft, values, params)
    start = near.optimize()
    exact, count = _gauss_newton(graph, start)
    return exact, near.iterations() + count


def incremental(problem: Problem) -> Any:
    """Values from ISAM2, `CHUNK` steps at a time, so that every loop is closed from near by.

    A new pose starts by odometry from the last estimate of the one before, a new landmark by its first sighting.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    isam, m = gtsam.ISAM2(params), problem.m
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


def _gauss_newton(graph: Any, values: Any) -> tuple[Any, int]:
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType(_SOLVER)
    solver = gtsam.GaussNewtonOptimizer(graph, values, params)
    for count in range(1, _ITERATIONS + 1):
        before = solver.error()
        solver.iterate()
        if not np.isfinite(solver.error()):
            break
        if abs(before - solver.error()) <= _EXACT * max(1.0, before):
            # The optimiser owns what values() refers to.
            return gtsam.Values(solver.values()), count
    raise InputError(
        f"The batch optimisation did not converge in {count} iterations (error {solver.error():.6g}); "
        "start it incrementally, or from the filter's estimate."
    )
