"""Batch solution of a run's measurements by GTSAM: the trajectory and map that explain all of them best.

The same measurements, the same models and the same noise as the filter had, without its samples and without
its order in time: what the filter approximates.
F. Dellaert and M. Kaess, "Factor graphs for robot perception" (2017).
"""

from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf.lie import Array
from rbpf.sensors.readers.measurements import InitialEstimate, Measurements, initial_estimate


@final
@dataclass(frozen=True, eq=False)
class BatchSolution:
    """Most probable trajectory and map, with covariances from the Gauss-Newton Hessian there.

    Attributes:
        world_from_robot: (T, E) poses.
        landmarks: name of each landmark to its (D,) position.
        cov_poses: (T, d, d) marginal covariances in the right chart, order [omega, v]; no rows if not asked
            for.
        cov_landmarks: name of each landmark to its (D, D) marginal covariance; empty if not asked for.
        error: half the sum of squared whitened residuals, or the sum of their robust losses. Where the noise
            is right it is about half the number of measured scalars less half that of the landmarks'
            coordinates; far more tells of a wrong optimum, noise or association.
        iterations: of the optimiser.
    """

    world_from_robot: Array
    landmarks: dict[int, Array]
    cov_poses: Array
    cov_landmarks: dict[int, Array]
    error: float
    iterations: int


def solve(
    m: Measurements,
    robust: float | None = None,
    marginals: bool = True,
    initial: InitialEstimate | None = None,
    incremental: bool = False,
) -> BatchSolution:
    """Solve for all poses and landmarks at once.

    Args:
        m: the measurements; nothing of them is left out.
        robust: threshold of Huber's loss on the norm of each whitened sighting, in standard deviations (1.345
            is usual); None takes all as Gaussian. The covariances then are those of the reweighted problem.
        marginals: compute covariances.
        initial: where to start; by default dead reckoning and first sightings.
        incremental: start from ISAM2 instead, for recordings whose dead reckoning is far off.

    Raises:
        InputError: a sighting has no noise, the measurements do not determine a variable, or the optimiser
            does not converge.
    """
    from rbpf.validation.gtsam import robot_optimise as optimiser
    from rbpf.validation.gtsam.robot_graph import Problem

    problem = Problem(m, robust)
    graph = problem.graph()
    try:
        given = None if incremental else problem.values(initial or initial_estimate(m))
        start = optimiser.incremental(problem) if given is None else given
        values, iterations = optimiser.optimise(problem, graph, start)
        cov_poses, cov_landmarks = np.empty((0, m.space.dim, m.space.dim)), dict[int, Array]()
        if marginals:
            cov_poses, cov_landmarks = optimiser.covariances(problem, graph, values)
    except RuntimeError as error:
        raise optimiser.explain(problem, error) from error
    path, landmarks = problem.estimate(values)
    return BatchSolution(path, dict(landmarks), cov_poses, cov_landmarks, graph.error(values), iterations)


def solve_online(m: Measurements, robust: float | None = None) -> Array:
    """The last pose of the optimum of what had been measured until then, step after step: what no filter can do better.

    By ISAM2 (M. Kaess et al., 2012), which linearises anew what has moved; directions without noise are given a tenth
    of the step's largest standard deviation.

    Args:
        m: the measurements.
        robust: as for `solve`.

    Returns:
        (T, E) poses.

    Raises:
        InputError: a sighting has no noise, or the measurements do not determine a variable.
    """
    from rbpf.validation.gtsam import robot_optimise as optimiser
    from rbpf.validation.gtsam.robot_graph import Problem

    problem = Problem(m, robust)
    try:
        return optimiser.online(problem)
    except RuntimeError as error:
        raise optimiser.explain(problem, error) from error
