"""Optimisation of a `Problem` in GTSAM, from afar and then to the last digit; covariances at the optimum."""

import re
from collections.abc import Iterator
from typing import Any

import gtsam
import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.validation.gtsam.robot_graph import Problem
from rbpf.validation.gtsam.solvers import EXACT, ROUGH, gauss_newton, levenberg_marquardt, marginals

CHUNK = 50
"""Steps that `incremental` adds at once."""

MOVED = 1e-3
"""How far a variable may be from where `online` linearised it [rad, m]."""

_SYMBOL = re.compile(r"\(Symbol: ([xl])(\d+)\)")


def optimise(problem: Problem, graph: Any, values: Any) -> tuple[Any, int]:
    """Levenberg-Marquardt until the error stands; singular odometry is softened first, then Gauss-Newton's.

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
        near, softened, _ = levenberg_marquardt(problem.graph(soft=True), values, ROUGH)
        optimum, count, converged = gauss_newton(graph, near)
    else:
        optimum, count, converged = levenberg_marquardt(graph, values, EXACT)
    if not converged:
        raise InputError(
            f"The batch optimisation of {problem.m.recording} did not converge in {count} iterations; "
            "start it incrementally or from the filter's estimate, or ask for the robust loss."
        )
    return optimum, softened + count


def incremental(problem: Problem) -> Any:
    """Values from ISAM2, `CHUNK` steps at a time, so that every loop is closed from near by."""
    *_, (_, isam) = _grown(problem, CHUNK)
    return isam.calculateEstimate()


def online(problem: Problem) -> Array:
    """The newest pose of ISAM2's estimate after each step, (T, E)."""
    return np.array([pose for pose, _ in _grown(problem, 1, MOVED)])


def _grown(problem: Problem, chunk: int, moved: float | None = None) -> Iterator[tuple[Array, Any]]:
    """The newest pose (E,), and ISAM2, after every `chunk` steps.

    With `moved`, all that has moved by so much [rad, m] is linearised anew every time, else as GTSAM usually does.
    A new pose starts by odometry from the estimate of the one before, a new landmark by its first sighting.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    if moved is not None:
        params.relinearizeSkip = 1
        params.setRelinearizeThreshold(moved)
    isam, m = gtsam.ISAM2(params), problem.m
    held = isam.getLinearizationPoint()  # while Python knows this object, no call of a factor copies it
    pose, seen = m.start, set[int]()
    for first in range(0, len(m.stamps_ns), chunk):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for step in range(first, min(first + chunk, len(m.stamps_ns))):
            pose = m.space.compose(pose, m.deltas[step - 1]) if step else pose
            problem.add_step(graph, step, soft=True)
            values.insert(problem.pose_key(step), problem.chart.pose(pose))
            for row in problem.sightings(step).tolist():
                landmark = problem.landmark_of(row)
                if landmark not in seen:
                    seen.add(landmark)
                    values.insert(problem.landmark_key(landmark), problem.model.invert(pose, m.z[row]))
        isam.update(graph, values)
        if moved is not None:
            isam.update()
        pose = problem.chart.storage(isam.calculateEstimate(), problem.pose_key(step))
        yield pose, isam
    del held


def covariances(problem: Problem, graph: Any, values: Any) -> tuple[Array, dict[int, Array]]:
    """Marginal covariances of all poses (T, d, d), in our chart, and of all landmarks, each (D, D)."""
    poses = [problem.pose_key(step) for step in range(len(problem.m.stamps_ns))]
    points = [problem.landmark_key(index) for index in range(len(problem.names))]
    found = marginals(graph, values, poses + points)
    covs = np.array([problem.chart.covariance(cov) for cov in found[: len(poses)]])
    return covs, dict(zip(problem.names.tolist(), found[len(poses) :], strict=True))


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
