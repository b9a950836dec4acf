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
from rbpf.validation.gtsam.camera_graph import FINE, CameraProblem, CameraState, adjust, covariances
from rbpf.validation.gtsam.camera_start import from_scratch
from rbpf.validation.gtsam.observations import (
    CameraEstimate,
    in_camera,
    in_front,
    in_one_piece,
    known_by_name,
    observation_table,
    place,
    triangulate,
)

__all__ = ["CameraEstimate", "CameraSolution", "solve_features"]

LEAST = 3
"""Landmarks that fix a pose, and points that fix a frame."""
LINE = 1e-3
"""Known points whose spread across a line is below this fraction of that along it lie on it."""


@final
@dataclass(frozen=True, eq=False)
class CameraSolution:
    """Most probable path and map; covariances and error as those of `robot.BatchSolution`."""

    world_from_camera: Array  #: (T, 7) poses.
    landmarks: dict[int, Array]  #: name of each landmark that took part to its (3,) position [m].
    cov_poses: Array  #: (T, 6, 6).
    cov_landmarks: dict[int, Array]  #: name to (3, 3).
    error: float  #: of the residuals.
    iterations: int  #: of the optimiser.
    #: names of the landmarks whose place the measurements do not tell, ascending: those seen in one frame by a single
    #: camera, and those that an outlier has drawn into its camera, which are both left out, and those whose distance
    #: is open for want of parallax, which have a weak prior.
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
    if robust is not None and not robust > 0:
        raise InputError(f"Expected a robust threshold above 0 standard deviations, found {robust}.")
    full = observation_table(log)
    known = known_by_name(log.known, full.names)
    problem = CameraProblem(log.name, len(log.frames), full.determined(known), known, robust)
    _check(problem)
    start = begin(problem, initial or from_scratch(problem, on_iteration))
    found = adjust(problem, start, tolerance or FINE, on_iteration)
    found.require_converged()
    cov_poses, cov_landmarks = covariances(found) if marginals else (np.empty((0, 6, 6)), {})
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


def _check(problem: CameraProblem) -> None:
    """Refuses too few observations of a frame, frames apart, or known points that do not fix the world's frame."""
    table, name = problem.table, problem.name
    counts = np.bincount(table.steps, minlength=problem.frames)
    if (few := np.flatnonzero(counts < LEAST)).size:
        raise InputError(
            f"Frame {few[0]} of {name} sees {counts[few[0]]} landmarks that are known or seen from elsewhere "
            f"too, expected {LEAST} or more; leave the frame out."
        )
    piece = in_one_piece(table.steps, table.index, problem.frames, ~problem.free)
    if (apart := np.flatnonzero(~piece)).size:
        raise InputError(
            f"Frame {apart[0]} of {name} shares no landmark, directly or through others, with "
            f"{'the known points' if problem.known else 'frame 0'}; leave it out."
        )
    if problem.known:
        positions = np.array([position for position, _ in problem.known.values()])
        if len(positions) < LEAST:
            raise InputError(f"{name} sees {len(positions)} known points, expected {LEAST} or more, or none at all.")
        spread = np.linalg.svd(positions - positions.mean(0), compute_uv=False)
        if spread[1] <= LINE * spread[0]:
            raise InputError(f"The known points that {name} sees lie on a line; add one beside it.")


def begin(problem: CameraProblem, start: CameraEstimate) -> CameraState:
    """A state near an estimate: its landmarks, known points, and the others triangulated from its poses.

    Landmarks that come out behind a camera are placed on their first rays.

    Raises:
        InputError: the path is none of the log's frames, or a landmark has no place in front of its cameras.
    """
    table, path = problem.table, np.asarray(start.world_from_camera, dtype=float)
    if path.shape != (problem.frames, 7) or not np.isfinite(path).all():
        raise InputError(
            f"Expected finite initial poses of shape {(problem.frames, 7)}, one for each frame of "
            f"{problem.name}, found {path.shape}."
        )
    given = {name: mean for name, (mean, _) in problem.known.items()} | start.landmarks
    points = triangulate(table, path)
    rows = [index for index, name in enumerate(table.names.tolist()) if name in given]
    points[rows] = np.array([given[int(table.names[row])] for row in rows]).reshape(-1, 3)
    points = place(table, path, points, ~in_front(table, path, points))
    behind = np.flatnonzero(in_camera(table, path, points)[:, 2] <= 0)
    if behind.size:
        row = behind[0]
        raise InputError(
            f"Landmark {table.names[table.index[row]]} lies behind the camera in frame {table.steps[row]} of "
            f"{problem.name}, which measured it; start from another estimate."
        )
    return CameraState(path, points)
