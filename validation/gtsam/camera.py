"""Batch adjustment of camera features by GTSAM: all poses and landmarks that explain the pixels best.

The same measurements and the same noise as a filter had, without its samples and without its order in time.
B. Triggs et al., "Bundle adjustment: a modern synthesis" (2000);
F. Dellaert and M. Kaess, "Factor graphs for robot perception" (2017).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.gtsam.observations import CameraEstimate, known_by_name, observation_table

__all__ = ["CameraEstimate", "CameraSolution", "solve_features"]


@final
@dataclass(frozen=True, eq=False)
class CameraSolution:
    """Most probable path and map, with covariances from the Gauss-Newton Hessian there.

    Attributes:
        world_from_camera: (T, 7) poses.
        landmarks: name of each landmark that took part to its (3,) position [m].
        cov_poses: (T, 6, 6) marginal covariances in the right chart, order [omega, v]; no rows if not asked for.
        cov_landmarks: name to (3, 3) marginal covariance [m^2]; empty if not asked for.
        error: half the sum of squared whitened residuals, or the sum of their robust losses.
        iterations: of the optimiser.
        undetermined: names of the landmarks whose place the measurements do not tell, ascending: those seen in one
            frame by a single camera, and those that an outlier has drawn into its camera, which are both left out,
            and those whose distance is open for want of parallax, which have a weak prior.
    """

    world_from_camera: Array
    landmarks: dict[int, Array]
    cov_poses: Array
    cov_landmarks: dict[int, Array]
    error: float
    iterations: int
    undetermined: list[int]


def solve_features(
    log: FeatureLog,
    initial: CameraEstimate | None = None,
    *,
    robust: float | None = None,
    marginals: bool = True,
    on_iteration: Callable[[float], None] | None = None,
    tolerance: float | None = None,
) -> CameraSolution:
    """Solve for all poses and landmarks at once.

    The points known beforehand that are seen hold the world's frame. Without any, the first pose is held where it
    starts, and for a single camera, whose pixels do not tell the scale, its distance from the camera that starts
    farthest from it; the covariances then are relative to these.

    Args:
        log: the measurements.
        initial: where to start; landmarks that it lacks are triangulated. By default it is found frame by frame,
            from four known points in the first frame, or for a stereo pair without any, from the identity.
        robust: threshold of Huber's loss on the norm of each whitened observation, in standard deviations (1.345 is
            usual); None takes all as Gaussian. The covariances then are those of the reweighted problem.
        marginals: compute covariances.
        on_iteration: given the error before each iteration, also of adjustments on the way to an initial estimate;
            what it raises ends it all.
        tolerance: fraction of the error that is no gain any more; by default a billionth, for which far landmarks creep
            through hundreds of iterations.

    Raises:
        InputError: a number makes no sense, the first frame sees too few known points and there is no initial
            estimate, the estimate puts a landmark behind its camera, a frame sees too few landmarks or none that
            connect it, the known points are fewer than three or on a line, or the optimiser does not converge.
    """
    from rbpf.validation.gtsam import camera_adjust as adjuster
    from rbpf.validation.gtsam.camera_graph import CameraProblem
    from rbpf.validation.gtsam.camera_start import from_scratch

    if robust is not None and not robust > 0:
        raise InputError(f"Expected a robust threshold above 0 standard deviations, found {robust}.")
    full = observation_table(log)
    known = known_by_name(log.known, full.names)
    problem = CameraProblem(log.name, len(log.frames), full.determined(known), known, robust)
    adjuster.check_problem(problem)
    start = adjuster.begin(problem, initial or from_scratch(problem, on_iteration))
    found = adjuster.adjust(problem, start, tolerance or adjuster.FINE, on_iteration)
    found.require_converged()
    cov_poses, cov_landmarks = adjuster.covariances(found) if marginals else (np.empty((0, 6, 6)), {})
    state, names = found.state, found.problem.table.names
    return CameraSolution(
        world_from_camera=state.path,
        landmarks=dict(zip(names.tolist(), state.points, strict=True)),
        cov_poses=cov_poses,
        cov_landmarks=cov_landmarks,
        error=found.graph.error(found.values),
        iterations=found.iterations,
        undetermined=sorted({*full.names.tolist()} - {*names[~found.loose].tolist()}),
    )
